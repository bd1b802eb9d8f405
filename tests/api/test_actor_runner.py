"""Running actors: triggers, refusals, failures, rates, clean stop.  Real core, in process."""

from __future__ import annotations

import logging
import threading
from typing import TYPE_CHECKING

import pytest

from enact_dist import ActorThread, testing
from enact_dist.access.lock import Lock
from enact_dist.actor import binding as actor_binding
from enact_dist.actor.actor import Actor
from enact_dist.actor.binding import BoundActor
from enact_dist.actor.inbox import Inbox, Watching
from enact_dist.actor.report import read_reports
from enact_dist.actor.running.runner import run_actor
from enact_dist.errors import (
    ChangedError,
    CommitUnknownError,
    LeaseLostError,
    LockTimeoutError,
    MisuseError,
    ShardUnreachableError,
)
from enact_dist.terms import Aspect, Entities, Entity, View, World, Write
from enact_dist.world.connecting import local
from enact_dist.world.context import watch_patterns
from enact_dist.world.listings import unpacked_report

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.carrier("local", "drawn")

online = World("online")
VIEWS = Entities("view/*")
CLOUD, SURFACE, COUNT = Aspect("cloud", int), Aspect("surface", int), Aspect("count", int)
A, B, SYSTEM = Entity("view/a"), Entity("view/b"), Entity("system")
PATIENCE_S = 60.0


@pytest.fixture
def cell() -> Iterator:
    """A cell in this process with the world context `online`."""
    with local(worlds=["online"]) as cell:
        yield cell


class Reconstruction(Actor):
    """Make a surface of each cloud; tells the test through `seen` and waits for it at `gate`."""

    cloud = View(online, VIEWS, CLOUD)
    surface = Write(online, VIEWS, SURFACE)
    triggers = (cloud,)

    def __init__(self) -> None:
        self.gate = threading.Semaphore(1_000)
        self.seen: list[tuple[str, int]] = []
        self.moved = threading.Condition()

    def update(self, lock: Lock) -> None:
        cloud = lock[self.cloud]
        with self.moved:
            self.seen.append((lock.entity.name, cloud))
            self.moved.notify_all()
        assert self.gate.acquire(timeout=PATIENCE_S)
        if cloud < 0:
            raise ValueError(f"cloud {cloud} is empty")
        lock[self.surface] = 10 * cloud

    def wait_until_seen(self, *seen: tuple[str, int]) -> None:
        """Wait until the updates so far include these."""
        with self.moved:
            assert self.moved.wait_for(lambda: set(seen) <= set(self.seen), PATIENCE_S), self.seen


class Counter(Actor):
    """Count its own ticks; sets `reached` at the fifth."""

    count = Write(online, SYSTEM, COUNT)

    def __init__(self, period_s: float, reached: threading.Event) -> None:
        self.every_s = period_s
        self.reached = reached

    def update(self, lock: Lock) -> None:
        lock[self.count] = lock.get(self.count, 0) + 1
        if lock[self.count] == 5:
            self.reached.set()


def write(cell, entity: Entity, cloud: int) -> None:
    """Commit a cloud."""
    request = Write(cell.world("online"), entity, CLOUD)
    with Lock(request) as lock:
        lock[request] = cloud


def wait_for_surface(cell, entity: Entity, surface: int) -> None:
    """Wait until a surface is committed."""
    request = View(cell.world("online"), entity, SURFACE)
    with cell.world("online").watch(entity, SURFACE) as watch:
        while watch.next(PATIENCE_S) is not None:
            if cell.world("online").view(request).get(request) == surface:
                return
    raise AssertionError(f"no surface {surface} of {entity} within {PATIENCE_S} s")


def test_actor_updates_existing_and_new_entities_when_it_runs(cell):
    """At the start once per existing entity, then once per change; every result is committed."""
    write(cell, A, 1)
    with ActorThread(Reconstruction(), cell) as thread:
        wait_for_surface(cell, A, 10)

        write(cell, B, 2)
        write(cell, A, 3)

        wait_for_surface(cell, B, 20)
        wait_for_surface(cell, A, 30)
    found = thread.statistics()
    assert (found.updates, found.failures, found.refused) == (3, 0, 0)
    assert found.state == "stopped"


def test_actor_sees_only_the_newest_datum_when_changes_come_faster(cell):
    """Changes during an update share the next one; those that it passes over are counted."""
    actor = Reconstruction()
    actor.gate = threading.Semaphore(0)
    with ActorThread(actor, cell) as thread:
        write(cell, A, 1)
        actor.wait_until_seen(("view/a", 1))
        for cloud in (2, 3, 4, 5):
            write(cell, A, cloud)
        write(cell, B, 9)
        actor.gate.release(3)

        wait_for_surface(cell, B, 90)
        wait_for_surface(cell, A, 50)

    assert actor.seen == [("view/a", 1), ("view/a", 5), ("view/b", 9)]
    assert thread.statistics().skipped == 3


def test_actor_goes_on_and_tries_again_on_change_when_an_update_fails(cell, caplog):
    """An exception is counted, kept, told and logged; the entity runs again when it changes."""
    told = []
    caplog.set_level(logging.CRITICAL, logger="enact.actor")
    actor = Reconstruction()
    write(cell, A, -1)
    with ActorThread(actor, cell, on_error=lambda *error: told.append(error)) as thread:
        actor.wait_until_seen(("view/a", -1))
        write(cell, B, 2)
        wait_for_surface(cell, B, 20)
        write(cell, A, 4)
        wait_for_surface(cell, A, 40)

    found = thread.statistics()
    assert (found.updates, found.failures) == (2, 1)
    assert found.last_error == "ValueError: cloud -1 is empty"
    assert [(entity, str(error)) for entity, error in told] == [(A, "cloud -1 is empty")]


def test_actor_tries_again_when_its_lock_was_not_granted(cell):
    """A lock held by another is a refusal, not a failure; the datum is not forgotten."""
    refused = threading.Event()
    errors = []

    def on_error(_entity: Entity | None, error: Exception) -> None:
        errors.append(error)
        refused.set()

    write(cell, A, 1)
    held = Write(cell.world("online"), A, SURFACE)
    thread = ActorThread(Reconstruction(), cell, wait_s=0.01, on_error=on_error)
    with Lock(held):
        thread.start()
        assert refused.wait(PATIENCE_S)
    wait_for_surface(cell, A, 10)
    thread.stop()

    assert {type(error) for error in errors} == {LockTimeoutError}
    found = thread.join(PATIENCE_S)
    assert found.refused == len(errors)
    assert (found.updates, found.failures) == (1, 0)


@pytest.mark.parametrize(
    ("refusal", "unknown"),
    [
        (LeaseLostError("lease expired"), 0),
        (ChangedError("view moved on"), 0),
        (ShardUnreachableError("shard left is silent"), 0),
        (CommitUnknownError("no answer"), 1),
    ],
    ids=lambda value: type(value).__name__,
)
def test_actor_tries_again_after_each_error_that_is_not_its_own(
    cell, refusal: Exception, unknown: int
):
    """Lease, view, shard or answer lost: the same datum is looked at again, by itself."""

    class Unlucky(Reconstruction):
        def update(self, lock: Lock) -> None:
            super().update(lock)
            if len(self.seen) == 1:
                raise refusal

    write(cell, A, 1)
    with ActorThread(Unlucky(), cell) as thread:
        wait_for_surface(cell, A, 10)

    found = thread.statistics()
    assert (found.updates, found.refused, found.failures) == (1, 1, 0)
    assert found.unknown == unknown
    assert found.last_error.startswith(type(refusal).__name__)


def test_source_counts_a_refused_tick_as_missed_when_it_goes_on(cell):
    """A source does not repeat a tick: the next one takes a newer measurement."""
    reached = threading.Event()

    class Unlucky(Counter):
        ticks = 0

        def update(self, lock: Lock) -> None:
            self.ticks += 1
            super().update(lock)
            if self.ticks == 1:
                raise LeaseLostError("lease expired")

    actor = Unlucky(0.002, reached)
    with ActorThread(actor, cell) as thread:
        assert reached.wait(PATIENCE_S)

    found = thread.statistics()
    assert actor.ticks == found.updates + 1
    assert found.refused == 1
    assert found.missed >= 1


def test_actor_that_runs_once_tries_again_when_it_was_refused(cell):
    """Only an error of its own ends it early."""
    refusals = [LeaseLostError("lease expired"), ShardUnreachableError("silent")]

    class Initial(Actor):
        count = Write(online, SYSTEM, COUNT)

        def update(self, lock: Lock) -> None:
            if refusals:
                raise refusals.pop()
            lock[self.count] = 1

    found = run_actor(Initial(), cell, stop=threading.Event())

    assert (found.updates, found.refused, found.state) == (1, 2, "done")


@pytest.mark.parametrize("own", [False, True])
def test_watching_opens_a_watch_again_when_its_shard_was_away(cell, caplog, monkeypatch, own):
    """No change is lost: the watch that opens at last begins with what is there."""
    answers = iter((False, False, True))

    def flaky(*args, **options):
        if not next(answers):
            raise ShardUnreachableError("shard left did not answer")
        return watch_patterns(*args, **options)

    monkeypatch.setattr("enact_dist.actor.inbox.watch_patterns", flaky)
    caplog.set_level(logging.CRITICAL, logger="enact.actor")
    write(cell, A, 1)
    bound = BoundActor(Reconstruction(), cell)
    inbox = Inbox(per_entity=True)

    with Watching(bound, inbox, own=own) as changes:
        trigger = changes.take(PATIENCE_S)

    assert trigger is not None
    assert trigger.entity == A


def test_watch_of_an_actor_that_breaks_is_opened_again_without_a_loss(cell, caplog, monkeypatch):
    """What changed meanwhile is found at the new beginning, what was seen runs no second time."""
    caplog.set_level(logging.CRITICAL, logger="enact.actor")
    bound = BoundActor(Reconstruction(), cell)
    with Watching(bound, Inbox(per_entity=True)) as changes:
        write(cell, A, 1)
        assert changes.take(PATIENCE_S).entity == A

        def away(**_):
            raise ShardUnreachableError("shard left did not answer")

        monkeypatch.setattr(changes._followers[0]._watch, "next", away)
        assert changes.take(0.0) is None
        write(cell, B, 2)

        assert changes.take(PATIENCE_S).entity == B
        assert changes.take(0.0) is None


def test_actor_of_one_world_follows_it_by_its_own_thread(cell):
    """Nobody is woken to wake somebody else; two world contexts are two watches."""
    bound = BoundActor(Reconstruction(), cell)

    assert Watching(bound, Inbox(per_entity=True)).own


def test_requests_are_bound_once_per_entity_and_not_kept_without_end(cell, monkeypatch):
    """Locks of one entity share their requests, those of another one have their own."""
    monkeypatch.setattr(actor_binding, "ENTITIES_MAX", 2)
    bound = BoundActor(Reconstruction(), cell)

    def requests(entity):
        return list(bound.lock(entity)._declared.values())

    first, other = requests(A), requests(B)
    assert all(one is again for one, again in zip(first, requests(A), strict=True))
    assert {request.entity for request in first if request.entity in (A, B)} == {A}
    assert {request.entity for request in other if request.entity in (A, B)} == {B}
    requests(Entity("view/third"))
    assert len(bound._by_entity) == 1
    assert requests(A) == first


def test_inbox_returns_nothing_when_nothing_changes_in_time():
    """Waiting ends after its time, so that a stopped actor is not kept."""
    assert Inbox(per_entity=True).take(0.0) is None


def test_actor_tries_again_when_its_lease_was_lost():
    """An update whose lock ran out commits nothing and runs again."""
    clock = testing.ManualClock()
    errors = []

    class Slow(Reconstruction):
        hold_s = 5.0

        def update(self, lock: Lock) -> None:
            super().update(lock)
            if len(self.seen) == 1:
                clock.advance(6.0)

    with testing.worlds("online", clock=clock) as cell:
        write(cell, A, 1)
        with ActorThread(Slow(), cell, on_error=lambda *error: errors.append(error)) as thread:
            wait_for_surface(cell, A, 10)

    assert [type(error) for _, error in errors] == [LeaseLostError]
    assert (thread.statistics().updates, thread.statistics().refused) == (1, 1)


def test_actor_finishes_its_update_when_it_is_stopped(cell):
    """Stopping is clean: what has begun is committed."""
    actor = Reconstruction()
    actor.gate = threading.Semaphore(0)
    write(cell, A, 1)
    thread = ActorThread(actor, cell).start()
    actor.wait_until_seen(("view/a", 1))

    thread.stop()
    actor.gate.release()
    found = thread.join(PATIENCE_S)

    assert (found.updates, found.state) == (1, "stopped")
    wait_for_surface(cell, A, 10)


def test_source_runs_at_its_period_until_it_is_stopped(cell):
    """A source needs no trigger; its period may be an option of the instance."""
    stop = threading.Event()

    found = run_actor(Counter(0.002, stop), cell, stop=stop)

    request = View(cell.world("online"), SYSTEM, COUNT)
    assert cell.world("online").view(request)[request] == 5
    assert (found.updates, found.state) == (5, "stopped")


def test_actor_without_trigger_and_period_runs_once(cell):
    """It is done after its first update."""

    class Initial(Actor):
        count = Write(online, SYSTEM, COUNT)

        def update(self, lock: Lock) -> None:
            lock[self.count] = 1

    found = run_actor(Initial(), cell, stop=threading.Event())

    assert (found.updates, found.state) == (1, "done")


def test_actor_that_runs_once_is_over_when_it_fails(cell, caplog):
    """Nothing would ever run it again; the failure is in the statistics."""
    caplog.set_level(logging.CRITICAL, logger="enact.actor")

    class Broken(Actor):
        count = Write(online, SYSTEM, COUNT)

        def update(self, _lock: Lock) -> None:
            raise OSError("no such model file")

    found = run_actor(Broken(), cell, stop=threading.Event())

    assert (found.updates, found.failures, found.state) == (0, 1, "done")
    assert found.last_error == "OSError: no such model file"


def test_reports_of_all_actors_of_a_cell_are_shown_together(cell):
    """What `enact actor ls` shows comes with the session's keep-alive."""
    write(cell, A, 1)

    with (
        ActorThread(Reconstruction(), cell, name="front"),
        ActorThread(Reconstruction(), cell, {"online": "online"}, name="back"),
    ):
        wait_for_surface(cell, A, 10)

    found = read_reports(unpacked_report(cell._client.core.report))
    assert {report.name for report in found} == {"front", "back"}
    assert {report.state for report in found} == {"stopped"}


def test_thread_raises_at_its_end_when_its_cell_was_closed(cell):
    """A run that cannot go on says why instead of ending silently, triggered or not."""
    reached = threading.Event()
    write(cell, A, 1)
    threads = [
        ActorThread(Reconstruction(), cell).start(),
        ActorThread(Counter(0.002, reached), cell).start(),
    ]
    wait_for_surface(cell, A, 10)
    assert reached.wait(PATIENCE_S)

    cell.close()

    for thread in threads:
        with pytest.raises(MisuseError, match="closed"):
            thread.join(PATIENCE_S)


def test_run_calls_start_and_stop_once_when_updates_fail(cell, caplog):
    """What `start` opened is closed, whatever happened between."""
    caplog.set_level(logging.CRITICAL, logger="enact.actor")
    calls = []

    class Device(Actor):
        count = Write(online, SYSTEM, COUNT)

        def start(self) -> None:
            calls.append("start")

        def update(self, _lock: Lock) -> None:
            calls.append("update")
            raise RuntimeError("unplugged")

        def stop(self) -> None:
            calls.append("stop")

    run_actor(Device(), cell, stop=threading.Event())

    assert calls == ["start", "update", "stop"]


def test_actor_is_refused_when_it_has_no_update(cell):
    """A base class cannot run."""
    with pytest.raises(MisuseError, match="defines update"):
        run_actor(Actor(), cell, stop=threading.Event())
