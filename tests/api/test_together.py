"""Data of one capture stamp as one set: viewed, triggering, incomplete ones counted and named."""

from __future__ import annotations

import itertools
import sys
import threading
import time

import numpy as np
import pytest
from together_parts import (
    DEPTH,
    KEPT,
    LEFT,
    PATIENCE_S,
    RIGHT,
    SYSTEM,
    TOTAL,
    cameras,
    capture,
    pair,
    role,
)

from enact_dist import (
    ActorThread,
    Aspect,
    Durability,
    Entities,
    Lock,
    Read,
    Together,
    View,
    Write,
    testing,
)
from enact_dist.access.reads import slot_of
from enact_dist.access.together import captured_versions
from enact_dist.access.watch import Change
from enact_dist.actor.actor import Actor
from enact_dist.actor.binding import BoundActor
from enact_dist.actor.check import check_cell
from enact_dist.actor.inbox import SetInbox
from enact_dist.config.read import load_config
from enact_dist.core.client.plan import Reading
from enact_dist.core.protocol.datum import Datum, Position
from enact_dist.core.protocol.messages import SlotState
from enact_dist.errors import MisuseError, NotRequestedError, NullDatumError
from enact_dist.link.client.locks import CellClient

pytestmark = pytest.mark.carrier("local", "drawn")


@pytest.fixture(params=["local", "two shards"])
def cell(request, tmp_path, monkeypatch):
    """The left camera on one shard, the right one on another; or both in this process."""
    with cameras(request.param, tmp_path, monkeypatch) as opened:
        yield opened


class Sum(Actor):
    """Add up the depths of a set; tells the test, and waits for it at `gate`."""

    depths = pair(role)
    total = Write(role, SYSTEM, TOTAL)
    triggers = (depths,)

    def __init__(self):
        self.seen = []
        self.moved = threading.Condition()
        self.gate = threading.Semaphore(1_000)

    def update(self, lock):
        with self.moved:
            self.seen.append((lock.stamp_ns(self.depths), lock[self.depths]))
            self.moved.notify_all()
        assert self.gate.acquire(timeout=PATIENCE_S)
        lock[self.total] = sum(lock[self.depths])

    def wait_until_seen(self, count):
        with self.moved:
            assert self.moved.wait_for(lambda: len(self.seen) >= count, PATIENCE_S), self.seen


# ---------------------------------------------------------------- views


def test_view_shows_the_newest_complete_set_though_its_slots_have_moved_on(cell):
    """The left camera is two frames ahead."""
    for stamp_ns in (100, 200, 300, 400):
        capture(cell, LEFT, stamp_ns)
    for stamp_ns in (100, 200):
        capture(cell, RIGHT, stamp_ns)
    online = cell.world("online")
    together, newest = pair(online), View(online, SYSTEM, TOTAL)
    with Lock(Write(online, SYSTEM, TOTAL)) as lock:
        lock[Write(online, SYSTEM, TOTAL)] = 7

    snapshot = online.view(together, newest)

    assert snapshot[together] == (200, 200)
    assert (snapshot.captured_ns, snapshot[together.requests[0]], snapshot[newest]) == (200, 200, 7)


def test_view_without_a_complete_set_says_what_each_has(cell):
    """An error, not a set of different moments."""
    capture(cell, LEFT, 100)
    capture(cell, RIGHT, 200)
    together = pair(cell.world("online"))

    with pytest.raises(NullDatumError, match=r"camera/left.*\[100\].*camera/right.*\[200\]"):
        cell.world("online").view(together)


def test_set_is_found_only_as_far_as_its_aspect_retains(cell):
    """Retention is bounded, and what is outside is not made up."""
    capture(cell, RIGHT, 100)
    for stamp_ns in range(100, 100 + 100 * KEPT, 100):
        capture(cell, LEFT, stamp_ns)
    together = pair(cell.world("online"))
    assert cell.world("online").view(together).captured_ns == 100

    capture(cell, LEFT, 1_000)

    with pytest.raises(NullDatumError):
        cell.world("online").view(together)


def test_large_data_of_a_set_are_those_of_its_stamp(cell):
    """What does not travel with the answer is fetched by version."""
    cloud = Aspect("cloud", np.ndarray, Durability.VOLATILE, retention=3)
    online = cell.world("online")
    for stamp_ns in (1, 2):
        for entity in (LEFT, RIGHT)[: 3 - stamp_ns]:
            capture(cell, entity, stamp_ns, np.full(100_000, stamp_ns, np.uint8), cloud)
    together = Together([View(online, entity, cloud) for entity in (LEFT, RIGHT)])

    left, right = online.view(together)[together]

    assert (left == 1).all()
    assert (right == 1).all()
    assert (online.view(together.requests[0])[together.requests[0]] == 2).all()


def test_set_that_is_written_twice_is_never_shown_half(cell):
    """One consistent cut over shards: both data of the first commit of a stamp, or of the second."""
    twice = Aspect("twice", str, Durability.VOLATILE, retention=32)
    online = cell.world("online")
    together = Together([View(online, entity, twice) for entity in (LEFT, RIGHT)])
    writes = [Write(online, entity, twice) for entity in (LEFT, RIGHT)]
    begun, enough, errors = threading.Event(), threading.Event(), []

    def write():
        try:
            for stamp_ns in itertools.takewhile(lambda _: not enough.is_set(), itertools.count(1)):
                for letter in "ab":
                    with Lock(*writes) as lock:
                        for request in writes:
                            lock.put(request, f"{stamp_ns}{letter}", stamp_ns=stamp_ns)
                    begun.set()
        except Exception as error:
            errors.append(error)

    writer = threading.Thread(target=write)
    writer.start()
    assert begun.wait(PATIENCE_S)
    seen = set()
    end_s = time.monotonic() + PATIENCE_S
    while len(seen) < 20 and not errors and time.monotonic() < end_s:
        snapshot = online.view(together)
        seen.add((snapshot.captured_ns, *snapshot[together]))
    enough.set()
    writer.join()

    assert not errors
    assert all(left == right and left[:-1] == str(ns) for ns, left, right in seen), seen
    assert len(seen) == 20
    last = online.view(together)
    assert last[together] == (f"{last.captured_ns}b",) * 2


def test_snapshot_and_lock_refuse_a_set_that_they_were_not_made_with(cell):
    """A Together is no lock request: what it shows may be past."""
    online = cell.world("online")
    capture(cell, LEFT, 1)
    view = View(online, LEFT, DEPTH)

    with pytest.raises(NotRequestedError):
        _ = online.view(view)[pair(online)]
    remedy = "no lock request; .*trigger of an Actor; .*world.view"
    with pytest.raises(MisuseError, match=remedy):
        Lock(pair(online))
    with pytest.raises(MisuseError, match="one view shows one set"):
        online.view(pair(online), Together(pair(online).requests[::-1]))
    with Lock(view) as lock, pytest.raises(MisuseError, match="no part of this lock"):
        lock.stamp_ns(pair(online))


@pytest.mark.parametrize(
    ("requests", "options", "error", "text"),
    [
        ([Read(role, LEFT, DEPTH), View(role, RIGHT, DEPTH)], {}, TypeError, "View of one entity"),
        ([View(role, Entities("*"), DEPTH)] * 2, {}, TypeError, "View of one entity"),
        ([View(role, LEFT, DEPTH)], {}, ValueError, "two or more"),
        ([View(role, LEFT, DEPTH)] * 2, {}, ValueError, "two or more"),
        (pair(role).requests, {"by": "version"}, ValueError, "by 'stamp' only"),
        (pair(role).requests, {"open_max": 0}, ValueError, "between 1 and 256"),
    ],
)
def test_set_that_could_never_be_told_complete_is_refused(requests, options, error, text):
    """When it is written, not when it runs."""
    with pytest.raises(error, match=text):
        Together(requests, **options)


# ---------------------------------------------------------------- triggers


def test_actor_declares_a_set_as_its_only_trigger():
    """Anything else could not say when it runs."""
    assert Sum.declaration.together == pair(role)
    assert list(Sum.declaration.requests) == ["depths[0]", "depths[1]", "total"]
    other = View(role, SYSTEM, DEPTH)
    with pytest.raises(MisuseError, match="only trigger"):
        type("Two", (Sum,), {"other": other, "triggers": (Sum.depths, other)})
    with pytest.raises(MisuseError, match="only trigger"):
        type("Beside", (Sum,), {"triggers": ()})
    with pytest.raises(MisuseError, match="stands for the triggering entity"):
        type("Each", (Sum,), {"total": Write(role, Entities("camera/*"), TOTAL)})


def test_run_once_updates_once_per_complete_set():
    """At first for the newest one, then for each new one; incomplete ones are told."""
    actor = Sum()
    with testing.worlds("online") as cell:
        for stamp_ns in (1, 2):
            capture(cell, LEFT, stamp_ns)
            capture(cell, RIGHT, stamp_ns)
        assert testing.run_once(actor, cell) == 1
        assert testing.run_once(actor, cell) == 0
        for stamp_ns in (3, 4, 5):
            capture(cell, LEFT, stamp_ns)
        for stamp_ns in (3, 5):
            capture(cell, RIGHT, stamp_ns)

        assert testing.run_once(actor, cell) == 2

        total = View(cell.world("online"), SYSTEM, TOTAL)
        assert cell.world("online").view(total)[total] == 10
    assert actor.seen == [(2, (2, 2)), (3, (3, 3)), (5, (5, 5))]
    (incomplete,) = testing.incomplete_sets(actor)
    assert str(incomplete) == "set of stamp 4: without online:camera/right/depth"


def test_actor_runs_sets_in_order_whatever_came_meanwhile(cell):
    """Each update shows the data of its stamp, though both slots have moved on."""
    actor = Sum()
    actor.gate = threading.Semaphore(0)
    with ActorThread(actor, cell) as thread:
        capture(cell, LEFT, 100)
        capture(cell, RIGHT, 100)
        actor.wait_until_seen(1)
        for stamp_ns in (200, 300):
            capture(cell, RIGHT, stamp_ns)
            capture(cell, LEFT, stamp_ns)
        actor.gate.release(3)
        actor.wait_until_seen(3)

    assert actor.seen == [(ns, (ns, ns)) for ns in (100, 200, 300)]
    found = thread.statistics()
    assert (found.updates, found.incomplete, found.skipped, found.late) == (3, 0, 0, 0)


def test_set_that_left_retention_before_its_update_is_counted_with_what_is_missing(cell):
    """A slow actor is told that it is too slow for what its aspects retain."""
    actor = Sum()
    actor.gate = threading.Semaphore(0)
    with ActorThread(actor, cell) as thread:
        capture(cell, LEFT, 1)
        capture(cell, RIGHT, 1)
        actor.wait_until_seen(1)
        for stamp_ns in range(2, 2 + KEPT + 1):
            capture(cell, RIGHT, stamp_ns)
            capture(cell, LEFT, stamp_ns)
        actor.gate.release(1_000)
        actor.wait_until_seen(1 + KEPT)

    found = thread.statistics()
    assert [stamp_ns for stamp_ns, _ in actor.seen] == [1, 3, 4, 5, 6]
    assert (found.updates, found.incomplete) == (1 + KEPT, 1)
    assert found.last_incomplete == (
        "set of stamp 2: without online:camera/left/depth, online:camera/right/depth"
    )


def test_versions_whose_notices_were_lost_are_asked_for(cell):
    """A gap in the notices costs no set, as far as versions are retained."""
    bound = BoundActor(Sum(), cell)
    inbox = SetInbox(bound.pending_sets(), bound.set_views())
    for stamp_ns in (1, 2, 3):
        capture(cell, LEFT, stamp_ns)
        capture(cell, RIGHT, stamp_ns)
    newest = [each[-1] for each in captured_versions(
        cell.world("online").session, bound.set_views()
    )]  # fmt: skip

    for index, (entity, one) in enumerate(zip((LEFT, RIGHT), newest, strict=True)):
        position = Position(one.committed_ns, "s0")
        change = Change(entity, "depth", one.version, position, 2, False, one.captured_ns)
        inbox.note(index, change)

    runs = [inbox.take(0.0) for _ in range(4)]
    assert [run and run.captured_ns for run in runs] == [1, 2, 3, None]
    assert inbox.sets.incomplete == 0


@pytest.mark.parametrize("size", [8, 300_000])
def test_a_set_of_views_alone_needs_no_call(tmp_path, monkeypatch, size):
    """The notices have brought it: small data whole, large ones by name; if one is gone, it asks."""
    cloud = Aspect("cloud", np.ndarray, Durability.VOLATILE, retention=3)
    asked, acquire = [], CellClient.acquire

    def noted(client, items, **options):
        items = tuple(items)
        asked.extend([items] if any(item.captured_ns for item in items) else [])
        return acquire(client, items, **options)

    class Look(Sum):
        depths = Together([View(role, entity, cloud) for entity in (LEFT, RIGHT)])
        triggers = (depths,)
        total = None

        def update(self, lock):
            assert self.gate.acquire(timeout=PATIENCE_S)
            with self.moved:
                shown = [int(one[-1]) for one in lock[self.depths]]
                self.seen.append((lock.stamp_ns(self.depths), lock.valid(), shown))
                self.moved.notify_all()
            lock.check()

    actor = Look()
    with cameras("one shard", tmp_path, monkeypatch) as cell:
        for entity in (LEFT, RIGHT):
            capture(cell, entity, 1, np.full(size, 1, np.uint8), cloud)
        with ActorThread(actor, cell) as thread:
            actor.wait_until_seen(1)
            monkeypatch.setattr(CellClient, "acquire", noted)
            for stamp_ns in (2, 3, 4):
                for entity in (LEFT, RIGHT):
                    capture(cell, entity, stamp_ns, np.full(size, stamp_ns, np.uint8), cloud)
                actor.wait_until_seen(stamp_ns)
        assert thread.statistics().failures == 0
    assert actor.seen == [(ns, True, [ns, ns]) for ns in (1, 2, 3, 4)]
    assert asked == []


def test_a_set_is_asked_for_where_a_payload_is_gone(cell):
    """What a notice has named lasts no longer than its version does."""

    class Look(Actor):
        depths = pair(role)
        triggers = (depths,)

        def update(self, lock): ...

    bound = BoundActor(Look(), cell)
    capture(cell, LEFT, 5)
    capture(cell, RIGHT, 5)
    named = Datum(b"t", b"", 1 << 20, 5, "gone-1")
    shown = tuple(
        Reading("s0", 1, SlotState(slot_of(view), 1, 5, 1 << 20, named, False, True, "", 5))
        for view in bound.set_views()
    )
    with bound.lock(None, members=(5, 5), shown=shown) as lock:
        assert lock[Look.depths] == (5, 5)


def test_set_whose_data_are_written_again_is_asked_for_where_a_notice_lacks_one(cell):
    """What a listing brought may be older than what a notice brings: that is no cut."""
    bound = BoundActor(Sum(), cell)
    inbox = SetInbox(bound.pending_sets(), bound.set_views())
    readings = [
        Reading(
            shard, 1, SlotState(slot_of(view), 2, 5, 0, Datum(b"t", b"", 0), False, False, "", 7)
        )
        for shard, view in zip(("s0", "s0"), bound.set_views(), strict=True)
    ]

    def note(index, version, carried):
        position, entity = Position(version, "s0"), (LEFT, RIGHT)[index]
        inbox.note(
            index, Change(entity, "depth", version, position, 0, False, 7, "online", carried)
        )

    note(0, 1, readings[0])
    assert inbox.shown((7, 7)) == ()
    note(1, 2, readings[1])
    assert inbox.shown((7, 7)) == tuple(readings)
    note(1, 3, readings[1]._replace(epoch=2))
    assert inbox.shown((7, 7)) == ()
    note(1, 4, readings[1]._replace(shard="s1"))
    assert inbox.shown((7, 7)) == ()
    note(1, 5, readings[1])
    assert inbox.shown((7, 7)) == tuple(readings)
    note(0, 6, None)
    assert inbox.shown((7, 7)) == ()


def test_set_of_large_data_is_fetched_at_once(cell, monkeypatch):
    """The update asks for all of them, so none waits for the one before."""
    online = cell.world("online")
    cloud = Aspect("cloud", np.ndarray, Durability.VOLATILE, retention=2)

    class Look(Actor):
        clouds = Together([View(role, entity, cloud) for entity in (LEFT, RIGHT)])
        triggers = (clouds,)

        def update(self, lock): ...

    for entity in (LEFT, RIGHT):
        with Lock(write := Write(online, entity, cloud)) as lock:
            lock.put(write, np.full(100_000, 7, np.uint8), stamp_ns=5)
    actor = Look()
    with BoundActor(actor, cell).lock(None, members=(5, 5)) as lock:
        fetched, fetch = [], lock._readings._fetched

        def counted(slots):
            fetched.append(len(slots := list(slots)))
            return fetch(slots)

        monkeypatch.setattr(lock._readings, "_fetched", counted)
        data = lock[actor.clouds]

    assert fetched == [2]
    assert [int(one[-1]) for one in data] == [7, 7]


@pytest.mark.parametrize(("retention", "found"), [(1, 2), (8, 0)])
def test_check_warns_of_a_set_that_nobody_retains(tmp_path, monkeypatch, retention, found):
    """By the word of the file or of the actor, whichever is larger."""
    bare = Aspect("bare", int)

    class Bare(Actor):
        depths = Together([View(role, entity, bare) for entity in (LEFT, RIGHT)])
        total = Write(role, SYSTEM, TOTAL)
        triggers = (depths,)

        def update(self, lock):
            lock[self.total] = sum(lock[self.depths])

    monkeypatch.setattr(sys.modules[__name__], "Bare", Bare, raising=False)
    monkeypatch.setitem(sys.modules, "set_actors", sys.modules[__name__])
    file = tmp_path / "cell.toml"
    file.write_text(
        'name = "c"\nworlds = ["online"]\n[shards.s]\nlisten = "tcp/127.0.0.1:7447"\n'
        f'[aspects.bare]\nretention = {retention}\n[actors.a]\nclass = "set_actors:Bare"\n'
    )

    warnings = [one for one in check_cell(load_config(file)) if one.kind == "set not retained"]

    assert len(warnings) == found
    assert all("[aspects.bare]" in one.text for one in warnings)
