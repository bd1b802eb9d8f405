"""Scripted runs in which every kind of message is said; see `test_repeated_messages`.

Each run is a function of a cell that has not begun.  What it leaves held, prepared or decided is
what a copy of one of its messages could spoil.
"""

from __future__ import annotations

from client_bench import ANSWER, NOTHING, REQUEST
from repeating_cell import RepeatingCell, RepeatingClient
from shard_bench import MS, TTL_NS, WALL_NS, S, datum, lock_id

from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.datum import Datum, Position, Slot, Token
from enact_dist.core.protocol.messages import (
    Acquire,
    AspectEntry,
    AwaitStamp,
    Break,
    Commit,
    DatumRead,
    DropWorld,
    Explain,
    Fetch,
    FindEffects,
    Finish,
    ForceAbort,
    Fork,
    Item,
    KeepVersions,
    ListAudit,
    ListHistory,
    ListLocks,
    ListPlaces,
    ListRefusals,
    ListSessions,
    Outcome,
    Ping,
    Prepare,
    Register,
    Resolve,
    SlotVersion,
    Survey,
    TakeView,
    Validate,
    WriteItem,
)
from enact_dist.terms import Access

R, W, V, WE = Access.READ, Access.WRITE, Access.VIEW, Access.WRITE_EACH
SHARDS = ("s0", "s1")
LARGE = Datum(b"t", b"x" * 100_000, 100_000)


def at(cell: RepeatingCell, shard: str, name: str = "e") -> str:
    """Return an entity on a shard."""
    return cell.entity_on(shard, name)


def item(access: Access, entity: str, aspect: str = "count") -> Item:
    return Item(access, "online", entity, aspect)


def slot(entity: str, aspect: str = "count") -> Slot:
    return Slot("online", entity, aspect)


def both(cell: RepeatingCell) -> tuple[str, str]:
    return at(cell, "s0"), at(cell, "s1")


def lose_once(client: RepeatingClient, kind: type, half: str) -> None:
    """Lose one half of the next call of a kind."""
    lost = iter([half])
    client.lose = lambda _shard, request: (
        next(lost, NOTHING) if isinstance(request, kind) else NOTHING
    )


# ---------------------------------------------------------------- one shard


def updates_on_one_shard(cell: RepeatingCell) -> None:
    """Update, wait for somebody, read, view, give back; one lock stays held, one waits."""
    near, _ = both(cell)
    ann, bob = cell.client("ann"), cell.client("bob")
    ann.finish(ann.locked(item(W, near)), (slot(near), "1"))
    held = ann.locked(item(W, near), item(W, near, "note"), item(W, near, "frame"))
    waiting = bob.begin(item(R, near))
    bob.step(waiting)
    cell.keep_alive()
    ann.finish(held, (slot(near), "2"), (slot(near, "note"), "n"), (slot(near, "frame"), "f"))
    bob.finish(bob.drive(waiting))
    viewed = bob.locked(item(V, near))
    bob.finish(viewed)
    given_back = ann.locked(item(W, near), lane=1)
    given_back.release()
    ann.drive(given_back)
    ann.locked(item(W, near), lane=2)
    bob.step(bob.begin(item(W, near), lane=3, wait_s=0.0))
    cell.keep_alive()


def lost_halves_on_one_shard(cell: RepeatingCell) -> None:
    """Requests and answers are lost and asked for again."""
    near, _ = both(cell)
    ann = cell.client("ann")
    for kind in (Acquire, Commit, Outcome):
        for half in (REQUEST, ANSWER):
            lose_once(ann, kind, half)
            lock = ann.locked(item(W, near))
            ann.finish(lock, (slot(near), f"{kind.__name__} {half}"))
            assert lock.phase is Phase.COMMITTED
    lose_once(ann, Validate, ANSWER)
    read = ann.locked(item(R, near))
    ann.finish(read)
    assert read.phase is Phase.COMMITTED


def expectations(cell: RepeatingCell) -> None:
    """One expected view still stands, another has moved on."""
    near, _ = both(cell)
    other = at(cell, "s0", "f")
    ann, bob = cell.client("ann"), cell.client("bob")
    stands = ann.locked(item(W, near), item(V, other))
    write = {"s0": [WriteItem(slot(near), datum("1"))]}
    expects = [SlotVersion(slot(other), 0)]
    stands.finish(write, give_up_ns=cell.now_ns + S, expects=expects)
    ann.drive(stands)
    moved = ann.locked(item(W, near), item(V, other))
    bob.finish(bob.locked(item(W, other)), (slot(other), "1"))
    moved.finish(write, give_up_ns=cell.now_ns + S, expects=expects)
    ann.drive(moved)
    assert (stands.phase, moved.phase) == (Phase.COMMITTED, Phase.CHANGED)


def large_data(cell: RepeatingCell) -> None:
    """A datum is too large for an answer, and fetched in parts until it has gone."""
    near, _ = both(cell)
    ann, bob = cell.client("ann"), cell.client("bob")
    lock = ann.locked(item(W, near))
    writes = {"s0": [WriteItem(slot(near), LARGE)]}
    lock.finish(writes, give_up_ns=cell.now_ns + S)
    ann.drive(lock)
    view = bob.begin(item(V, near))
    bob.drive(view)
    fetch = Fetch(view.lock, 1, slot(near), 1, 0, 60_000)
    bob.call("s0", fetch)
    view.release()
    bob.drive(view)
    ann.finish(ann.locked(item(W, near)), (slot(near), "small"))
    bob.call("s0", fetch)


# ---------------------------------------------------------------- over shards


def updates_over_shards(cell: RepeatingCell) -> None:
    """Write on both shards; write on one and read on the other; view both; hold both."""
    near, far = both(cell)
    ann, bob = cell.client("ann"), cell.client("bob")
    for value in ("1", "2"):
        lock = ann.locked(item(W, near), item(W, far))
        ann.finish(lock, (slot(near), value), (slot(far), value))
        assert lock.phase is Phase.COMMITTED
    lock = bob.locked(item(W, near), item(R, far))
    bob.finish(lock, (slot(near), "3"))
    view = bob.locked(item(V, near), item(V, far))
    bob.finish(view)
    assert {reading.state.version for reading in view.states} == {2, 3}
    ann.locked(item(W, near), item(W, far), lane=1)
    cell.keep_alive()


def lost_halves_over_shards(cell: RepeatingCell) -> None:
    """Prepare, commit and finish are lost, and said again until all is done."""
    near, far = both(cell)
    ann = cell.client("ann")
    lost = iter([True])
    for kind in (Prepare, Commit):
        for half in (REQUEST, ANSWER):
            lose_once(ann, kind, half)
            lock = ann.locked(item(W, near), item(W, far))
            cell.loses_calls = lambda _shard, request: (
                isinstance(request, Finish) and next(lost, False)
            )
            ann.finish(lock, (slot(near), kind.__name__), (slot(far), half))
            cell.wait_alive(S)
            assert lock.phase is Phase.COMMITTED


def _in_doubt(cell: RepeatingCell, client: RepeatingClient) -> None:
    """Leave a lock prepared, its commit under way for ever."""
    near, far = at(cell, "s0", "f"), at(cell, "s1", "f")
    lock = client.locked(item(W, near), item(W, far))
    client.lose = lambda _shard, request: REQUEST if isinstance(request, Commit) else NOTHING
    writes = {s: [WriteItem(slot(e), datum("2"))] for s, e in (("s0", near), ("s1", far))}
    lock.finish(writes, give_up_ns=cell.now_ns + S)
    client.step(lock)


def client_dies_after_prepare(cell: RepeatingCell) -> None:
    """What nobody decides about any more is asked about: open, then aborted."""
    near, far = both(cell)
    ann, bob = cell.client("ann"), cell.client("bob")
    _in_doubt(cell, ann)
    ann.gone = True
    cell.wait_alive(TTL_NS + 2 * S)
    assert not cell.shards["s1"].shard.state.tenures.by_lock
    bob.locked(item(W, near), item(W, far))


def decision_is_asked_for(cell: RepeatingCell) -> None:
    """The primary's word is lost, so the participant asks for it."""
    near, far = both(cell)
    ann = cell.client("ann")
    cell.loses_calls = lambda _shard, request: isinstance(request, Finish)
    lock = ann.locked(item(W, near), item(W, far))
    ann.finish(lock, (slot(near), "1"), (slot(far), "1"))
    cell.wait_alive(2 * S)
    cell.loses_calls = lambda _shard, _request: False
    cell.wait_alive(3 * S)
    assert cell.shards["s1"].value(slot(far)) == "1"
    assert not cell.shards["s0"].shard.state.decisions.by_lock


def in_doubt_at_the_end(cell: RepeatingCell) -> None:
    """One commit is decided and not told, another is prepared and not decided."""
    near, far = both(cell)
    ann, bob = cell.client("ann"), cell.client("bob")
    cell.loses_calls = lambda _shard, _request: True
    lock = ann.locked(item(W, near), item(W, far))
    ann.finish(lock, (slot(near), "1"), (slot(far), "1"))
    _in_doubt(cell, bob)


# ---------------------------------------------------------------- sessions, people, what is wrong


def catalogue_and_people(cell: RepeatingCell) -> None:
    """Contexts and aspects are registered, and what is there is listed."""
    near, _ = both(cell)
    ann = cell.client("ann")
    ann.call("s0", Register("ann", ("plan",), (AspectEntry("pose", "p", "os"),)))
    ann.call("s0", Register("ann", (), (AspectEntry("count", "other", ""),)))
    lock = ann.locked(item(W, near))
    ann.finish(lock, (slot(near), "1"))
    assert lock.position is not None
    ann.call("s0", AwaitStamp(lock.position.stamp_ns, 0))
    ann.call("s0", AwaitStamp(WALL_NS + 100 * S, 0))
    listings = (ListPlaces(), Survey((), (), ()), ListLocks(), ListSessions(), ListAudit(""))
    for request in (Ping(), ListRefusals(), *listings):
        ann.call("s0", request)


def operators(cell: RepeatingCell) -> None:
    """A lock is broken, one in doubt is aborted; the lost shard is back, the alarm is settled."""
    near, far = both(cell)
    ann, bob = cell.client("ann"), cell.client("bob")
    broken = ann.locked(item(W, near))
    epoch = cell.shards["s0"].shard.epoch
    tenures = cell.shards["s0"].shard.state.tenures.by_lock
    bob.call("s0", Break(tenures[broken.lock].claim.ticket, "hangs", epoch))
    cell.keep_alive()
    cell.loses_calls = lambda _shard, _request: True
    lock = ann.locked(item(W, near), item(W, far), lane=1)
    ann.finish(lock, (slot(near), "1"), (slot(far), "1"))
    epoch = cell.shards["s1"].shard.epoch
    tenures = cell.shards["s1"].shard.state.tenures.by_lock
    bob.call("s1", ForceAbort(tenures[lock.lock].claim.ticket, "disk gone", epoch))
    cell.loses_calls = lambda _shard, _request: False
    cell.wait_alive(3 * S)
    audit = cell.shards["s1"].shard.state.audit
    assert audit.alarms == 1
    bob.call("s1", ListAudit("mended", audit.entries()[-1].wall_ns))
    # A restart gives its numbers anew, the first to what is in doubt.
    cell.loses_calls = lambda _shard, _request: True
    _in_doubt(cell, bob)


def goodbye(cell: RepeatingCell) -> None:
    """A session ends: its locks are free, its outcome stays."""
    near, _ = both(cell)
    ann, bob = cell.client("ann"), cell.client("bob")
    ann.finish(ann.locked(item(W, near)), (slot(near), "1"))
    ann.locked(item(W, near))
    ann.say_goodbye()
    bob.locked(item(W, near))


def restarts(cell: RepeatingCell) -> None:
    """A shard restarts under locks; they are lost, and new ones are had in the new epoch."""
    near, far = both(cell)
    ann, bob = cell.client("ann"), cell.client("bob")
    lost = ann.locked(item(W, near))
    cell.shards["s0"].restart()
    ann.finish(lost, (slot(near), "1"))
    assert lost.phase is Phase.LOST
    cell.keep_alive()
    lock = ann.locked(item(W, near), item(W, far))
    ann.finish(lock, (slot(near), "1"), (slot(far), "1"))
    bob.locked(item(W, near))
    cell.keep_alive()


def lost_leases(cell: RepeatingCell) -> None:
    """A holder falls silent, loses its lock and comes back to finish it."""
    near, _ = both(cell)
    ann, bob = cell.client("ann"), cell.client("bob")
    asleep = ann.locked(item(W, near))
    for _ in range(TTL_NS // (500 * MS) + 1):
        cell.wait(500 * MS)
        bob.keep_alive()
    bob.finish(bob.locked(item(W, near)), (slot(near), "bob"))
    ann.finish(asleep, (slot(near), "ann"))
    assert asleep.phase is Phase.LOST
    assert cell.shards["s0"].value(slot(near)) == "bob"


def wrong_requests(cell: RepeatingCell) -> None:
    """What is refused: a seq that is over, another map, an aspect that is not there, a stranger."""
    near, _ = both(cell)
    ann = cell.client("ann")
    lock = ann.locked(item(W, near))
    ann.finish(lock, (slot(near), "1"))
    count = ann.core.sendings.count
    ann.call("s0", Acquire(lock.lock, 1, 1, count, (item(W, near),), 0, S, 0))
    wanted = (item(W, near),)
    ann.call("s0", Acquire(lock_id("ann", 1, 1), 1, 9, count, wanted, 0, S, 0))
    ann.call("s0", TakeView(lock_id("ann", 1, 2), 1, 9, count, wanted, 0))
    unknown = (item(W, near, "colour"),)
    ann.call("s0", Acquire(lock_id("ann", 1, 3), 1, 1, count, unknown, 0, S, 0))
    write = (WriteItem(slot(near), datum("forged")),)
    ann.call("s0", Commit(lock_id("ann", 7, 1), Token(1, 99), write, 0))
    ann.call("s1", Prepare(lock_id("ann", 7, 1), Token(1, 99), write, 0, (), "s0", Token(1, 1)))
    ann.call("s0", Validate(lock_id("ann", 7, 1), Token(1, 99)))
    ann.call("s0", Outcome(lock_id("eve", 1, 1)))
    ann.call("s0", Finish(lock_id("eve", 1, 1), Position(1, "s1")))
    ann.call("s0", Resolve(lock_id("eve", 1, 1), Token(1, 1), "s1"))
    ann.call("s0", Break(999, "no such lock", 1))


def world_acts(cell: RepeatingCell) -> None:
    """Contexts are forked, written, dropped and forked again; where data come from is asked."""
    near, far = both(cell)
    ann, bob = cell.client("ann"), cell.client("bob")
    lock = ann.locked(item(W, near), item(W, far))
    ann.finish(lock, (slot(near), "1"), (slot(far), "1"))
    assert lock.position is not None
    at_ns = lock.position.stamp_ns
    reads = [DatumRead(slot(name), 1, at_ns) for name in (near, far)]
    for name in SHARDS:
        _fork(cell, ann, name, "what_if", at_ns)
        _fork(cell, bob, name, "what_if", at_ns + 1)
    copied = [Slot("what_if", name, "count") for name in (near, far)]
    made = bob.locked(*(Item(W, *one) for one in copied))
    writes = {s: [WriteItem(one, datum("2"))] for s, one in zip(SHARDS, copied, strict=True)}
    made.finish(writes, give_up_ns=cell.now_ns + S, reads=reads)
    bob.drive(made)
    for name, one in zip(SHARDS, copied, strict=True):
        ann.call(name, Explain((SlotVersion(one, 0),)))
        ann.call(name, FindEffects(tuple(reads)))
    held = ann.locked(Item(R, *copied[0]))
    _drop(cell, bob, "s0")
    ann.finish(held)
    for name in SHARDS:
        _drop(cell, bob, name)
    _fork(cell, ann, "s0", "what_if", at_ns)
    _drop(cell, ann, "s0")
    _fork(cell, bob, "s0", "what_if", at_ns + 2)


def _fork(cell: RepeatingCell, client: RepeatingClient, shard: str, name: str, at_ns: int) -> None:
    core = client.core
    count = core.sendings.next(cell.now_ns)
    client.call(shard, Fork(core.session, name, "online", at_ns, core.epoch(shard), count))


def _drop(cell: RepeatingCell, client: RepeatingClient, shard: str) -> None:
    core = client.core
    count = core.sendings.next(cell.now_ns)
    client.call(shard, DropWorld(core.session, "what_if", core.epoch(shard), count))


def histories(cell: RepeatingCell) -> None:
    """Versions are listed, kept and let go of, and asked for as of a stamp, in vain too."""
    near, _ = both(cell)
    ann = cell.client("ann")
    ann.call("s0", Register("ann", (), (AspectEntry("count", "int", "", 2),)))
    stamps = []
    for value in ("1", "2", "3", "4"):
        lock = ann.locked(item(W, near))
        ann.finish(lock, (slot(near), value))
        assert lock.position is not None
        stamps.append(lock.position.stamp_ns)
    ann.call("s0", ListHistory((), (), ()))
    for label, versions in (("look/here", (3, 4)), ("gone", (4, 9)), ("gone", ())):
        asked = tuple(SlotVersion(slot(near), version) for version in versions)
        count = ann.core.sendings.next(cell.now_ns)
        ann.call("s0", KeepVersions("ann", label, asked, 1, count))
    cell.wait(3 * S)
    ann.keep_alive()
    for seq, at_ns in enumerate((stamps[3], stamps[0]), 1):
        count, seen_ns = ann.core.sendings.count, ann.core.seen_stamp_ns
        view = TakeView(lock_id("ann", 5, seq), 1, 1, count, (item(V, near),), seen_ns, at_ns, True)
        ann.call("s0", view)


RUNS = (
    updates_on_one_shard,
    lost_halves_on_one_shard,
    expectations,
    large_data,
    updates_over_shards,
    lost_halves_over_shards,
    client_dies_after_prepare,
    decision_is_asked_for,
    in_doubt_at_the_end,
    catalogue_and_people,
    operators,
    goodbye,
    restarts,
    lost_leases,
    wrong_requests,
    world_acts,
    histories,
)
