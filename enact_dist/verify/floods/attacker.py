"""A client that keeps no rule: one session of its own, and ways to send anything at once."""

from __future__ import annotations

import socket
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.datum import LockId
from enact_dist.core.protocol.messages import Acquire, AwaitStamp, Item, Request, TakeView, Welcome
from enact_dist.terms import Access
from enact_dist.verify.floods.raw import WINDOW, RawSocket, RawZenoh, fresh_session, hello
from enact_dist.verify.floods.victim import HELD, KEPT, WORLD

if TYPE_CHECKING:
    from collections.abc import Iterable

    from enact_dist.config.types import CellConfig

FIRST: Final = "left"
"""The shard on which everything of the honest client lies."""
SECOND: Final = "right"
HOLD_NS: Final = 60_000_000_000


@dataclass(slots=True)
class Attacker:
    """A hostile client with one session of its own, to begin with.

    Attributes:
        config: The cell.
        zenoh: Its way to all shards.
        welcome: The first shard's answer to its hello.
        session: Its own.
        victim: The honest client's session.
        tally: Outcomes of its messages.
        heard: Messages that it received but should not have.
        open: Sockets that it keeps open.
    """

    config: CellConfig
    zenoh: RawZenoh
    welcome: Welcome
    session: str
    victim: str
    tally: Counter[str]
    heard: Counter[str] = field(default_factory=Counter)
    open: list[socket.socket | RawSocket] = field(default_factory=list)
    number: int = 0

    def next_lock(self, *, lane: int = 0) -> LockId:
        """Return a lock of its own session that was not asked for yet."""
        self.number += 1
        return LockId(self.session, lane, self.number)

    def acquire(self, items: tuple[Item, ...], lock: LockId, *, wait_ns: int = 0) -> Acquire:
        """Return a request for a lock of its own session."""
        version = self.welcome.placement.version
        return Acquire(lock, self.welcome.epoch, version, 0, items, wait_ns, HOLD_NS, 0)

    def view(self, lock: LockId, *, seen_ns: int = 0, at_ns: int = 0) -> TakeView:
        """Return a request for a view of the datum that the victim holds."""
        item = Item(int(Access.VIEW), WORLD, HELD.name, KEPT.name)
        epoch, version = self.welcome.epoch, self.welcome.placement.version
        return TakeView(lock, epoch, version, 0, (item,), seen_ns, at_ns)

    def post(self, *messages: Request) -> None:
        """Send messages to the first shard, some under way at once."""
        for message in messages:
            self.zenoh.post(FIRST, message)

    def park(self, messages: Iterable[Request]) -> None:
        """Send requests that are answered late, at most as many at once as the shard accepts."""
        for number, message in enumerate(messages):
            self.zenoh.post(FIRST, message, parked=True)
            if number % WINDOW == 0:
                self.zenoh.ask(FIRST, AwaitStamp(0, 0))


def line_of(attacker: Attacker) -> RawSocket:
    """Return a connection to the first shard that is open for a session of its own."""
    session = fresh_session()
    line = RawSocket(attacker.welcome, attacker.tally, session)
    line.ask(hello(session))
    return line
