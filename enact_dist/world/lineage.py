"""Where a datum comes from and what was made from it: trees of commits, as far as they are known.

Each version knows the commit that made it and the versions that its lock had read
(`access.writes`).  `Cell.why` follows these back to the causes, `Cell.impact` forward to the
effects, over all shards and world contexts.  A cause is known as long as the version that it made:
versions beyond retention appear in a tree of causes as "forgotten"; forgotten effects cannot be
found.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Self, TypeVar

from enact_dist.access.arguments import checked_as
from enact_dist.access.asking import answers_to, explained, in_parts, listed
from enact_dist.access.snapshot import reason_of
from enact_dist.core.protocol.datum import LockId, Position, Slot
from enact_dist.core.protocol.messages import (
    Cause,
    DatumRead,
    FindEffects,
    SlotVersion,
    Versions,
)
from enact_dist.errors import ForgottenError, MisuseError, NullDatumError
from enact_dist.terms import Entity, NullReason

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from enact_dist.access.session import Session
    from enact_dist.core.protocol.messages import VersionEntry
    from enact_dist.link.client.locks import CellClient
    from enact_dist.terms import Aspect, Context

    Named = tuple[Context | str, Entity | str, Aspect[Any] | str]
    """World context, entity and aspect of a datum, or their names."""

FORGOTTEN: Final = "forgotten"
UNKNOWN: Final = "unknown"
NULL: Final = "null"
UNRECORDED: Final = "unrecorded"
_KIND: Final = {
    FORGOTTEN: "forgotten: it has left its retention",
    UNKNOWN: "its cause is not known",
    NULL: "null",
    UNRECORDED: "not in the recording",
    "fork": "forked",
}

DEPTH_MAX: Final = 200
"""Most steps of one tree: a recursive walk stays within Python's recursion limit."""


@dataclass(frozen=True, slots=True, repr=False)
class Made:
    """One version of a datum, and who made it.

    Attributes:
        world: Name of its world context.
        entity: Its entity.
        aspect: Name of its aspect.
        version: Its number.
        position: Position of its commit.
        age_s: How long ago that was, by the shards' clock.
        kind: "commit" or "fork"; otherwise why its cause is not known: "forgotten" (the version
            has left its retention), "unknown" (the version is there, its cause is not) or "null"
            (a lock read the slot while there was no datum yet, or none any more because its
            volatile shard had restarted), or "unrecorded" (a recording does not have it).
        actor: Who committed it; the empty string if it has no name.
        host: Host of that client.
        pid: Process of that client.
        stamp_ns: When the datum was captured, according to the actor (0: unknown).
        held_s: How long the lock had been held when it committed.
        null_reason: Why the version is null; the empty string for a datum.
        left_out: How many data its lock had read beyond those that the commit names.
        elsewhere: Whether the tree has it a second time, nearer to the root or before; its children
            are shown there.
        unfollowed: How many versions come next that were not followed, because of the depth.
        children: The versions that come next.
    """

    world: str
    entity: Entity
    aspect: str
    version: int
    position: Position
    age_s: float
    kind: str
    actor: str = ""
    host: str = ""
    pid: int = 0
    stamp_ns: int = 0
    held_s: float = 0.0
    null_reason: str = ""
    left_out: int = 0
    elsewhere: bool = False
    unfollowed: int = 0
    children: tuple[Any, ...] = ()  # of its own class

    def walk(self) -> Iterator[Self]:
        """Yield this version and all that follow it in the tree, each once."""
        yield self
        for child in self.children:
            if not child.elsewhere:
                yield from child.walk()

    @property
    def known(self) -> bool:
        """Whether the version is still there, so that it can be pinned."""
        return self.kind not in {FORGOTTEN, NULL, UNRECORDED}

    @property
    def slot(self) -> Slot:
        """What it is a version of."""
        return Slot(self.world, self.entity.name, self.aspect)

    @property
    def made_by(self) -> str:
        """Who made it, or why its cause is not known, in words."""
        said = _KIND.get(self.kind, "")
        by = f"{self.actor or '(unnamed)'}@{self.host}" if self.host else ""
        return f"{said}, {by}" if said and by else said or by

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self.slot} v{self.version}>"


@dataclass(frozen=True, slots=True, repr=False)
class CauseTree(Made):
    """A version and its causes: `children` are the versions that its lock had read, by name."""

    children: tuple[CauseTree, ...] = ()


@dataclass(frozen=True, slots=True, repr=False)
class EffectTree(Made):
    """A version and its effects: `children` are those whose locks had read it, oldest first."""

    children: tuple[EffectTree, ...] = ()


Tree = TypeVar("Tree", CauseTree, EffectTree)
_NO_CAUSE: Final = Cause(LockId("", 0, 0), "", "", "", 0, 0, 0, (), 0, ())


def tree_of(
    kind: type[Tree], session: Session, named: Named, version: int, depth: int | None
) -> Tree:
    """Return the causes or the effects of a version; see `Cell.why` and `Cell.impact`."""
    search = Search(session.client)
    root = search.start(_slot_of(session, *named), version)
    return grown(kind, search, root, depth)


def _slot_of(
    session: Session, world: Context | str, entity: Entity | str, aspect: Aspect[Any] | str
) -> Slot:
    """Return the slot that is named, in a world context that the cell has."""
    session.client.check_usable()
    name = world if isinstance(world, str) else world.name
    if not isinstance(world, str) and getattr(world, "session", None) is not session:
        raise MisuseError(f"{world!r} is not a world context of this cell through this connection")
    if not isinstance(world, str) and world.past:
        raise MisuseError(f"{world!r} is past; name {name!r} and a version of its history")
    if name not in session.client.worlds():
        session.check_world(name)
    return Slot(
        name,
        checked_as("entity", str(entity), slashes=True),
        checked_as("aspect", str(aspect)),
    )


def grown(kind: type[Tree], search: Search, root: DatumRead, depth: int | None) -> Tree:
    """Return the tree from `root` on, each version in full where it is nearest to it.

    Args:
        kind: Which tree.
        search: What is known of each version; asked with one question to each shard per step.
        root: Where it begins.
        depth: How many steps to follow; None: `DEPTH_MAX`.
    """
    if depth is not None and not 0 <= depth <= DEPTH_MAX:
        raise MisuseError(f"depth is {depth!r}; it must lie in 0 to {DEPTH_MAX} steps")
    depth = DEPTH_MAX if depth is None else depth
    follow = search.causes if kind is CauseTree else search.effects
    steps, parents = {root: 0}, dict[DatumRead, DatumRead]()
    follows: dict[DatumRead, Sequence[DatumRead]] = {}
    level = [root]
    while level:
        follows.update(follow(level))
        step = steps[level[0]] + 1
        pairs = [(one, following) for one in level for following in follows[one]]
        level = []
        for one, following in pairs if step <= depth else ():
            if following not in steps:
                steps[following], parents[following] = step, one
                level.append(following)
    found: dict[DatumRead, Tree] = {}
    for one in reversed(steps):
        if steps[one] == depth:
            found[one] = search.made(kind, one, unfollowed=len(follows[one]))
            continue
        children = [
            found[following]
            if parents.get(following) == one
            else search.made(kind, following, elsewhere=True)
            for following in follows[one]
        ]
        found[one] = search.made(kind, one, tuple(children))
    return found[root]


class Search:
    """What the shards know of versions, asked for step by step.

    Attributes:
        missing: Why a version is not there.
    """

    missing = FORGOTTEN

    def __init__(self, client: CellClient) -> None:
        self._client = client
        self._known: dict[DatumRead, VersionEntry] = {}
        self._left_out: dict[object, int] = {}
        self._now_ns = 0

    def start(self, slot: Slot, version: int) -> DatumRead:
        """Return the version to begin with (0: the newest).

        Raises:
            NullDatumError: The slot was never set, or is lost with a volatile shard.
            ForgottenError: The version has left its retention.
            MisuseError: There was no such version yet.
        """
        asked = dict.fromkeys((SlotVersion(slot, 0), SlotVersion(slot, version)))
        entries = self._entries(explained(self._client, asked))
        states = (entry.state for entry in entries)
        newest = max(states, key=lambda state: state.version, default=None)
        if newest is None or not newest.version:
            reason = (newest and reason_of(newest)) or NullReason.NEVER_SET.value
            raise NullDatumError(f"{slot} is null ({reason}): nothing led to it", reason=reason)
        wanted = version or newest.version
        for entry in entries:
            if entry.state.version == wanted:
                self._known[_read_of(entry)] = entry
                return _read_of(entry)
        if not 0 < version < newest.version:
            raise MisuseError(f"{slot} has no version {version}; the newest is {newest.version}")
        left = listed(self._client, self._client.shard_of(slot.entity), slot)
        oldest = left[0].state if left else newest
        raise ForgottenError(
            f"version {version} of {slot} has left its retention; the oldest that is known is"
            f" {oldest.version} (a larger retention, or cell.pin, keeps more)",
            oldest_ns=oldest.stamp_ns,
        )

    def causes(self, level: Sequence[DatumRead]) -> dict[DatumRead, Sequence[DatumRead]]:
        """Return what each of these versions was made of."""
        unknown = {one: None for one in level if one not in self._known}
        asked = [SlotVersion(one.slot, one.version) for one in unknown if one.version]
        for entry in self._entries(explained(self._client, asked)):
            if _read_of(entry) in unknown:  # otherwise the number belongs to another, newer version
                self._known[_read_of(entry)] = entry
        for one in level:
            self._left_out[one] = self._cause(one).reads_left_out
        return {one: in_order_read(one, self._cause(one).reads) for one in level}

    def shard_of(self, slot: Slot) -> str:
        """Return the shard that stores a slot."""
        return self._client.shard_of(slot.entity)

    def _cause(self, one: DatumRead) -> Cause:
        entry = self._known.get(one)
        return entry.cause if entry is not None and entry.cause is not None else _NO_CAUSE

    def effects(self, level: Sequence[DatumRead]) -> dict[DatumRead, Sequence[DatumRead]]:
        """Return what was made from each of these versions."""
        found: dict[DatumRead, dict[DatumRead, None]] = {one: {} for one in level}
        shards = self._client.shards()
        calls = [(shard, FindEffects(some)) for shard in shards for some in in_parts(level)]
        answers = (answer for _, answer in answers_to(self._client, Versions, calls))
        for entry in self._entries(answers):
            made = _read_of(entry)
            self._known[made] = entry
            for read in self._cause(made).reads:
                if read in found:
                    found[read][made] = None
        return {one: in_order_made(made) for one, made in found.items()}

    def _entries(self, answers: Iterable[Versions]) -> list[VersionEntry]:
        entries: list[VersionEntry] = []
        for answer in answers:
            self._now_ns = max(self._now_ns, answer.stamp_ns)
            entries += answer.entries
        return entries

    def made(
        self,
        kind: type[Tree],
        one: DatumRead,
        children: tuple[Tree, ...] = (),
        *,
        elsewhere: bool = False,
        unfollowed: int = 0,
    ) -> Tree:
        """Return a version as a part of a tree."""
        slot, version, stamp_ns = one
        entry, cause = self._known.get(one), self._cause(one)
        nothing = NULL if not version else self.missing if entry is None else UNKNOWN
        return kind(
            world=slot.context,
            entity=Entity(slot.entity),
            aspect=slot.aspect,
            version=version,
            position=Position(stamp_ns, self.shard_of(slot)),
            age_s=max(0, self._now_ns - stamp_ns) / 1e9 if stamp_ns else 0.0,
            kind=cause.kind or nothing,
            actor=cause.actor,
            host=cause.host,
            pid=cause.pid,
            stamp_ns=entry.state.captured_ns if entry is not None else 0,
            held_s=cause.held_ns / 1e9,
            null_reason=reason_of(entry.state) if entry is not None else "",
            left_out=self._left_out.get(one, 0),
            elsewhere=elsewhere,
            unfollowed=unfollowed,
            children=children,
        )


def _read_of(entry: VersionEntry) -> DatumRead:
    return DatumRead(*entry.state[:3])


def in_order_read(by: DatumRead, reads: Iterable[DatumRead]) -> list[DatumRead]:
    """Return what a version was made of, in the order in which a tree shows it."""
    return sorted(reads, key=partial(_as_read, by))


def in_order_made(made: Iterable[DatumRead]) -> list[DatumRead]:
    """Return what was made from a version, in the order in which a tree shows it."""
    return sorted(made, key=_as_made)


def _as_read(by: DatumRead, read: DatumRead) -> tuple[object, ...]:
    """Order what a version was made of: by name, the version that it replaced last."""
    return read.slot == by.slot, *_as_named(read.slot), read.stamp_ns


def _as_made(made: DatumRead) -> tuple[object, ...]:
    """Order what came of a version: by time."""
    return made.stamp_ns, *_as_named(made.slot)


def _as_named(slot: Slot) -> Iterator[list[str | int]]:
    """Order names as people do: number 10 after number 9."""
    for name in (slot.context, slot.entity, slot.aspect):
        yield [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]
