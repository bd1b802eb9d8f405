"""`enact_dist.testing`: actors in process, synchronously, on a manual clock."""

from __future__ import annotations

import pytest

from enact_dist import testing
from enact_dist.access.lock import Lock
from enact_dist.actor.actor import Actor
from enact_dist.errors import LeaseLostError, MisuseError, NullDatumError, UnknownWorldError
from enact_dist.terms import (
    Aspect,
    Entities,
    Entity,
    Read,
    View,
    ViewEach,
    World,
    Write,
    WriteEach,
)

training, online = World("training"), World("online")
PRODUCTS, SYSTEM = Entities("product/*"), Entity("system")
SIZE, FLAGS, TOTAL = Aspect("size", int), Aspect("flags", dict), Aspect("total", int)
CUBE, BOX = Entity("product/cube"), Entity("product/box")


class Deviation(Actor):
    """Flag products whose observed size differs from the trained one."""

    reference = View(training, PRODUCTS, SIZE)
    observed = Read(online, PRODUCTS, SIZE)
    flags = Write(online, SYSTEM, FLAGS)
    triggers = (observed,)

    def __init__(self, tolerance: int = 0) -> None:
        self.tolerance = tolerance

    def update(self, lock: Lock) -> None:
        off = abs(lock[self.reference] - lock[self.observed]) > self.tolerance
        lock[self.flags] = {**lock.get(self.flags, {}), lock.entity.name: off}


class Sum(Actor):
    """Add up all sizes."""

    sizes = ViewEach(online, PRODUCTS, SIZE)
    total = Write(online, SYSTEM, TOTAL)
    triggers = (sizes,)

    def update(self, lock: Lock) -> None:
        lock[self.total] = sum(lock[self.sizes].values())


class Camera(Actor):
    """See one more product per tick."""

    sizes = WriteEach(online, PRODUCTS, SIZE)
    every_s = 0.1

    def update(self, lock: Lock) -> None:
        seen = lock[self.sizes]
        seen[Entity(f"product/{len(seen)}")] = 10 + len(seen)


def flags_of(cell) -> dict[str, bool]:
    """Return what Deviation flagged."""
    request = View(cell.world("online"), SYSTEM, FLAGS)
    return cell.world("online").view(request)[request]


def test_run_once_updates_each_entity_once_when_its_trigger_exists():
    """At the first call every existing entity is pending; each has its own triggering entity."""
    with testing.worlds("training", "online") as cell:
        for entity, trained, seen in ((CUBE, 10, 10), (BOX, 20, 25)):
            cell.world("training").init(entity, SIZE, trained)
            cell.world("online").init(entity, SIZE, seen)

        updates = testing.run_once(Deviation(), cell)

        assert updates == 2
        assert flags_of(cell) == {"product/cube": False, "product/box": True}


def test_run_once_updates_only_what_changed_when_called_again():
    """The same actor object does not look at the same datum twice; a new one does."""
    with testing.worlds("training", "online") as cell:
        for entity in (CUBE, BOX):
            cell.world("training").init(entity, SIZE, 10)
            cell.world("online").init(entity, SIZE, 10)
        actor = Deviation()
        testing.run_once(actor, cell)
        observed = Write(cell.world("online"), BOX, SIZE)
        with Lock(observed) as lock:
            lock[observed] = 99

        assert testing.run_once(actor, cell) == 1
        assert flags_of(cell)["product/box"]
        assert testing.run_once(actor, cell) == 0
        assert testing.run_once(Deviation(), cell) == 2


def test_run_once_translates_roles_when_they_are_bound_crosswise():
    """Roles are what the class says, worlds what they are bound to; names alone decide nothing."""
    with testing.worlds("training", "online") as cell:
        cell.world("training").init(CUBE, SIZE, 7)
        cell.world("online").init(CUBE, SIZE, 5)
        seen = {}

        class Look(Actor):
            mine = View(training, PRODUCTS, SIZE)
            other = View(online, PRODUCTS, SIZE)
            note = Write(online, SYSTEM, TOTAL)
            triggers = (mine,)

            def update(self, lock: Lock) -> None:
                seen.update(
                    mine=lock[self.mine],
                    other=lock.get(self.other),
                    version=lock.version(self.mine),
                )
                lock[self.note] = 1

        testing.run_once(Look(), cell, {"training": "online", "online": "training"})

        assert seen == {"mine": 5, "other": 7, "version": 1}
        note = View(cell.world("training"), SYSTEM, TOTAL)
        assert cell.world("training").view(note)[note] == 1


def test_run_once_updates_a_set_once_when_many_of_it_changed():
    """An actor that looks at a whole set runs once for all of its changes."""
    with testing.worlds("online") as cell:
        for entity in (CUBE, BOX):
            cell.world("online").init(entity, SIZE, 10)
        total = View(cell.world("online"), SYSTEM, TOTAL)
        actor = Sum()

        assert testing.run_once(actor, cell) == 1
        assert cell.world("online").view(total)[total] == 20


def test_run_once_updates_a_set_again_when_one_of_it_became_null():
    """A datum that left the set is a change of the set."""
    with testing.worlds("online") as cell:
        for entity in (CUBE, BOX):
            cell.world("online").init(entity, SIZE, 10)
        total = View(cell.world("online"), SYSTEM, TOTAL)
        actor = Sum()
        testing.run_once(actor, cell)
        box = Write(cell.world("online"), BOX, SIZE)
        with Lock(box) as lock:
            del lock[box]

        assert testing.run_once(actor, cell) == 1
        assert cell.world("online").view(total)[total] == 10


def test_run_once_ticks_a_source_once_per_call():
    """A source is not triggered: it runs each time it is asked."""
    with testing.worlds("online") as cell:
        actor = Camera()

        assert [testing.run_once(actor, cell) for _ in range(3)] == [1, 1, 1]
        assert len(cell.world("online").entities("product/*")) == 3


def test_run_once_raises_what_update_raises_and_publishes_nothing():
    """The error comes out as it is; the other entities stay pending."""
    with testing.worlds("training", "online") as cell:
        for entity in (BOX, CUBE):
            cell.world("online").init(entity, SIZE, 10)
        cell.world("training").init(CUBE, SIZE, 10)
        actor = Deviation()

        with pytest.raises(NullDatumError, match=r"product/box/size is null in training"):
            testing.run_once(actor, cell)

        assert testing.run_once(actor, cell) == 1
        assert flags_of(cell) == {"product/cube": False}


def test_run_once_opens_and_closes_what_an_actor_needs_when_update_fails():
    """`start` and `stop` frame the updates, also after an error."""
    calls = []

    class Fragile(Camera):
        def start(self) -> None:
            calls.append("start")

        def update(self, _lock: Lock) -> None:
            calls.append("update")
            raise RuntimeError("lens cap")

        def stop(self) -> None:
            calls.append("stop")

    with testing.worlds("online") as cell, pytest.raises(RuntimeError, match="lens cap"):
        testing.run_once(Fragile(), cell)

    assert calls == ["start", "update", "stop"]


def test_update_loses_its_lock_when_the_manual_clock_passes_its_hold():
    """Time is the test's: an update held too long commits nothing."""
    clock = testing.ManualClock()

    class Slow(Camera):
        hold_s = 5.0

        def update(self, lock: Lock) -> None:
            super().update(lock)
            clock.advance(6.0)

    with testing.worlds("online", clock=clock) as cell:
        with pytest.raises(LeaseLostError):
            testing.run_once(Slow(), cell)

        assert cell.world("online").entities() == ()


@pytest.mark.parametrize(
    ("worlds", "error", "message"),
    [
        ({"training": "training"}, MisuseError, r"role 'online' of Deviation is bound to no world"),
        ({"training": "training", "onlin": "online"}, MisuseError, "has no role 'onlin'"),
        ({"training": "training", "online": "outdoors"}, UnknownWorldError, "outdoors"),
        (
            {"training": "online", "online": "online"},
            MisuseError,
            "one datum with different accesses",
        ),
    ],
)
def test_binding_is_refused_when_roles_do_not_fit(
    worlds: dict[str, str], error: type[Exception], message: str
):
    """Each wrong binding is an error that names role and context."""
    with testing.worlds("training", "online") as cell, pytest.raises(error, match=message):
        testing.run_once(Deviation(), cell, worlds)


def test_binding_is_refused_when_it_makes_an_actor_its_own_trigger():
    """Two roles bound to one context must not let each update cause the next."""

    class Copy(Actor):
        source = ViewEach(training, PRODUCTS, SIZE)
        target = Write(online, Entity("product/copy"), SIZE)
        triggers = (source,)

        def update(self, lock: Lock) -> None:
            pass

    with (
        testing.worlds("one") as cell,
        pytest.raises(MisuseError, match="because both roles are bound to one"),
    ):
        testing.run_once(Copy(), cell, {"training": "one", "online": "one"})


def test_manual_clock_stands_still_until_it_is_advanced():
    """Both clocks move together, forward only."""
    clock = testing.ManualClock(start_s=5.0)

    clock.advance(0.25)

    assert clock.monotonic_ns() == clock.wall_ns() == 5_250_000_000
    with pytest.raises(ValueError, match="cannot go back"):
        clock.advance(-1.0)
