"""Messages in the name of others: of a client, of a shard.

Each function is one round; a round says what it did to a shard that believed them.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import replace
from typing import Any

from enact_dist.core.protocol.datum import Datum, LockId, Position, Slot, Token
from enact_dist.core.protocol.messages import (
    Commit,
    Finish,
    Goodbye,
    Item,
    KeepAlive,
    LaneView,
    ListLocks,
    ListSessions,
    Locks,
    Prepare,
    Release,
    Request,
    Resolve,
    Sessions,
    WriteItem,
)
from enact_dist.terms import Access
from enact_dist.verify.floods.attacker import FIRST, SECOND, Attacker, line_of
from enact_dist.verify.floods.raw import ACTOR, RawSocket, hello
from enact_dist.verify.floods.victim import ACTOR as VICTIM
from enact_dist.verify.floods.victim import COUNT, HELD, KEPT, WORLD
from enact_dist.wire.keys import identity_of, token_key
from enact_dist.wire.limits import INTEGER_MAX


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


def forged_sessions(attacker: Attacker) -> None:
    """Send in the victim's name whatever would take its session, lock or datum away.

    The shard did all of it: it committed null under the victim's lock and ended its session.
    """
    attacker.post(*_in_the_victims_name(attacker))
    attacker.zenoh.drain()


def forged_socket_sessions(attacker: Attacker) -> None:
    """Send the same over a connection that was opened for another session."""
    with line_of(attacker) as line:
        for message in _in_the_victims_name(attacker):
            line.ask(message)
    with contextlib.suppress(OSError), RawSocket(attacker.welcome, attacker.tally, attacker.victim):
        return


def forged_decisions(attacker: Attacker) -> None:
    """Send the decisions that only the other shard may send, with stamps of all times.

    The shard took the stamp of 2^63 as its own time: no later grant could be read, after a restart
    neither.
    """
    now_ns = time.time_ns()
    hour_ns = 3_600_000_000_000
    for stamp_ns in (INTEGER_MAX, now_ns + hour_ns, now_ns + 2_000_000_000, 1, -1):
        lock = attacker.next_lock()
        entity = f"forged/{lock.seq}"
        write = Item(int(Access.WRITE), WORLD, entity, COUNT.name)
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


def _identities(attacker: Attacker) -> list[str]:
    """Return the victim's identity, as the shard tells it to everybody, and the attacker's."""
    told = attacker.zenoh.ask(FIRST, ListSessions())
    sessions = told.sessions if isinstance(told, Sessions) else ()
    victims = [identity_of(one.actor, one.host, one.pid) for one in sessions if one.actor == VICTIM]
    return [ACTOR, *victims]


def stranger(attacker: Attacker) -> None:
    """Answer as the shard, hear everybody, publish forged notices, declare the victim's token.

    A shard relayed all of it to and from a session in client mode: the stranger heard each commit,
    and every call of every client ended in an error.
    """
    cell, session = attacker.config.name, attacker.zenoh.session
    identities = _identities(attacker)
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
        session.liveliness().declare_token(token_key(cell, identity, attacker.victim))
        for identity in identities
    ]
    end_s = time.monotonic() + 2.0
    while time.monotonic() < end_s:
        session.put(f"enact/{cell}/@notices/{FIRST}", b"", attachment=b"\x90")
        time.sleep(0.01)
    for declared in (*tokens, *listeners, queryable):
        declared.undeclare()
