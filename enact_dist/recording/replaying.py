"""Commits a recording again: the same data in the same groups and order, at their pace.

Encoded data go as they are, so no type has to be known here; worlds and aspects are made as the
recording names them.  Versions and stamps are those of the new commits; capture stamps stay.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from enact_dist.config.table import suggestion
from enact_dist.core.protocol.datum_types import succeeds, type_conflict
from enact_dist.core.protocol.messages import AspectEntry
from enact_dist.errors import ConfigError, DatumTypeError, MisuseError
from enact_dist.patterns import pattern_matches
from enact_dist.recording.other_writers import OtherWriters
from enact_dist.recording.reading import RecordedCommit, Recording
from enact_dist.terms import Entities, checked_name
from enact_dist.wire.limits import BODY_BYTES_MAX, ITEMS_MAX
from enact_dist.world.cell import session_behind
from enact_dist.world.version_data import set_encoded

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from enact_dist.access.session import Session
    from enact_dist.core.client.lock import MultiLock
    from enact_dist.core.protocol.datum import Slot
    from enact_dist.recording.exact import Recorded
    from enact_dist.world.cell import Cell
    from enact_dist.world.context import WorldContext

WAIT_S: Final = 10.0
HOLD_S: Final = 60.0
LATE_S: Final = 0.05
"""A commit that comes later than this counts as late."""
BYTES_PER_LOCK: Final = BODY_BYTES_MAX


@dataclass(slots=True)
class ReplaySummary:
    """What a replay has done.

    Attributes:
        seconds: How long it took.
        commits: Commits made; what was there at the recording's begin does not count as one.
        versions: Data set, nulls too.
        late: Commits that came more than `LATE_S` after their time.
        late_s_max: How late the latest one was.
        rounds: How often the recording was gone through whole.
        missing_bytes: What follows its last whole chunk; 0 where it was ended whole.
        gaps: Versions that the recording itself does not have, where it was ended whole.
        whole: Whether it was ended whole.
        other_writers: Who else writes a slot that was replayed, by its name.
    """

    path: str
    seconds: float = 0.0
    commits: int = 0
    versions: int = 0
    late: int = 0
    late_s_max: float = 0.0
    rounds: int = 0
    missing_bytes: int = 0
    gaps: int = 0
    whole: bool = False
    other_writers: dict[str, str] = field(default_factory=dict)


class Replay:
    """Commits a recording into a cell.

    Args:
        cell: The cell.
        path: The recording.
        worlds: Names of world contexts of the recording, and what each is called in the cell;
            what is not named keeps its name.
        only_worlds: Replay only these world contexts of the recording; none means all.
        entities: Replay only data of these entities.
        aspects: Replay only these aspects, by name; none means all.
        speed: How much faster than it was recorded; 0: as fast as possible.
        overwrite: Also write into world contexts that have data.

    Raises:
        ConfigError: The file is no recording, `speed` makes no sense, `worlds` or `only_worlds`
            names what the recording does not have, or `worlds` what cannot be a name, or one name
            for two.
    """

    def __init__(
        self,
        cell: Cell,
        path: str | os.PathLike[str],
        *,
        worlds: Mapping[str, str] | None = None,
        only_worlds: Iterable[str] = (),
        entities: Entities | str = "**",
        aspects: Iterable[str] = (),
        speed: float = 1.0,
        overwrite: bool = False,
    ) -> None:
        if not 0.0 <= speed < float("inf"):
            raise ConfigError(f"speed {speed!r} is none; 0 means as fast as possible")
        self._cell = cell
        self.recording = Recording(path)
        self._worlds = dict(worlds or {})
        self._only = frozenset(only_worlds)
        self._entities, self._aspects = str(Entities(str(entities))), frozenset(aspects)
        self._speed = speed
        self._from_ns = self._to_ns = 0
        self._overwrite = overwrite
        self._sessions: dict[str, Session] = {}
        self._registered: set[str] = set()
        self._others = OtherWriters()
        self.summary = ReplaySummary(str(path))
        self._check_names(self.recording.facts.get("worlds", "").split())

    def _check_names(self, known: Sequence[str]) -> None:
        """Refuse names that the recording does not have, and those that cannot be taken."""
        path = self.recording.path
        for name in (*self._worlds, *sorted(self._only)):
            if name not in known:
                raise ConfigError(
                    f"{path} has no world context {name!r}; it has {', '.join(known) or 'none'}"
                )
        for new in self._worlds.values():
            try:
                checked_name("world context", new, slashes=False)
            except ValueError as error:
                raise ConfigError(str(error)) from None
        chosen = [name for name in known if name in self._only or not self._only]
        called = [self._worlds.get(name, name) for name in chosen]
        twice = next((new for new in called if called.count(new) > 1), None)
        if twice is not None:
            both = ", ".join(name for name, new in zip(chosen, called, strict=True) if new == twice)
            raise ConfigError(f"{both} of {path} would all be written into {twice!r}; name others")

    def between(self, from_ns: int, to_ns: int = 0) -> None:
        """Take a part of the recording only.

        Args:
            from_ns: Where to begin, with the state as of that stamp; 0: at the begin.
            to_ns: Stamp of the last commit; 0: at the end.

        Raises:
            ConfigError: The end lies before the begin.
        """
        if to_ns and to_ns < from_ns:
            before_s = (from_ns - to_ns) / 1e9
            raise ConfigError(f"nothing to replay: the end lies {before_s:.3g} s before the begin")
        self._from_ns, self._to_ns = from_ns, to_ns

    def run(
        self,
        stop: threading.Event | None = None,
        *,
        loop: bool = False,
        tell: Callable[[ReplaySummary], None] = lambda _: None,
        warn: Callable[[str], None] | None = None,
        show: Callable[[str], None] = lambda _: None,
    ) -> ReplaySummary:
        """Commit all that was chosen, or until `stop` is set; each commit is atomic.

        Args:
            stop: Ends the replay.
            loop: Start again at the end.
            tell: Called after each commit.
            warn: Called with a sentence for each slot that has other writers; None: a
                warning of the log.
            show: Called with a line about the recording and its target, before any commit.

        Raises:
            ConfigError: The recording has no such aspect.
            MisuseError: A world context has data, and `overwrite` was not asked; none is made.
            ProtocolError: The recording holds data that this version cannot read.
            LockTimeoutError: Another client holds the data.
            DatumTypeError: The cell knows an aspect with another type; no world context is made.
        """
        stop = stop or threading.Event()
        show(self._told(self._check()))
        self._others = OtherWriters(warn) if warn is not None else OtherWriters()
        self._others.look_at_actors(self._cell, self._slots)
        self.summary.other_writers = self._others.found
        begun_s = time.monotonic()
        while not stop.is_set():
            self._once(stop, tell)
            if not stop.is_set():
                self.summary.rounds += 1
            if not loop or not self.summary.versions:
                break
        summary, recording = self.summary, self.recording
        summary.seconds = time.monotonic() - begun_s
        if summary.rounds:
            summary.missing_bytes, summary.whole = recording.missing_bytes, recording.whole
            summary.gaps = int(recording.end.get("missing", "0"))
        return summary

    def _once(self, stop: threading.Event, tell: Callable[[ReplaySummary], None]) -> None:
        begun_s = first_ns = 0.0
        # Who begins before the recording does not wait for it.
        begins = self._from_ns > int(self.recording.facts.get("begin_ns", "0"))
        for commit in self._chosen():
            if commit.number and not first_ns:
                begun_s, first_ns = time.monotonic(), self._from_ns if begins else commit.log_ns
            if self._speed and commit.number:
                due_s = begun_s + (commit.log_ns - first_ns) / 1e9 / self._speed
                if stop.wait(max(0.0, due_s - time.monotonic())):
                    return
                late_s = time.monotonic() - due_s
                self.summary.late += late_s > LATE_S
                self.summary.late_s_max = max(self.summary.late_s_max, late_s)
            elif stop.is_set():
                return
            for part in _parts(commit.versions):
                self._commit(part)
            self.summary.commits += commit.number > 0
            tell(self.summary)

    def _chosen(self) -> Iterator[RecordedCommit]:
        """Yield what is to be committed; first the state as of the begin, where one is named."""
        before: dict[Slot, Recorded] = {}
        for commit in self._wanted():
            if commit.log_ns < self._from_ns:
                before.update((recorded.slot, recorded) for recorded in commit.versions)
                continue
            if before:
                yield RecordedCommit(0, self._from_ns, tuple(before.values()))
                before = {}
            if self._to_ns and commit.log_ns > self._to_ns:
                continue  # a later one may stand before it in the file
            yield commit
        if before:
            yield RecordedCommit(0, self._from_ns, tuple(before.values()))

    def _wanted(self) -> Iterator[RecordedCommit]:
        """Yield the commits with those of their data that were chosen, if any."""
        for commit in self.recording.commits():
            versions = tuple(one for one in commit.versions if self._wants(one.slot))
            if versions:
                yield commit._replace(versions=versions)

    def _wants(self, slot: Slot) -> bool:
        return (
            (not self._only or slot.context in self._only)
            and (not self._aspects or slot.aspect in self._aspects)
            and pattern_matches(self._entities, slot.entity)
        )

    def _slots(self) -> set[Slot]:
        """Return every slot that will be written; reads the recording through."""
        slots = {one.slot for commit in self._chosen() for one in commit.versions}
        return {s._replace(context=self._worlds.get(s.context, s.context)) for s in slots}

    # ---------------------------------------------------------------- one commit

    def _commit(self, versions: Sequence[Recorded]) -> None:
        """Commit data under one lock."""
        data = {self._slot(recorded.slot): recorded.datum for recorded in versions}
        session = next(iter(self._sessions.values()))
        prepared = session.client.catalogue.lapses
        self._register(session, versions)

        def granted(lock: MultiLock) -> None:
            self._others.look_at(session, lock)
            if session.client.catalogue.lapses != prepared:  # a restarted shard forgot an aspect
                self._registered.clear()
                self._register(session, versions)

        lock = set_encoded(session.client, data, wait_s=WAIT_S, hold_s=HOLD_S, granted=granted)
        self._others.committed(lock)
        self.summary.versions += len(versions)

    def _slot(self, slot: Slot) -> Slot:
        name = self._worlds.get(slot.context, slot.context)
        if name not in self._sessions:
            self._sessions[name] = self._opened(name)
        return slot._replace(context=name)

    def _opened(self, name: str) -> Session:
        """Return the session of a world context, made if there is none; refuse one with data."""
        world = self._cell.create_world(name)
        self._refuse_data(world)
        return world.session

    # ---------------------------------------------------------------- before anything is made

    def _told(self, worlds: Iterable[str]) -> str:
        """Return a line on the recording and on what of it is to be set."""
        recording, aspects = self.recording, self._aspects or self.recording.aspects.keys()
        called = [f"{old} as {self._worlds.get(old, old)}" for old in sorted(worlds)]
        entities = "" if self._entities == "**" else f" of entities {self._entities}"
        return (
            f"{recording.path}: {recording.path.stat().st_size} bytes of cell"
            f" {recording.facts.get('cell', '?')!r}; sets in cell {self._cell.name!r}:"
            f" {', '.join(called) or 'nothing'}; aspects {', '.join(sorted(aspects)) or 'none'}"
            f"{entities}"
        )

    def _check(self) -> Iterable[str]:
        """Refuse what cannot be replayed while the cell is as it was; return its contexts."""
        names = self.recording.look_through()
        aspects = self.recording.aspects
        for name in sorted(self._aspects - aspects.keys()):
            raise ConfigError(
                f"{self.recording.path} has no aspect {name!r}{suggestion(name, aspects)}; it has"
                f" {', '.join(sorted(aspects)) or 'none'}"
            )
        if self._only:
            names = names & self._only
        there = self._cell.worlds()
        for name in sorted(self._worlds.get(name, name) for name in names):
            if name in there and name not in self._sessions:  # a second run has data of the first
                self._refuse_data(self._cell.world(name))
        types = session_behind(self._cell).registered()
        for name, facts in aspects.items():
            if name not in types or (self._aspects and name not in self._aspects):
                continue
            # Data of an older type are read with the defaults, whatever was written before.
            wanted = AspectEntry(name, facts.fingerprint, "", reads=True)
            if type_conflict(types[name], wanted):
                raise DatumTypeError(
                    f"aspect {name!r} is {facts.fingerprint} in {self.recording.path} and"
                    f" {types[name].fingerprint} in cell {self._cell.name!r}: no program there"
                    " could read what a replay sets"
                )
        return names

    def _refuse_data(self, world: WorldContext) -> None:
        if self._overwrite:
            return
        found = [info for info in world.list_slots() if not info.null_reason]
        if found:
            old = self._recorded(world.name)
            raise MisuseError(
                f"world context {world.name!r} of cell {self._cell.name!r} has {len(found)} data"
                f" ({found[0].entity}/{found[0].aspect} …), which a replay would change; take"
                f" another one (--world {old}=OTHER), or say that they may be overwritten"
                " (--overwrite)"
            )

    def _recorded(self, name: str) -> str:
        """Return what a world context of the cell is called in the recording."""
        return next((old for old, new in self._worlds.items() if new == name), name)

    def _register(self, session: Session, versions: Sequence[Recorded]) -> None:
        """Let the cell know the aspects, with the types that they were recorded with."""
        names = {recorded.slot.aspect for recorded in versions} - self._registered
        facts = {name: self.recording.aspects.get(name) for name in names}
        entries = [AspectEntry(name, f.fingerprint, f.durability) for name, f in facts.items() if f]
        if entries:
            session.client.greet()
            known = session.client.aspect_entries()
            session.client.register(aspects=[_as_known(e, known.get(e.name)) for e in entries])
        self._registered |= names


def _as_known(entry: AspectEntry, known: AspectEntry | None) -> AspectEntry:
    """Return the entry to register for recorded data where the cell knows the aspect so.

    What the cell says of durability holds; a newer type of the cell stays what it is.
    """
    if known is None:
        return entry
    older = succeeds(known.fingerprint, entry.fingerprint)
    return entry._replace(durability="", reads=older)


def _parts(versions: Sequence[Recorded]) -> Iterator[Sequence[Recorded]]:
    """Yield what one lock may write; only a whole context's first state is ever more than that."""
    part: dict[Slot, Recorded] = {}
    size = 0
    for recorded in versions:
        is_full = len(part) >= ITEMS_MAX or size + recorded.size > BYTES_PER_LOCK
        if part and (is_full or recorded.slot in part):
            yield tuple(part.values())
            part, size = {}, 0
        part[recorded.slot] = recorded
        size += recorded.size
    if part:
        yield tuple(part.values())
