"""The data of given versions, read from their shards as long as these retain them, and set again.

A datum is read by a view as of its timestamp: shards show what is retained, and what was replaced
within the last 2 s.  As of the largest timestamp of a batch each slot shows its newest version of
the batch, so a batch takes as many views as the busiest slot has versions in it, and more if it has
more slots than one view may ask for.
"""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, NamedTuple

from enact_dist.access import asking
from enact_dist.access.snapshot import HeldView
from enact_dist.access.writes import Writing
from enact_dist.core.protocol.messages import Cause, Item, SlotVersion, VersionEntry
from enact_dist.errors import ForgottenError, LeaseLostError, PermissionDeniedError
from enact_dist.terms import Access
from enact_dist.wire.limits import ITEMS_MAX
from enact_dist.wire.payload import Encoded

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from enact_dist.access.session import Session
    from enact_dist.core.client.lock import MultiLock
    from enact_dist.core.protocol.datum import Datum, Slot
    from enact_dist.link.client.locks import CellClient


class Wanted(NamedTuple):
    """One version whose datum or cause is wanted; sorted by timestamp."""

    stamp_ns: int
    slot: Slot
    version: int
    shard: str


class Retained(NamedTuple):
    """What a version is: a datum, or null for a reason."""

    null_reason: str
    datum: Datum | None


def explained(session: Session, wanted: Sequence[Wanted]) -> dict[Wanted, VersionEntry]:
    """Return what the shards know of these versions, without data; forgotten ones are left out.

    Raises:
        ShardUnreachableError: A shard does not answer.
    """
    versions = [SlotVersion(each.slot, each.version) for each in wanted]
    found = {
        entry.state[:3]: entry
        for answer in asking.explained(session.client, versions)
        for entry in answer.entries
    }
    keys = {each: (each.slot, each.version, each.stamp_ns) for each in wanted}
    return {each: found[key] for each, key in keys.items() if key in found}


def causes_of(session: Session, wanted: Sequence[Wanted]) -> dict[Wanted, Cause]:
    """Return the causes of these versions, as far as they are known and this program may ask.

    One version of each commit is asked about first: its cause names what else the commit has set.

    Raises:
        ShardUnreachableError: A shard does not answer.
    """
    found: dict[Wanted, Cause] = {}
    commits: dict[tuple[str, int], list[Wanted]] = {}
    for each in wanted:
        commits.setdefault((each.shard, each.stamp_ns), []).append(each)
    try:
        firsts = explained(session, [same[0] for same in commits.values()])
        for first, entry in firsts.items():
            if (cause := entry.cause) is not None:
                of_it = frozenset((*cause.writes, SlotVersion(first.slot, first.version)))
                same = commits[first.shard, first.stamp_ns]
                found |= {w: cause for w in same if SlotVersion(w.slot, w.version) in of_it}
        rest = explained(session, [each for each in wanted if each not in found])
    except PermissionDeniedError:
        return {}
    return found | {w: entry.cause for w, entry in rest.items() if entry.cause is not None}


def between(session: Session, slot: Slot, shard: str, first: int, last: int) -> list[Wanted]:
    """Return the versions of a slot from `first` to `last` that its history still has.

    Raises:
        ShardUnreachableError: The shard does not answer.
    """
    states = [entry.state for entry in asking.listed(session.client, shard, slot)]
    return [
        Wanted(state.stamp_ns, slot, state.version, shard)
        for state in states
        if state.slot == slot and first <= state.version <= last
    ]


def found_of(session: Session, wanted: Sequence[Wanted]) -> dict[Wanted, Retained]:
    """Return what these versions are; those that are forgotten are left out.

    Raises:
        ShardUnreachableError: A shard does not answer.
    """
    found: dict[Wanted, Retained] = {}
    by_slot: dict[Slot, list[Wanted]] = {}
    for each in sorted(wanted):
        by_slot.setdefault(each.slot, []).append(each)
    while by_slot:
        newest = [versions.pop() for versions in by_slot.values()]
        by_slot = {slot: versions for slot, versions in by_slot.items() if versions}
        for at in range(0, len(newest), ITEMS_MAX):
            found |= _together(session, newest[at : at + ITEMS_MAX])
    return found


def _together(session: Session, wanted: Sequence[Wanted]) -> dict[Wanted, Retained]:
    """Return versions of different slots by one view, or else one by one."""
    found: dict[Wanted, Retained] = {}
    if len(wanted) > 1:
        with suppress(ForgottenError, LeaseLostError):
            found = _as_of(session, wanted, max(wanted).stamp_ns)
    for each in wanted:
        if each not in found:
            with suppress(ForgottenError, LeaseLostError):
                found |= _as_of(session, [each], each.stamp_ns)
    return found


def _as_of(session: Session, wanted: Sequence[Wanted], at_ns: int) -> dict[Wanted, Retained]:
    items = [Item(int(Access.VIEW), *each.slot) for each in wanted]
    with HeldView(session, items, past_ns=at_ns) as view:
        by_state = {reading.state[:3]: reading for reading in view.states}
        shown = {each: by_state.get((each.slot, each.version, each.stamp_ns)) for each in wanted}
        readings = {each: reading for each, reading in shown.items() if reading is not None}
        data = view.fetch([r for r in readings.values() if not r.state.null_reason])
        return {
            each: Retained(reading.state.null_reason, data.get(each.slot))
            for each, reading in readings.items()
        }


def set_encoded(
    client: CellClient,
    data: Mapping[Slot, Datum | None],
    *,
    wait_s: float,
    hold_s: float,
    granted: Callable[[MultiLock], None] = lambda _: None,
) -> MultiLock:
    """Commit encoded data under one lock, as they are: no type has to be known here.

    Args:
        client: The client; its shards know the aspects.
        data: What each slot is set to; None: null.  No more than one lock may write.
        wait_s: How long to wait for the lock.
        hold_s: How long it may be held.
        granted: Called once it is held.

    Returns:
        The lock, which is over.
    """
    writing, committed = Writing(client.payloads), False
    items = [Item(int(Access.WRITE), *slot) for slot in data]
    lock = client.acquire(items, wait_s=wait_s, hold_s=hold_s)
    try:
        granted(lock)
        for slot, datum in data.items():
            if datum is None:
                writing.delete(slot)
            else:
                encoded = Encoded(datum.encoding, [datum.body], datum.size, datum.stamp_ns)
                writing.put(slot, encoded, lock.shard_of)
        client.finish(lock, writing.by_shard(lock.shard_of))
        committed = True
    finally:
        client.release(lock)
        writing.end(committed=committed)
    return lock
