"""The network: every message passes the real wire format, and what goes wrong goes wrong here.

Besides its steady losses, duplicates and delays, the network sets off faults on *decisive*
messages: the moments in which the protocol changes hands.  Faults that only come with time miss
those moments.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar, cast

from enact_dist.core import messages as m

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.verify.simulation.faults import Faults
    from enact_dist.verify.simulation.world import Host, World

from enact_dist.verify.simulation.world import MS

SomeMessage = TypeVar("SomeMessage", bound=m.Message)

DECISIVE = (
    m.Hello,
    m.Welcome,
    m.Acquire,
    m.Granted,
    m.KeepAlive,
    m.Alive,
    m.Commit,
    m.Committed,
    m.Outcome,
    m.OutcomeIs,
    m.Validate,
    m.Valid,
    m.Prepare,
    m.Prepared,
    m.Finish,
    m.Finished,
    m.Resolve,
    m.Resolved,
    m.Release,
    m.EpochChanged,
)


class Network:
    """Moves messages between hosts, badly."""

    def __init__(self, world: World, faults: Faults, *, through_wire: bool) -> None:
        self._world = world
        self.faults = faults
        self._through_wire = through_wire
        self._cuts: dict[tuple[str, str], int] = {}
        self.set_off: Callable[[Host, Host], int | None] = lambda _source, _target: 0
        self.before_decision: Callable[[m.Commit, Host], None] = lambda _commit, _target: None

    def cut(self, source: Host, target: Host, *, duration_ns: int) -> None:
        """Let nothing pass from one host to another for a while."""
        until_ns = self._world.now_ns + duration_ns
        pair = (source.name, target.name)
        self._cuts[pair] = max(until_ns, self._cuts.get(pair, 0))

    def is_cut(self, source: Host, target: Host) -> bool:
        """Whether nothing passes from one host to another."""
        return self._cuts.get((source.name, target.name), 0) > self._world.now_ns

    def heal(self, faults: Faults) -> None:
        """End all partitions and go on with these faults."""
        self._cuts.clear()
        self.faults = faults

    def send(
        self, source: Host, target: Host, message: SomeMessage, take: Callable[[SomeMessage], None]
    ) -> None:
        """Try to bring `message` to `target`, which then does `take` with it."""
        world, faults, random = self._world, self.faults, self._world.random
        world.tally["messages"] += 1
        if self._through_wire:
            message = passed_through_wire(message)
        late_ns: int | None = 0
        if isinstance(message, m.Commit) and message.participants:
            self.before_decision(message, target)
        decisive = faults.triggered and isinstance(message, DECISIVE)
        if decisive and random.random() < faults.triggered:
            late_ns = self.set_off(source, target)
        if self.is_cut(source, target):
            world.tally["cut"] += 1
            return
        if late_ns is None or (faults.loss and random.random() < faults.loss):
            world.tally["lost"] += 1
            return
        copies = 1
        if faults.duplication and random.random() < faults.duplication:
            copies = 2
            world.tally["duplicated"] += 1
        for _ in range(copies):
            delay_ns = late_ns + random.randrange(MS // 10, 2 * MS)
            if faults.delay and random.random() < faults.delay:
                delay_ns += int(random.expovariate(1 / 0.8) * 1e9)
                world.tally["delayed"] += 1
            world.after(delay_ns, lambda: target.receive(lambda: take(message)))


def passed_through_wire(message: SomeMessage) -> SomeMessage:
    """Return the message as its receiver reads it from the bytes."""
    from enact_dist.wire.frames import decode_frame, encode_frame

    header, payload = encode_frame(message)
    return cast("SomeMessage", decode_frame(header, b"" if payload is None else payload))
