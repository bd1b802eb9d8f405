"""Who else writes what a replay writes: actors that run in the cell, and whatever has done so.

A replay beside the actor that was recorded makes two writers of one slot, and neither finds out: a
detector looks at replayed images and writes its masks between the replayed ones.  Before the first
commit the cell's actors are asked what they declare to write; during the replay each slot is
compared, where it is locked again, with what the replay itself has set there last.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final

from enact_dist.actor.report import read_reports
from enact_dist.core.protocol.datum import Slot
from enact_dist.errors import EnactError, ProtocolError
from enact_dist.patterns import pattern_matches
from enact_dist.world.version_data import Wanted, explained

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator

    from enact_dist.access.session import Session
    from enact_dist.core.client.lock import MultiLock
    from enact_dist.core.client.plan import Reading
    from enact_dist.world.cell import Cell
    from enact_dist.world.listings import ActorInfo

NAMED_MAX: Final = 3
"""So many slots of one writer are named, the others counted."""

_log = logging.getLogger("enact.recording")


class OtherWriters:
    """Slots with other writers; reported before the first commit, and once when they write.

    Attributes:
        found: Who else writes a slot, by its name; declared, or seen to have done so.
    """

    def __init__(self, warn: Callable[[str], None] = _log.warning) -> None:
        self.found: dict[str, str] = {}
        self._warn = warn
        self._made: dict[Slot, int] = {}
        self._seen: set[Slot] = set()

    def look_at_actors(self, cell: Cell, slots: Callable[[], Collection[Slot]]) -> None:
        """Warn of actors that run and declare to write some of these slots.

        Args:
            cell: Whose actors.
            slots: Returns what will be written; called only where an actor writes anything.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        writers = [(info, name, write) for info in cell.actors() for name, write in _writes(info)]
        written = slots() if writers else ()
        by_actor: dict[str, list[Slot]] = {}
        for info, name, (context, entities, aspect) in writers:
            who = f"actor {name} (process {info.pid} on {info.host})"
            by_actor.setdefault(who, []).extend(
                slot
                for slot in written
                if (slot.context, slot.aspect) == (context, aspect)
                and pattern_matches(entities, slot.entity)
            )
        for who, both in by_actor.items():
            if both:
                self.found |= dict.fromkeys(map(str, both), who)
                self._warn(
                    f"{who} is running and also writes {_named(both)}: readers will see its data"
                    " between the replayed ones; stop it, exclude these data (--entities,"
                    " --aspect), or replay into another world context (--world OLD=NEW)"
                )

    def look_at(self, session: Session, lock: MultiLock) -> None:
        """Warn of slots of a granted lock that another client wrote after the replay."""
        for reading in lock.states:
            state = reading.state
            made_ns = self._made.get(state.slot, 0)
            if made_ns and state.stamp_ns > made_ns and state.slot not in self._seen:
                who = _who(session, reading)
                self._seen.add(state.slot)
                self.found[str(state.slot)] = who
                self._warn(
                    f"{who} has written {state.slot} (v{state.version}) during the replay: readers"
                    " see its data between the replayed ones"
                )

    def committed(self, lock: MultiLock) -> None:
        """Note what the replay itself has written."""
        position = lock.position
        if position is not None:
            slots = (reading.state.slot for reading in lock.states)
            self._made |= dict.fromkeys(slots, position.stamp_ns)


def _writes(info: ActorInfo) -> Iterator[tuple[str, tuple[str, str, str]]]:
    """Yield what the actors of a session declare to write: context, entities, aspect."""
    if info.silent:
        return
    try:
        reports = read_reports(info.report)
    except ProtocolError:
        return  # a session that reports something of its own
    for report in reports:
        for text in report.writes if report.name in info.names() else ():
            context, _, slot = str(text).partition(":")
            entities, slash, aspect = slot.rpartition("/")
            if slash:
                yield report.name, (context, entities, aspect)


def _who(session: Session, reading: Reading) -> str:
    """Return who committed a version, as far as its shard still knows."""
    state = reading.state
    wanted = Wanted(state.stamp_ns, state.slot, state.version, reading.shard)
    try:
        entry = explained(session, [wanted]).get(wanted)
    except EnactError:  # the warning matters, not the name in it: the replay goes on
        entry = None
    if entry is None or entry.cause is None:
        return "another process"
    cause = entry.cause
    name = f"actor {cause.actor}" if cause.actor else "a client"
    return f"{name} (process {cause.pid} on {cause.host})"


def _named(slots: Iterable[Slot]) -> str:
    names = sorted(map(str, slots))
    more = len(names) - NAMED_MAX
    return ", ".join(names[:NAMED_MAX]) + (f" and {more} more" if more > 0 else "")
