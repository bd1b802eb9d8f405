"""A simulated PostgreSQL with a synchronous standby, as far as the row of a shard depends on it.

A write waits for the row, is executed, and is confirmed once the standby has it; only then others
see it, unless its connection breaks: then it stands, seen by all, and perhaps on one host alone.  A
failover keeps what the standby has: all that was confirmed, and perhaps more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

from enact_dist.core.failover.lease import HolderRow
from enact_dist.core.protocol.records import Persist
from enact_dist.verify.simulation.hosts.world import MS, Host, SimulatedWorld

ARRIVES = 0.5
"""Share of the statements that arrive although their connection broke on the way."""
NOTICES_NS = 1_000 * MS
"""How long the server takes to notice that a client is gone."""


class RowChange(NamedTuple):
    """What one committed transaction left: the row, and new records."""

    row: HolderRow
    persists: tuple[Persist, ...] = ()


class StatementDone(NamedTuple):
    """A statement was executed.

    Attributes:
        row: The row that it has left or read; None: its condition did not hold.
        warned: The wait for the standby was cancelled, which the server reports as success.
    """

    row: HolderRow | None
    warned: bool = False


@dataclass(slots=True, eq=False)
class _Write:
    line: SimulatedLink
    make: Callable[[HolderRow], RowChange | None]
    done: Callable[[StatementDone], None]
    position: int = 0


@dataclass(slots=True, eq=False)
class Primary:
    """One host that takes writes, or still believes that it does."""

    log: list[RowChange]
    on_standby: int = 0
    seen: int = 0
    alone: bool = False
    cut_off: bool = False
    waiting: list[_Write] = field(default_factory=list)
    busy: _Write | None = None


class SimulatedLink:
    """A connection of a daemon to a primary.  `broken` is called once when it is lost."""

    def __init__(
        self, primary: Primary, host: Host, broken: Callable[[SimulatedLink], None]
    ) -> None:
        self.primary, self.host, self.open = primary, host, True
        self._broken = broken

    def lose(self) -> None:
        """Break, and let the daemon know."""
        if self.open:
            self.open = False
            self.host.receive(partial(self._broken, self))


class SimulatedDatabase:
    """The database of one shard, its primary and what becomes of it."""

    def __init__(self, world: SimulatedWorld, name: str) -> None:
        self.world, self.name = world, name
        self._luck = world.schedule.stream(f"{name} on its way")
        self.primary: Primary | None = Primary(
            [RowChange(HolderRow(0, 0, 0, ""))], on_standby=1, seen=1
        )
        self._stalled_until_ns = 0
        self._connections: list[SimulatedLink] = []
        self._barred: dict[str, int] = {}
        self._deaf: dict[str, int] = {}
        self._standby_lost = False

    # ---------------------------------------------------------------- what daemons do

    def connect(self, host: Host, broken: Callable[[SimulatedLink], None]) -> SimulatedLink | None:
        """Connect to the host that takes writes; None: there is none now."""
        if self.primary is None or self._barred.get(host.name, 0) > self.world.now_ns:
            return None
        self._connections = [line for line in self._connections if line.open]
        line = SimulatedLink(self.primary, host, broken)
        self._connections.append(line)
        return line

    def read(
        self, line: SimulatedLink, done: Callable[[HolderRow, tuple[Persist, ...]], None]
    ) -> None:
        """Read the row and all records that can be seen."""

        def answer() -> None:
            seen = line.primary.log[: line.primary.seen]
            persists = tuple(persist for change in seen for persist in change.persists)
            self._answer(line, partial(done, seen[-1].row, persists))

        self._on_way(line, answer)

    def write(
        self,
        line: SimulatedLink,
        make: Callable[[HolderRow], RowChange | None],
        done: Callable[[StatementDone], None],
    ) -> None:
        """RowChange the row and add records, if `make` finds the row as it must be."""
        write = _Write(line, make, done)

        def arrive() -> None:
            line.primary.waiting.append(write)
            self._go_on(line.primary)

        self._on_way(line, arrive)

    def _on_way(self, line: SimulatedLink, act: Callable[[], None]) -> None:
        """Bring a statement to the server: if the line breaks meanwhile, it arrives or not."""

        def arrive() -> None:
            if line.open or self._luck.random() < ARRIVES:
                act()

        self.world.after(self._luck.randrange(MS // 10, 2 * MS), arrive)

    def _answer(self, line: SimulatedLink, act: Callable[[], None]) -> None:
        def come() -> None:
            if line.open:
                line.host.receive(lambda: act() if line.open else None)

        waits_ns = max(0, self._deaf.get(line.host.name, 0) - self.world.now_ns)
        self.world.after(waits_ns + self._luck.randrange(MS // 10, 2 * MS), come)

    # ---------------------------------------------------------------- one host

    def _go_on(self, primary: Primary) -> None:
        """Execute the next write that waits for the row."""
        while primary.busy is None and primary.waiting:
            write = primary.waiting.pop(0)
            change = write.make(primary.log[-1].row)
            if change is None:
                self._answer(write.line, partial(write.done, StatementDone(None)))
                continue
            primary.log.append(change)
            write.position = len(primary.log)
            primary.busy = write
            if not write.line.open:
                self.world.after(NOTICES_NS, partial(self._let_go, primary, write))
            self._replicate(primary, write.position)

    def _replicate(self, primary: Primary, position: int) -> None:
        """Bring the log up to a position to the standby, if there is one that can be reached."""
        if primary.alone and not primary.cut_off:
            self._flushed(primary, position)
            return
        waits_ns = max(self._stalled_until_ns - self.world.now_ns, 0)
        flushed = partial(self._replicated, primary, position)
        self.world.after(waits_ns + self._luck.randrange(MS // 2, 4 * MS), flushed)

    def _replicated(self, primary: Primary, position: int) -> None:
        if primary.cut_off:
            return
        if self._stalled_until_ns > self.world.now_ns:
            self._replicate(primary, position)
        else:
            self._flushed(primary, position)

    def _flushed(self, primary: Primary, position: int) -> None:
        primary.on_standby = max(primary.on_standby, min(position, len(primary.log)))
        write = primary.busy
        if write is not None and write.position <= primary.on_standby:
            self._confirm(primary, write)

    def _confirm(self, primary: Primary, write: _Write) -> None:
        change = primary.log[write.position - 1]
        if write.line.open:
            self._answer(write.line, partial(write.done, StatementDone(change.row)))
        self._let_go(primary, write)

    def _let_go(self, primary: Primary, write: _Write) -> None:
        """Let others see a write, and the next one have the row."""
        if primary.busy is write:
            primary.busy = None
            primary.seen = write.position
            self._go_on(primary)

    # ---------------------------------------------------------------- faults

    def stall(self, duration_ns: int) -> None:
        """Let the standby take nothing for a while."""
        self._stalled_until_ns = max(self._stalled_until_ns, self.world.now_ns + duration_ns)
        self.world.tally["standby of the database stalls"] += 1

    def cut(self, host: Host) -> int:
        """Break the connections of one daemon; return how many."""
        lines = [line for line in self._connections if line.open and line.host is host]
        for line in lines:
            self._break(line)
        self.world.tally["connections cut"] += len(lines)
        return len(lines)

    def deafen(self, host: Host, until_ns: int) -> None:
        """Let answers reach one daemon only from a moment of true time on."""
        self._deaf[host.name] = until_ns
        self.world.tally["answers of the database held up"] += 1

    def bar(self, host: Host, until_ns: int) -> None:
        """Let one daemon reach the database no more, up to a moment of true time."""
        self._barred[host.name] = until_ns
        self.cut(host)
        self.world.tally["daemons cut off from the database"] += 1

    def _break(self, line: SimulatedLink) -> None:
        line.lose()
        write = line.primary.busy
        if write is not None and write.line is line:
            self.world.after(NOTICES_NS, partial(self._let_go, line.primary, write))

    def cancel(self) -> bool:
        """Cancel the wait for the standby: the server reports success, with a warning."""
        primary = self.primary
        write = primary.busy if primary is not None else None
        if primary is None or write is None:
            return False
        row = primary.log[write.position - 1].row
        self._answer(write.line, partial(write.done, StatementDone(row, warned=True)))
        self._let_go(primary, write)
        self.world.tally["waits for the standby cancelled"] += 1
        return True

    def lose_standby(self, *, noticed_ns: int, back_ns: int) -> bool:
        """Lose the standby: the manager notices, goes on with one copy, and gets another."""
        primary = self.primary
        if primary is None or primary.alone or self._standby_lost:
            return False
        self._standby_lost = True
        self.stall(noticed_ns + back_ns)
        self.world.after(noticed_ns, partial(self._goes_alone, primary))
        self.world.after(noticed_ns + back_ns, partial(self._has_standby, primary))
        self.world.tally["standbys of the database lost"] += 1
        return True

    def _goes_alone(self, primary: Primary) -> None:
        if primary is self.primary:
            primary.alone = True
            self._flushed(primary, len(primary.log))

    def _has_standby(self, primary: Primary) -> None:
        if primary is self.primary:
            self._flushed(primary, len(primary.log))
            primary.alone = self._standby_lost = False

    def fail_over(self, *, away_ns: int, back_ns: int, still: Sequence[Host]) -> bool:
        """Lose the primary: after a while the standby takes writes, with what it has.

        Args:
            away_ns: How long there is none.
            back_ns: How long the new one goes on with one copy.
            still: Daemons that stay connected to the old one, which is cut off from its standby.
        """
        old = self.primary
        if old is None or old.alone or self._standby_lost:
            return False
        self.primary = None
        old.cut_off = True
        for line in self._connections:
            if line.primary is old and line.host not in still:
                self._break(line)
        self.world.after(away_ns, partial(self._promote, old, back_ns))
        self.world.tally["failovers of the database"] += 1
        return True

    def _promote(self, old: Primary, back_ns: int) -> None:
        kept = old.on_standby
        self.world.tally["changes that a failover lost"] += len(old.log) - kept
        self.primary = Primary(old.log[:kept], on_standby=kept, seen=kept, alone=True)
        self.world.after(back_ns, partial(self._has_standby, self.primary))
        for line in self._connections:
            if line.primary is old:
                self.world.after(self._luck.randrange(3_000 * MS), partial(self._break, line))

    # ---------------------------------------------------------------- the end

    def persists(self) -> list[Persist]:
        """Return everything that the database was asked to keep and has now, in order."""
        assert self.primary is not None
        return [persist for change in self.primary.log for persist in change.persists]
