"""The network: every message passes the real wire format, and what goes wrong goes wrong here.

Besides its steady losses, duplicates and delays, the network sets off faults on *decisive*
messages: the moments in which the protocol changes hands.  Faults that only come with time miss
those moments.  What befalls message 37 of a link is `c1-s0.37` in the schedule of faults.
"""

from __future__ import annotations

from functools import partial
from random import Random
from typing import TYPE_CHECKING, Protocol, TypeVar, cast

from enact_dist.core.protocol import messages as m

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.verify.simulation.faults import Faults
    from enact_dist.verify.simulation.hosts.world import Host, SimulatedWorld
    from enact_dist.verify.simulation.schedule import FaultPlace

from enact_dist.verify.simulation.hosts.world import MS

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


class SetOff(Protocol):
    """Carries out what a decisive message sets off."""

    def __call__(self, fault: str, luck: Random, source: Host, target: Host) -> int | None:
        """Let it happen; return how late the message is then, None if it is lost."""


class Network:
    """Moves messages between hosts, badly."""

    def __init__(self, world: SimulatedWorld, faults: Faults, *, through_wire: bool) -> None:
        self._world = world
        self._through_wire = through_wire
        self._cuts: dict[tuple[str, str], int] = {}
        self._links: dict[tuple[str, str], FaultPlace] = {}
        self.set_off: SetOff = lambda _fault, _luck, _source, _target: 0
        self.before_decision: Callable[[m.Commit, Host], None] = lambda _commit, _target: None
        self._set(faults)

    def _set(self, faults: Faults) -> None:
        # Shares become bounds of 16 bits of luck.
        shares = (faults.triggered, faults.loss, faults.duplication, faults.delay)
        self._bounds = tuple(int(share * 0x10000) for share in shares)
        self._perfect = not any(self._bounds)

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
        self._set(faults)

    def send(
        self, source: Host, target: Host, message: SomeMessage, take: Callable[[SomeMessage], None]
    ) -> None:
        """Try to bring `message` to `target`, which then does `take` with it."""
        world = self._world
        world.tally["messages"] += 1
        if self._through_wire:
            message = passed_through_wire(message)
        pair = (source.name, target.name)
        link = self._links.get(pair)
        if link is None:
            name = f"{source.name}-{target.name}"
            link = self._links[pair] = world.schedule.place(name)
        luck = link.next()
        if isinstance(message, m.Commit) and message.participants:
            self.before_decision(message, target)
        late_ns: list[int] = (
            [0] if self._perfect else self._befalls(message, link, source, target, luck)
        )
        if self._cuts.get(pair, 0) > world.now_ns:
            world.tally["cut"] += 1
            return
        for more_ns in late_ns:
            luck >>= 16
            delay_ns = more_ns + MS // 10 + (luck & 0xFFFF) * (2 * MS) // 0x10000
            delivery = partial(self._deliver, link, link.number, target, take, message)
            world.after(delay_ns, delivery)

    def _befalls(
        self, message: m.Message, link: FaultPlace, source: Host, target: Host, luck: int
    ) -> list[int]:
        """Return how late each copy of a message is that arrives at all."""
        triggered, lost, doubled, late = (
            (luck >> shift & 0xFFFF) < bound
            for shift, bound in zip((112, 96, 80, 64), self._bounds, strict=True)
        )
        triggered = triggered and isinstance(message, DECISIVE)
        if not (triggered or lost or doubled or late):
            return [0]
        world, fault = self._world, link.fault
        if not world.schedule.allows(fault):
            return [0]
        if triggered:
            late_ns = self.set_off(fault, Random(luck), source, target)
            return [] if late_ns is None else [late_ns]
        kind = type(message).__name__
        if lost:
            world.tally["lost"] += 1
            world.befell(fault, f"{kind} is lost")
            return []
        more_ns = [0, 0] if doubled else [0]
        if doubled:
            world.tally["duplicated"] += 1
            world.befell(fault, f"{kind} comes twice")
            if isinstance(message, m.Commit) and message.keep:
                # Under a kept grant a copy does harm only once later locks have used it.
                more_ns[1] = int(Random(luck).expovariate(1 / 0.8) * 1e9)
        if late:
            world.tally["delayed"] += 1
            seconds = Random(luck).expovariate(1 / 0.8)
            more_ns[0] = int(seconds * 1e9)
            world.befell(fault, f"{kind} is {seconds:.2f} s late")
        return more_ns

    def _deliver(
        self,
        link: FaultPlace,
        number: int,
        target: Host,
        take: Callable[[SomeMessage], None],
        message: SomeMessage,
    ) -> None:
        if number < link.newest_delivered:
            self._world.tally["overtaken"] += 1
        else:
            link.newest_delivered = number
        target.receive(partial(take, message))


def passed_through_wire(message: SomeMessage) -> SomeMessage:
    """Return the message as its receiver reads it from the bytes."""
    from enact_dist.wire.frames import decode_frame, encode_frame

    header, payload = encode_frame(message)
    return cast("SomeMessage", decode_frame(header, b"" if payload is None else payload))
