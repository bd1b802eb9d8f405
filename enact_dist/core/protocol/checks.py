"""Checks that refuse valid messages which no honest client or shard sends.

The wire format checks types and lengths, the fence checks who holds what.  The checks here protect
the shard itself (an access that does not exist), its clients (an unreadable name) and locks that
would never end (a primary that cannot be asked).  Each function returns the refusal, or None.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import (
    NO_PAYLOAD,
    PROTOCOL,
    UNKNOWN_WORLD,
    VALUE,
    Commit,
    Refused,
)
from enact_dist.core.protocol.parts import NO_LIMIT, READS_MAX
from enact_dist.patterns import checked_patterns
from enact_dist.terms import Access, Durability, checked_name

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from enact_dist.core.protocol.datum import Slot
    from enact_dist.core.protocol.messages import AspectEntry, Finish, Item, Prepare, WriteItem

WORLDS_TOLD_MAX: Final = 100
"""Most world contexts that a refusal names: a text has at most 64 KiB."""

_ACCESSES: Final = frozenset(access.value for access in Access)
_ACCESSES_EACH: Final = frozenset(access.value for access in Access if access.each)
_ACCESSES_BY_STAMP: Final = (Access.VIEW, Access.READ)
_DURABILITIES: Final = ("", *(durability.value for durability in Durability))


def wrong_access(items: Collection[Item]) -> Refused | None:
    """Refuse an unknown access, an invalid pattern, and a capture stamp on anything but a view."""
    for item in items:
        if item.captured_ns and item.access not in _ACCESSES_BY_STAMP:
            return _refused(
                f"{item.entity}/{item.aspect} was requested by capture stamp; only a View can be"
            )
        if item.nearest and not item.captured_ns:
            return _refused(
                f"{item.entity}/{item.aspect} was requested nearest to no capture stamp"
            )
        if item.access not in _ACCESSES:
            return _refused(f"access {item.access} was requested; known: {sorted(_ACCESSES)}")
    return wrong_patterns(item.entity for item in items if item.access in _ACCESSES_EACH)


def wrong_patterns(patterns: Iterable[str]) -> Refused | None:
    """Refuse patterns that no client makes: matching must stay cheap."""
    try:
        checked_patterns(patterns)
    except ValueError as error:
        return _refused(str(error))
    return None


def wrong_name(kind: str, name: str, *, slashes: bool) -> Refused | None:
    """Refuse a name that other clients could not read."""
    try:
        checked_name(kind, name, slashes=slashes)
    except ValueError as error:
        return Refused(VALUE, str(error))
    return None


def unknown_world(name: str, worlds: Iterable[str]) -> Refused:
    """Refuse a world context that is not here, naming those that are."""
    known = tuple(sorted(worlds)[:WORLDS_TOLD_MAX])
    text = f"no world context {name!r} here; known: {', '.join(known) or 'none'}"
    return Refused(UNKNOWN_WORLD, text, known)


def wrong_aspect(entry: AspectEntry) -> Refused | None:
    """Refuse an aspect with an unusable name, durability or retention."""
    if entry.durability not in _DURABILITIES:
        return _refused(
            f"durability {entry.durability!r} of aspect {entry.name!r} was requested; known:"
            f" {', '.join(filter(None, _DURABILITIES))}"
        )
    for figure in (entry.retention, entry.age_ns, entry.size):
        if not 0 <= figure <= NO_LIMIT:
            return _refused(
                f"a retention of {figure} of aspect {entry.name!r} was requested; each"
                f" of its figures lies in 0 to {NO_LIMIT}"
            )
    return wrong_name("aspect", entry.name, slashes=False)


def wrong_label(label: str) -> Refused | None:
    """Refuse a label with an unusable name."""
    return wrong_name("label", label, slashes=True)


def wrong_commit(message: Commit | Prepare, *, peers: Collection[str]) -> Refused | None:
    """Refuse writes, parties or a lineage that no honest client names (see the functions below)."""
    alone = type(message) is Commit and not message.participants
    if alone and len(message.writes) == 1 and not message.reads and not message.reads_left_out:
        return None  # the usual case
    return (
        wrong_writes(message.writes) or wrong_parties(message, peers=peers) or wrong_reads(message)
    )


def wrong_writes(writes: Collection[WriteItem]) -> Refused | None:
    """Refuse two writes of one slot."""
    if len(writes) == 1:
        return None
    seen: set[Slot] = set()
    for write in writes:
        if write.slot in seen:
            return _refused(f"{write.slot} is written twice in one commit")
        seen.add(write.slot)
    return None


def wrong_reads(message: Commit | Prepare) -> Refused | None:
    """Refuse a longer lineage than any honest client sends."""
    if len(message.reads) <= READS_MAX and message.reads_left_out >= 0:
        return None
    return _refused(
        f"{message.lock} named {len(message.reads)} data as read and left out"
        f" {message.reads_left_out}; at most {READS_MAX} are named"
    )


def missing_payload(writes: Iterable[WriteItem]) -> Refused | None:
    """Refuse a write whose bytes lie in a payload that the link has not found."""
    for write in writes:
        datum = write.datum
        if datum is not None and len(datum.body) != datum.size:
            return Refused(
                NO_PAYLOAD,
                f"{write.slot} was written as payload {datum.file} of {datum.size} bytes, which"
                " this shard does not have; send the bytes",
            )
    return None


def wrong_parties(message: Commit | Prepare, *, peers: Collection[str]) -> Refused | None:
    """Refuse a commit over shards with an unreachable participant, or with this shard itself."""
    for shard in message.participants if isinstance(message, Commit) else (message.primary,):
        if shard not in peers:
            known = ", ".join(sorted(peers)) or "none"
            return _refused(
                f"{shard!r} was named to commit {message.lock} with this shard; the other shards"
                f" of the cell are: {known}"
            )
    return None


def wrong_finish(message: Finish, primary: str) -> Refused | None:
    """Refuse a decision that does not come from the primary."""
    if message.position.shard == primary:
        return None
    return _refused(
        f"shard {message.position.shard!r} is said to have committed {message.lock}, which was"
        f" prepared for shard {primary!r}"
    )


def _refused(text: str) -> Refused:
    return Refused(PROTOCOL, text)
