"""Floods: more of something legal than a shard can keep, or longer than it can look at.

Each function is one round; a round says what it did to a shard without bounds.
"""

from __future__ import annotations

import contextlib
import socket
import time
from typing import Final

import msgpack

from enact_dist.core.protocol.datum import Datum, Slot, Token
from enact_dist.core.protocol.messages import (
    AspectEntry,
    AwaitStamp,
    Commit,
    DatumRead,
    Explain,
    FindEffects,
    Fork,
    Goodbye,
    Item,
    KeepAlive,
    KeepVersions,
    ListHistory,
    ListSessions,
    Register,
    SlotVersion,
    Survey,
    Validate,
    WriteItem,
)
from enact_dist.errors import LinkError
from enact_dist.link.socket.frames import MAGIC, STREAM_VERSION, FrameKind
from enact_dist.link.zenoh.endpoints import split_endpoint
from enact_dist.terms import Access
from enact_dist.verify.floods.attacker import FIRST, Attacker, line_of
from enact_dist.verify.floods.raw import RawSocket, fresh_session, hello
from enact_dist.verify.floods.victim import COUNT, HELD, KEPT, WORLD
from enact_dist.wire.frames import CODES
from enact_dist.wire.limits import FRAME_VERSION, INTEGER_MAX

LONG_NAME: Final = "a" * 150
WAIT_NS: Final = 25_000_000_000
REPORT: Final = b"\xc4\x10" + b"r" * 65_000
FRAME_BYTES: Final = 256 << 20
PATTERNED: Final = "patterned"
LONG: Final = 100_000


def nothing(_: Attacker) -> None:
    """Leave everybody alone: what the other rows are compared with."""
    time.sleep(0.1)


# ---------------------------------------------------------------- questions that wait


def parked(attacker: Attacker) -> None:
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


def sessions(attacker: Attacker) -> None:
    """Open more sessions than a shard keeps.

    While all clients shared one bound, the shard then refused every client, even after a
    restart.
    """
    for _ in range(12_000):
        attacker.post(hello(fresh_session()))
    attacker.zenoh.drain()


def nameless_sessions(attacker: Attacker) -> None:
    """Open each session under a name of its own, so that no bound of one client holds."""
    for _ in range(12_000):
        session = fresh_session()
        attacker.zenoh.post(FIRST, hello(session, actor=session), actor=session)
    attacker.zenoh.drain()


def socket_sessions(attacker: Attacker) -> None:
    """Open a connection and a session again and again, up to 1,200 at once."""
    for _ in range(1500):
        _forget_half(attacker, kept_max=1200)
        session = fresh_session()
        with contextlib.suppress(OSError, LinkError):
            line = RawSocket(attacker.welcome, attacker.tally, session)
            attacker.open.append(line)
            if line.opened:
                line.ask(hello(session))


def reports(attacker: Attacker) -> None:
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


def registrations(attacker: Attacker) -> None:
    """Register worlds, aspects and fingerprints, and fork, without an end.

    Without bounds three messages made the shard's welcome longer than a frame: no client could send
    a hello any more, not even after a restart.
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


def patterns(attacker: Attacker) -> None:
    """Match patterns full of stars against a long name, and against each other.

    As backtracking regular expressions they stopped a shard until it was killed.
    """
    # An aspect of its own: a pattern locks all slots of its aspect, the victim's would wait for it.
    attacker.post(Register(attacker.session, (), (AspectEntry(PATTERNED, "int", "volatile"),)))
    attacker.zenoh.drain()
    write = Item(int(Access.WRITE), WORLD, LONG_NAME, PATTERNED)
    lock = attacker.next_lock()
    attacker.zenoh.ask(FIRST, attacker.acquire((write,), lock))
    granted = attacker.zenoh.ask(FIRST, attacker.acquire((write,), lock))
    token = getattr(granted, "token", Token(1, 1))
    datum = Datum(b"\x01", b"", 0)
    slot = Slot(WORLD, LONG_NAME, PATTERNED)
    attacker.zenoh.ask(FIRST, Commit(lock, token, (WriteItem(slot, datum),), 0))
    for stars in (4, 9, 30):
        pattern = "*a" * stars + "*b"
        attacker.post(Survey((), (pattern,), ()), ListHistory((), (pattern,), ()))
        attacker.post(Survey((), (pattern,) * 4000, ()))
        each = Item(int(Access.READ_EACH), WORLD, pattern, PATTERNED)
        attacker.post(attacker.acquire((each,), attacker.next_lock()))
    for several in (4, 5, 9):
        each = Item(int(Access.WRITE_EACH), WORLD, "**/a/" * several + "b", PATTERNED)
        other = Item(int(Access.WRITE_EACH), WORLD, "a/**/" * several + "c", PATTERNED)
        for item in (each, other):
            attacker.post(attacker.acquire((item,), attacker.next_lock(lane=several)))
    attacker.zenoh.drain()


def long_questions(attacker: Attacker) -> None:
    """Ask about 100,000 patterns, slots and versions in one message.

    One such listing kept the shard's mutex for seconds.
    """
    patterns = tuple(f"*{index}*a*" for index in range(LONG))
    slots = [Slot(WORLD, f"entity/{index}", COUNT.name) for index in range(LONG)]
    versions = tuple(SlotVersion(slot, 1) for slot in slots)
    reads = tuple(DatumRead(slot, 1, 1) for slot in slots)
    names = tuple(f"name{index}" for index in range(LONG))
    epoch = attacker.welcome.epoch
    lock = attacker.next_lock()
    held = Item(int(Access.WRITE), WORLD, f"long/{lock.seq}", COUNT.name)
    granted = attacker.zenoh.ask(FIRST, attacker.acquire((held,), lock))
    token = getattr(granted, "token", Token(1, 1))
    attacker.post(
        Survey((), patterns, ()),
        Survey(names, names, names, retained=True),
        ListHistory((), patterns, ()),
        Explain(versions),
        FindEffects(reads),
        KeepVersions(attacker.session, "label", versions, epoch, 1),
        Commit(lock, token, (), 0, expects=versions),
        Validate(lock, token, versions),
        attacker.acquire(
            tuple(
                Item(int(Access.READ_EACH), WORLD, f"*{index}*a*", COUNT.name)
                for index in range(4096)
            ),
            attacker.next_lock(lane=7),
        ),
    )
    attacker.zenoh.drain()


def large_frames(attacker: Attacker) -> None:
    """Payloads and headers as long as the transport takes them, none of which is a request."""
    key = attacker.zenoh.key(FIRST, "survey")
    for _ in range(2):
        attacker.zenoh.post_frame(key, b"\x92\x00\x00", bytes(FRAME_BYTES))
    words = ("x",) * 200_000
    header = msgpack.packb([FRAME_VERSION, CODES[Survey], words, words, words, False])
    for _ in range(4):
        attacker.zenoh.post_frame(key, header, b"")
    attacker.zenoh.drain()


def large_socket_frames(attacker: Attacker) -> None:
    """Claims of a gigabyte, the first half of it sent."""
    claim = MAGIC + bytes((STREAM_VERSION, FrameKind.MESSAGE)) + (64).to_bytes(4, "little")
    claim += (1 << 30).to_bytes(8, "little") + bytes(64)
    for _ in range(4):
        with contextlib.suppress(OSError, LinkError), line_of(attacker) as line:
            line.connected.sendall(claim)
            for _ in range(32):
                line.connected.sendall(bytes(16 << 20))
            attacker.tally["taken"] += 1
            continue
        attacker.tally["connection ended"] += 1


# ---------------------------------------------------------------- connections that say nothing


def silent_tcp(attacker: Attacker) -> None:
    """Connect to the shard's port and send nothing.

    A hundred such connections kept every newcomer waiting for 10 s.
    """
    _forget_half(attacker, kept_max=500)
    for shard in attacker.config.placement_map().shards:
        _, host, port = split_endpoint(shard.endpoints[0])
        for _ in range(300):
            with contextlib.suppress(OSError):
                attacker.open.append(socket.create_connection((host, int(port)), timeout=1.0))
    time.sleep(0.2)


def silent_socket(attacker: Attacker) -> None:
    """Connect to the shard's socket, and send nothing or an incomplete frame."""
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
