"""What a flood consists of: one round each, to be repeated for as long as the honest client works.

Every attack is made of frames that any program can send which reaches the shard's port or socket.
`expected` are the names under which a shard refuses what is too much; one of them has to come.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

import msgpack

from enact_dist.core.datum import Datum, LockId, Position, Slot, Token
from enact_dist.core.messages import (
    Acquire,
    AspectEntry,
    AwaitStamp,
    Commit,
    Finish,
    Fork,
    Goodbye,
    Item,
    KeepAlive,
    LaneView,
    ListHistory,
    ListLocks,
    ListSessions,
    Locks,
    Prepare,
    Register,
    Release,
    Resolve,
    Survey,
    TakeView,
    WriteItem,
)
from enact_dist.errors import LinkError
from enact_dist.link.endpoints import split_endpoint
from enact_dist.link.socket_frames import MAGIC, STREAM_VERSION, Kind
from enact_dist.terms import Access
from enact_dist.verify.floods.raw import WINDOW, RawSocket, RawZenoh, fresh_session, hello
from enact_dist.verify.floods.victim import COUNT, HELD, KEPT, WORLD
from enact_dist.wire.frames import CODES
from enact_dist.wire.limits import FRAME_VERSION, INTEGER_MAX

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from enact_dist.config_types import CellConfig
    from enact_dist.core.messages import Request, Welcome

FIRST: Final = "left"
"""The shard on which everything of the honest client lies."""
SECOND: Final = "right"
LONG_NAME: Final = "a" * 150
WAIT_NS: Final = 25_000_000_000
HOLD_NS: Final = 60_000_000_000
REPORT: Final = b"\xc4\x10" + b"r" * 65_000
FRAME_BYTES: Final = 256 << 20


@dataclass(slots=True)
class Attacker:
    """A hostile client with one session of its own, to begin with.

    Attributes:
        config: The cell.
        zenoh: Its way to all shards.
        welcome: What the first shard said to its hello.
        session: Its own.
        victim: The honest client's session.
        tally: What its messages came to.
        heard: What it heard and should not have.
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
        """Send what is answered late, no more at once than the shard takes in."""
        for number, message in enumerate(messages):
            self.zenoh.post(FIRST, message, parked=True)
            if number % WINDOW == 0:
                self.zenoh.ask(FIRST, AwaitStamp(0, 0))


@dataclass(frozen=True, slots=True)
class Attack:
    """One kind of flood.

    Attributes:
        name: In the table.
        round: Done again and again.
        expected: Names of refusals, at least one of which the attacker has to get; none: it gets
            no answer at all.
        shards: How many the cell has.
        mode: Of the attacker's Zenoh session.
    """

    name: str
    round: Callable[[Attacker], None]
    expected: frozenset[str]
    shards: int = 1
    mode: str = "peer"


def _nothing(_: Attacker) -> None:
    """Leave everybody alone: what the other rows are compared with."""
    time.sleep(0.1)


# ---------------------------------------------------------------- questions that wait


def _parked(attacker: Attacker) -> None:
    """Ask what a shard answers later: on no session, and with 3,000 locks of one session.

    Without bounds each message walked over all of them: an update took 20 times as long, and with
    20,000 questions the shard answered no hello for 15 s.
    """
    soon_ns = time.time_ns() + 900_000_000
    attacker.park(AwaitStamp(stamp, WAIT_NS) for stamp in (soon_ns, INTEGER_MAX) * 1500)
    item = Item(int(Access.WRITE), WORLD, HELD.name, KEPT.name)
    attacker.park(
        attacker.acquire((item,), attacker.next_lock(lane=lane), wait_ns=WAIT_NS)
        for lane in range(1, 3000)
    )
    attacker.park(attacker.view(attacker.next_lock(), at_ns=soon_ns) for _ in range(300))


# ---------------------------------------------------------------- what a shard keeps


def _sessions(attacker: Attacker) -> None:
    """Open more sessions than a shard keeps.

    While all clients shared one bound, the shard refused everybody from then on, after a restart
    too.
    """
    for _ in range(12_000):
        attacker.post(hello(fresh_session()))
    attacker.zenoh.drain()


def _socket_sessions(attacker: Attacker) -> None:
    """Open a connection and a session again and again, up to 1,200 at once."""
    for _ in range(1500):
        _forget_half(attacker, kept_max=1200)
        session = fresh_session()
        with contextlib.suppress(OSError, LinkError):
            line = RawSocket(attacker.welcome, attacker.tally, session)
            attacker.open.append(line)
            if line.opened:
                line.ask(hello(session))


def _reports(attacker: Attacker) -> None:
    """Let 300 actors report 65 kB each.

    The listing of sessions was longer than a frame then and was not sent, so that `enact shard ls`
    called the shard unreachable.
    """
    sessions, epoch = [fresh_session() for _ in range(300)], attacker.welcome.epoch
    for known_epoch in (0, epoch):
        attacker.post(*(hello(session, known_epoch) for session in sessions))
        attacker.zenoh.drain()
    attacker.post(*(KeepAlive(session, epoch, 1, (), REPORT) for session in sessions))
    attacker.zenoh.drain()
    attacker.zenoh.ask(FIRST, ListSessions())
    attacker.post(*map(Goodbye, sessions))
    attacker.zenoh.drain()


def _registrations(attacker: Attacker) -> None:
    """Register worlds, aspects and fingerprints, and fork, without an end.

    Without bounds three messages made the shard's welcome longer than a frame: nobody could say
    hello any more, after a restart neither.
    """
    for _ in range(3):
        attacker.number += 1
        worlds = tuple(f"w{attacker.number}x{index}" for index in range(40_000))
        attacker.post(Register(attacker.session, worlds, ()))
    for _ in range(3):
        attacker.number += 1
        entries = tuple(
            AspectEntry(f"f{attacker.number}x{index}", f"{index}" + "t" * 60_000, "durable")
            for index in range(100)
        )
        attacker.post(Register(attacker.session, (), entries))
    for index in range(5000):
        attacker.number += 1
        entry = AspectEntry(f"a{attacker.number}", f"int{index}", "durable")
        attacker.post(Register(attacker.session, (f"s{attacker.number}",), (entry,)))
    for _ in range(2000):
        attacker.number += 1
        world = f"fork{attacker.number}"
        attacker.post(Fork(attacker.session, world, WORLD, 0, attacker.welcome.epoch, 1))
    attacker.zenoh.drain()


# ---------------------------------------------------------------- what costs time


def _patterns(attacker: Attacker) -> None:
    """Match patterns full of stars against a long name, and against each other.

    As backtracking regular expressions they stopped a shard until it was killed.
    """
    write = Item(int(Access.WRITE), WORLD, LONG_NAME, COUNT.name)
    lock = attacker.next_lock()
    attacker.zenoh.ask(FIRST, attacker.acquire((write,), lock))
    granted = attacker.zenoh.ask(FIRST, attacker.acquire((write,), lock))
    token = getattr(granted, "token", Token(1, 1))
    datum = Datum(b"\x01", b"", 0)
    slot = Slot(WORLD, LONG_NAME, COUNT.name)
    attacker.zenoh.ask(FIRST, Commit(lock, token, (WriteItem(slot, datum),), 0))
    for stars in (4, 9, 30):
        pattern = "*a" * stars + "*b"
        attacker.post(Survey((), (pattern,), ()), ListHistory((), (pattern,), ()))
        attacker.post(Survey((), (pattern,) * 4000, ()))
        each = Item(int(Access.READ_EACH), WORLD, pattern, COUNT.name)
        attacker.post(attacker.acquire((each,), attacker.next_lock()))
    for several in (4, 5, 9):
        each = Item(int(Access.WRITE_EACH), WORLD, "**/a/" * several + "b", COUNT.name)
        other = Item(int(Access.WRITE_EACH), WORLD, "a/**/" * several + "c", COUNT.name)
        for item in (each, other):
            attacker.post(attacker.acquire((item,), attacker.next_lock(lane=several)))
    attacker.zenoh.drain()


def _large_frames(attacker: Attacker) -> None:
    """Payloads and headers as long as the transport takes them, none of which is a request."""
    key = attacker.zenoh.key(FIRST, "survey")
    for _ in range(2):
        attacker.zenoh.post_frame(key, b"\x92\x00\x00", bytes(FRAME_BYTES))
    words = ("x",) * 200_000
    header = msgpack.packb([FRAME_VERSION, CODES[Survey], words, words, words, False])
    for _ in range(4):
        attacker.zenoh.post_frame(key, header, b"")
    attacker.zenoh.drain()


def _large_socket_frames(attacker: Attacker) -> None:
    """Claims of a gigabyte, the first half of it sent."""
    claim = MAGIC + bytes((STREAM_VERSION, Kind.MESSAGE)) + (64).to_bytes(4, "little")
    claim += (1 << 30).to_bytes(8, "little") + bytes(64)
    for _ in range(4):
        with contextlib.suppress(OSError, LinkError), _line(attacker) as line:
            line.connected.sendall(claim)
            for _ in range(32):
                line.connected.sendall(bytes(16 << 20))
            attacker.tally["taken"] += 1
            continue
        attacker.tally["connection ended"] += 1


# ---------------------------------------------------------------- connections that say nothing


def _silent_tcp(attacker: Attacker) -> None:
    """Connect to the shard's port and say nothing.

    A hundred such connections kept every newcomer waiting for 10 s.
    """
    _forget_half(attacker, kept_max=500)
    for shard in attacker.config.placement_map().shards:
        _, host, port = split_endpoint(shard.endpoints[0])
        for _ in range(300):
            with contextlib.suppress(OSError):
                attacker.open.append(socket.create_connection((host, int(port)), timeout=1.0))
    time.sleep(0.2)


def _silent_socket(attacker: Attacker) -> None:
    """Connect to the shard's socket, and say nothing or half a word."""
    _forget_half(attacker, kept_max=1500)
    for index in range(400):
        with contextlib.suppress(OSError, LinkError):
            line = RawSocket(attacker.welcome, attacker.tally)
            attacker.open.append(line)
            if index % 2:
                line.connected.sendall(MAGIC[:1])
    time.sleep(0.2)


def _forget_half(attacker: Attacker, *, kept_max: int) -> None:
    """Close the older half of the open sockets where there are many."""
    if len(attacker.open) < kept_max:
        return
    half = len(attacker.open) // 2
    for opened in attacker.open[:half]:
        (opened.connected if isinstance(opened, RawSocket) else opened).close()
    del attacker.open[:half]


# ---------------------------------------------------------------- in the name of others


def _in_the_victims_name(attacker: Attacker) -> list[Request]:
    """Return every message that would take the victim's session, lock or datum away."""
    session, epoch = attacker.victim, attacker.welcome.epoch
    held = attacker.zenoh.ask(FIRST, ListLocks())
    holders = held.holders if isinstance(held, Locks) else ()
    forged: list[Request] = []
    slot = Slot(WORLD, HELD.name, KEPT.name)
    item = Item(int(Access.WRITE), WORLD, HELD.name, KEPT.name)
    locks = [(h.lock, h.number) for h in holders if h.lock.session == session]
    locks.append((LockId(session, 0, 1), 1))
    for lock, number in locks:
        token = Token(epoch, number)
        forged += [
            Commit(lock, token, (WriteItem(slot, None),), 0),
            Release(lock),
            attacker.acquire((item,), LockId(session, lock.lane, lock.seq + 1)),
        ]
    lanes = tuple(LaneView(lane, INTEGER_MAX) for lane in range(8))
    forged += [
        KeepAlive(session, epoch, INTEGER_MAX, lanes, b""),
        hello(session, actor="victim"),
        Goodbye(session),
    ]
    return forged


def _forged_sessions(attacker: Attacker) -> None:
    """Send in the victim's name whatever would take its session, lock or datum away.

    The shard did all of it: it committed null under the victim's lock and ended its session.
    """
    attacker.post(*_in_the_victims_name(attacker))
    attacker.zenoh.drain()


def _forged_socket_sessions(attacker: Attacker) -> None:
    """Send the same over a connection that was opened for another session."""
    with _line(attacker) as line:
        for message in _in_the_victims_name(attacker):
            line.ask(message)
    with contextlib.suppress(OSError), RawSocket(attacker.welcome, attacker.tally, attacker.victim):
        return


def _line(attacker: Attacker) -> RawSocket:
    session = fresh_session()
    line = RawSocket(attacker.welcome, attacker.tally, session)
    line.ask(hello(session))
    return line


def _forged_decisions(attacker: Attacker) -> None:
    """Send the decisions that only the other shard may send, with stamps of all times.

    The shard took the stamp of 2^63 as its own time: no later grant could be read, after a restart
    neither.
    """
    entity = f"forged/{attacker.number}"
    write = Item(int(Access.WRITE), WORLD, entity, COUNT.name)
    now_ns = time.time_ns()
    hour_ns = 3_600_000_000_000
    for stamp_ns in (INTEGER_MAX, now_ns + hour_ns, now_ns + 2_000_000_000, 1, -1):
        lock = attacker.next_lock()
        granted = attacker.zenoh.ask(FIRST, attacker.acquire((write,), lock))
        token = getattr(granted, "token", Token(1, 1))
        slot = Slot(WORLD, entity, COUNT.name)
        body = WriteItem(slot, Datum(b"\x01", b"", 0))
        attacker.post(Prepare(lock, token, (body,), 0, (), SECOND, Token(1, 1)))
        attacker.zenoh.drain()
        attacker.post(Finish(lock, Position(stamp_ns, SECOND)))
        attacker.post(Finish(lock, Position(stamp_ns, FIRST)))
        attacker.post(Resolve(LockId(attacker.victim, 0, 1), Token(1, 1), SECOND))
        attacker.zenoh.drain()
    far = attacker.acquire((write,), attacker.next_lock())
    attacker.post(
        replace(far, seen_stamp_ns=now_ns + hour_ns),
        attacker.view(attacker.next_lock(), seen_ns=now_ns + hour_ns),
        attacker.view(attacker.next_lock(), at_ns=INTEGER_MAX),
    )
    attacker.zenoh.drain()


# ---------------------------------------------------------------- a stranger on the network


def _stranger(attacker: Attacker) -> None:
    """Answer as the shard, hear everybody, publish forged notices, declare the victim's token.

    A shard relayed all of it to and from a session in client mode: the stranger heard each commit,
    and every call of every client ended in an error.
    """
    cell, session = attacker.config.name, attacker.zenoh.session
    heard = attacker.heard

    def answer(query: Any) -> None:
        heard["requests"] += 1
        query.reply(query.key_expr, b"", attachment=b"\x90")

    queryable = session.declare_queryable(f"enact/{cell}/{FIRST}/**", answer, complete=True)
    listeners: list[Any] = [
        session.declare_subscriber(key, lambda _: heard.update(["messages"]))
        for key in (f"enact/{cell}/{FIRST}/**", "**")
    ]
    tokens: list[Any] = [
        session.liveliness().declare_token(f"enact/{cell}/@sessions/{attacker.victim}"),
        session.liveliness().declare_token(f"enact/{cell}/@sessions/attacker/{attacker.victim}"),
    ]
    end_s = time.monotonic() + 2.0
    while time.monotonic() < end_s:
        session.put(f"enact/{cell}/@notices/{FIRST}", b"", attachment=b"\x90")
        time.sleep(0.01)
    for declared in (*tokens, *listeners, queryable):
        declared.undeclare()


OVERLOAD: Final = frozenset(("overload",))
FORBIDDEN: Final = frozenset(("permission",))
ATTACKS: Final = (
    Attack("nothing", _nothing, frozenset()),
    Attack("parked questions", _parked, OVERLOAD),
    Attack("sessions", _sessions, OVERLOAD),
    Attack("socket sessions", _socket_sessions, OVERLOAD | {"connection refused"}),
    Attack("reports", _reports, OVERLOAD),
    Attack("registrations", _registrations, OVERLOAD),
    Attack("patterns", _patterns, frozenset(("protocol",))),
    Attack("large frames", _large_frames, frozenset(("protocol",))),
    Attack("socket frames", _large_socket_frames, frozenset(("connection ended",))),
    Attack("silent connections", _silent_tcp, frozenset()),
    Attack("silent sockets", _silent_socket, frozenset()),
    Attack("forged sessions", _forged_sessions, FORBIDDEN),
    Attack("forged socket sessions", _forged_socket_sessions, FORBIDDEN),
    Attack("forged decisions", _forged_decisions, frozenset(("permission", "clock")), shards=2),
    Attack("stranger as a client", _stranger, frozenset(), mode="client"),
    Attack("stranger as a peer", _stranger, frozenset()),
    Attack("stranger as a router", _stranger, frozenset(), mode="router"),
)
__all__ = ["ATTACKS", "Attack", "Attacker"]
