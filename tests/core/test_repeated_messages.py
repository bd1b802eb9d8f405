"""Duplicated and late messages of every kind change nothing.

Scripted runs of a cell go through the wire message by message.  Each message of each run comes a
second time: right behind the first, when all is over, and after a restart of the shard that took
or sent it.  What matters at the end must be what it is without the copy.
"""

from __future__ import annotations

from typing import get_args

import pytest
import repeated_runs
from client_bench import CellBench
from repeated_runs import RUNS, SHARDS
from repeating_cell import Again, RepeatingCell, When
from shard_bench import TTL_NS, ShardBench, datum, item, lock_id, slot

from enact_dist.core.client import session as client
from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.datum import Token
from enact_dist.core.protocol.messages import (
    Answer,
    Break,
    Broken,
    Changed,
    Commit,
    Committed,
    Finished,
    Goodbye,
    Hello,
    ListAudit,
    Message,
    Notice,
    PlacementMap,
    Prepare,
    Prepared,
    Request,
    ShardEntry,
    SlotVersion,
    Stage,
    Staged,
    Valid,
    Validate,
    WriteItem,
)
from enact_dist.core.protocol.records import AuditRecord
from enact_dist.core.shard.state import ShardState
from enact_dist.core.state.audit import ALARM, Audit
from enact_dist.core.state.commits import Commits
from enact_dist.core.state.sessions import IDLE_TTLS, Lane
from enact_dist.terms import Access

TWO_SHARDS = PlacementMap(1, (ShardEntry("s0", ()), ShardEntry("s1", ())), ())
TOLD_FOR_GOOD = (Committed, Prepared, Valid, Finished)


def numbered_in_any_epoch(state, number, _epoch):
    """Find a lock by its number, whenever that was told."""
    found = (t for t in state.tenures.by_lock.values() if t.claim.ticket == number)
    return next(found, None)


def shard_picture(bench, sessions):
    """Return what matters of a shard: in memory, and on its disk.

    A late Hello opens the session of a client that said goodbye anew, until that has been idle for
    long; `sessions` are the others.
    """
    state = bench.shard.state
    slots = {
        slot: content
        for column in state.slots.columns()
        for slot, content in state.slots.matching(column, "**")
    }
    lanes = {
        session: {lane: (found.top, found.outcome) for lane, found in known.items()}
        for session in sessions
        if (known := state.sessions.lanes_of(session)) is not None
    }
    kept = bench.recovered(0)
    return {
        "slots": slots,
        "lanes": lanes,
        "locks": {
            lock: (tenure.token, tenure.claim.wants, tenure.prepared, tenure.hold_end_ns)
            for lock, tenure in state.tenures.by_lock.items()
        },
        "decisions": {lock: found.position for lock, found in state.decisions.by_lock.items()},
        "pinned": {lock: set(state.pins.get(lock)) for lock in state.pins},
        "catalogue": (dict(state.catalogue.worlds), dict(state.catalogue.aspects)),
        "notices": list(bench.notices),
        "audit": (state.audit.alarms, state.audit.entries()),
        "stamp": state.stamps.last_ns,
        "on disk": (
            {record.session for record in kept.sessions} & sessions,
            kept.worlds,
            kept.dropped,
            sorted(kept.aspects),
            kept.slots,
            kept.history,
            kept.kept,
            kept.outcomes,
            kept.prepared,
            kept.decisions,
            kept.forced,
        ),
    }


def client_picture(client):
    """Return what matters of a client's session."""
    core = client.core
    return {
        "epochs": {shard: (core.epoch(shard), core.needs_hello(shard)) for shard in SHARDS},
        "live": [lock.lock for lock in core.live_locks()],
        "seen": core.seen_stamp_ns,
        "placement": core.placement,
    }


def lock_picture(lock):
    """Return what a lock has told its thread."""
    parts = [(part.shard, part.token) for part in lock.parts]
    return (lock.lock, lock.phase, lock.cause, lock.position, lock.versions, parts, lock.states)


def picture(cell):
    """Return all that matters of a cell."""
    sessions = {client.core.session for client in cell.clients if not client.said_goodbye}
    return {
        "shards": {name: shard_picture(bench, sessions) for name, bench in cell.shards.items()},
        "clients": {client.core.session: client_picture(client) for client in cell.clients},
        "locks": [lock_picture(lock) for lock in cell.locks],
    }


def played(run, again=None, restarted=None):
    """Play a run with one message again; return the cell and what is left."""
    cell = RepeatingCell(*SHARDS, again=again)
    run(cell)
    if restarted is not None:
        cell.restart(restarted)
    cell.repeat()
    return cell, picture(cell)


def differences(one, other, path=()):
    """Yield where two pictures differ."""
    if isinstance(one, dict) and isinstance(other, dict):
        for key in {**one, **other}:
            yield from differences(one.get(key), other.get(key), (*path, str(key)))
    elif one != other:
        yield f"{' / '.join(path)}: {one!r} became {other!r}"


def unlike(delivery, when):
    """Yield how the copy was answered otherwise than the first, where that must not be."""
    message, first, second = delivery.message, delivery.answer, delivery.second
    if not isinstance(message, get_args(Request)) or None in (first, second):
        return
    told = isinstance(first, TOLD_FOR_GOOD) and isinstance(second, TOLD_FOR_GOOD)
    if first != second and (told or when is When.AT_ONCE):
        yield f"answered {first}, then {second}"


def changes(run, when):
    """Yield each message of a run whose copy changes something, and what."""
    first, plain = played(run)
    wanted = {None: plain}
    for index, delivery in enumerate(first.tape):
        restarted = delivery.shard if when is When.AFTER_A_RESTART else None
        if restarted not in wanted:
            wanted[restarted] = played(run, None, restarted)[1]
        cell, got = played(run, Again(index, when), restarted)
        changed = [*differences(wanted[restarted], got), *unlike(cell.tape[index], when)]
        if changed:
            yield f"{index} {delivery.message}: {changed}"


@pytest.mark.sampled(16)
@pytest.mark.parametrize("when", When, ids=lambda when: when.name.lower())
@pytest.mark.parametrize("run", RUNS, ids=lambda run: run.__name__)
def test_message_that_comes_again_changes_nothing(run, when):
    """Whichever message of the run is repeated, all that matters is as without it."""
    assert "\n".join(changes(run, when)) == ""


def test_every_kind_of_message_is_repeated():
    """A new kind of message needs a run in which it is said; notices are what shards are seen by."""
    said = {type(delivery.message) for run in RUNS for delivery in played(run)[0].tape}

    at_the_link = {Stage, Staged}  # a shard's core never sees them
    assert {*get_args(Request), *get_args(Answer)} - said == at_the_link
    assert {*get_args(Message)} - said == {Notice} | at_the_link


@pytest.mark.parametrize(
    ("owner", "name", "wrong", "run", "when"),
    [
        (Commits, "_recorded", lambda *_: None, "updates_on_one_shard", When.AT_ONCE),
        (Lane, "top", property(lambda _: 0, lambda *_: None), "lost_leases", When.AT_THE_END),
        (Audit, "may_settle", lambda *_: True, "operators", When.AT_ONCE),
        (ShardState, "numbered", numbered_in_any_epoch, "operators", When.AFTER_A_RESTART),
        (client, "_epoch_of", lambda _: None, "restarts", When.AT_THE_END),
        (ShardState, "answered_before", lambda *_: None, "world_acts", When.AT_THE_END),
    ],
    ids=["outcomes", "seqs", "settling", "numbers", "epochs", "forks and drops"],
)
def test_copy_that_changes_something_is_noticed(owner, name, wrong, run, when, monkeypatch):
    """Without what makes the shard or client indifferent to copies, the comparison says so."""
    monkeypatch.setattr(owner, name, wrong)

    assert any(changes(getattr(repeated_runs, run), when))


def test_session_that_a_late_hello_opens_anew_holds_nothing_and_ends():
    """A copy of the Hello of a client that said goodbye costs some idle time, and no lock."""
    bench = ShardBench()
    hello = Hello("ann", 0, TTL_NS, "ann", "host", 1, False)
    bench.ask(hello)
    bench.ask(Goodbye("ann"))
    bench.ask(hello)

    bench.wait((IDLE_TTLS + 2) * TTL_NS)

    assert not bench.shard.state.sessions.by_id
    assert not bench.recovered(2).sessions


def test_number_of_an_earlier_epoch_breaks_nobody():
    """A restarted shard gives number 1 again: a late Break of the old one finds nothing."""
    bench = ShardBench()
    bench.hello("ann")
    bench.granted(lock_id("ann"), item(Access.WRITE))
    late = Break(1, "hangs", bench.shard.epoch)
    bench.restart()
    bench.hello("ann", known_epoch=bench.shard.epoch)
    held = bench.granted(lock_id("ann", 0, 2), item(Access.WRITE))

    assert bench.ask(late) == Broken(False, None)
    assert bench.shard.state.tenures.by_lock[held.lock].claim.ticket == 1


def test_late_settling_leaves_a_newer_alarm():
    """Whoever settled what he had seen has not seen what came after."""
    bench = ShardBench()
    audit = bench.shard.state.audit
    for wall_ns in (10, 20):
        audit.keep(AuditRecord(wall_ns, "torn", ALARM))

    assert bench.ask(ListAudit("mended", 10)).alarms == 2
    assert bench.ask(ListAudit("mended", 20)).alarms == 0
    assert len(bench.ask(ListAudit("mended", 20)).entries) == 3


def test_late_word_of_an_epoch_that_is_known_drops_nothing():
    """What was held before it is dropped already; what was granted since stays."""
    cell = CellBench("s0")
    ann = cell.client("ann")
    late = ann.core.keep_alive("s0", cell.now_ns)
    cell.shards["s0"].restart()
    ann.keep_alive()
    ann.keep_alive()
    lock = ann.locked(item(Access.WRITE))

    ann.call("s0", late)

    assert lock.phase is Phase.HELD
    assert not ann.core.needs_hello("s0")


@pytest.mark.parametrize("last", [Commit, Prepare, Validate])
def test_refused_expectation_is_told_again(last):
    """Whoever lost the answer learns why its lock has ended, not that it is unknown."""
    bench = ShardBench(placement=TWO_SHARDS)
    bench.hello("ann")
    grant = bench.granted(lock_id("ann"), item(Access.WRITE))
    expects = (SlotVersion(slot("other"), 7),)
    write = (WriteItem(slot(), datum()),)
    request = {
        Commit: Commit(grant.lock, grant.token, write, 0, expects),
        Prepare: Prepare(grant.lock, grant.token, write, 0, expects, "s1", Token(1, 1)),
        Validate: Validate(grant.lock, grant.token, expects),
    }[last]

    assert bench.ask(request) == bench.ask(request) == Changed(grant.lock, slot("other"), 0)
