"""A step that ends otherwise than it should, and what it takes over of the commit."""

import pytest

from enact_dist import Actor, Aspect, Entities, Entity, Lock, View, ViewEach, World, Write, local
from enact_dist import testing as enact_testing
from enact_dist.access.session import Session
from enact_dist.actor.running.step import Step
from enact_dist.errors import LinkError, MisuseError, ShardUnreachableError
from enact_dist.world import version_data
from enact_dist.world.cell import Cell

LEVEL = Aspect("level_in_edges", float)
TICKS = Aspect("ticks_in_edges", list)
TANK = Entity("tank/1")
PERIOD_NS = 500_000_000


class Doubles(Actor):
    """Doubles a level, into another world context."""

    plant, model = World("plant"), World("model")
    level = View(plant, TANK, LEVEL)
    double = Write(model, TANK, LEVEL)
    triggers = (level,)

    def update(self, lock):
        lock[self.double] = 2.0 * lock[self.level]


@pytest.fixture
def cell():
    """A cell in which a level was doubled once."""
    with local(worlds=["plant", "model", "log"]) as opened:
        put(opened, "plant", 4.0)
        enact_testing.run_once(Doubles(), opened)
        yield opened


@pytest.fixture
def step(cell):
    return Step(cell, "model", "tank/1", LEVEL.name)


def put(cell, world, level, entity=TANK):
    request = Write(cell.world(world), entity, LEVEL)
    with Lock(request) as lock:
        lock[request] = level


def test_name_that_is_taken_meanwhile_is_left_alone(cell, monkeypatch):
    """Between the look at what there is and the making of it another process may come first."""
    step, names = Step(cell, "model", "tank/1", LEVEL.name), Step._names

    def raced(self, bound, keep_as):
        found = names(self, bound, keep_as)
        cell.create_world("mine-model")
        put(cell, "mine-model", 7.0)
        return found

    monkeypatch.setattr(Step, "_names", raced)
    with pytest.raises(MisuseError, match="there is a world context 'mine-model'"):
        step.run(Doubles(), keep_as="mine")

    assert set(cell.worlds()) == {"plant", "model", "log", "mine-model"}
    assert cell.world("mine-model").get_untyped(TANK, LEVEL.name) == 7.0


@pytest.mark.parametrize("method", ["start", "stop"])
@pytest.mark.parametrize("code", [0, "no camera"])
def test_actor_that_leaves_is_an_error_that_names_the_place(step, method, code):
    """`sys.exit(0)` is no step that writes the same."""

    def leave(_):
        raise SystemExit(code)

    actor = type("Leaves", (Doubles,), {method: leave})
    with pytest.raises(MisuseError, match=rf"Leaves\.{method} called sys.exit.*test_step_edges"):
        step.run(actor())


def test_error_of_stop_does_not_replace_that_of_update(cell, step):
    """The result names both errors; an error of `stop` alone is raised."""

    class Stops(Doubles):
        def stop(self):
            raise OSError("no arm")

    class Fails(Stops):
        def update(self, lock):
            raise ValueError("no level")

    class Interrupted(Stops):
        def update(self, lock):
            raise KeyboardInterrupt

    error = step.run(Fails()).error
    assert error.startswith("ValueError at ")
    assert ": no level; stop of actor Fails failed: OSError at " in error
    with pytest.raises(MisuseError, match="stop of actor Stops failed: OSError"):
        step.run(Stops())
    with pytest.raises(KeyboardInterrupt):
        step.run(Interrupted())
    assert set(cell.worlds()) == {"plant", "model", "log"}


class Clock(Actor):
    """A source that writes which tick it was given."""

    plant = World("plant")
    ticks = Write(plant, Entity("clock"), TICKS)
    every_s = PERIOD_NS / 1e9

    def update(self, lock):
        lock[self.ticks] = [lock.tick_ns]


@pytest.mark.parametrize("stamp_ns", [0, 123, PERIOD_NS, 10**18 + 1, 4 * 10**18])
def test_source_gets_a_tick_of_its_period_whatever_stamp_it_put(cell, stamp_ns):
    """A stamp between two ticks is an exposure's, and one after the commit is none of its time."""
    request = Write(cell.world("plant"), Entity("clock"), TICKS)
    with Lock(request) as lock:
        lock.put(request, [], stamp_ns=stamp_ns)
    made = cell.why("plant", "clock", TICKS.name)
    Step(cell, "plant", "clock", TICKS.name).run(Clock(), keep_as="kept")
    (tick_ns,) = cell.world("kept").get_untyped(Entity("clock"), TICKS.name)

    before_ns = made.position.stamp_ns - made.position.stamp_ns % PERIOD_NS
    assert tick_ns == (stamp_ns if stamp_ns == PERIOD_NS else before_ns)


def test_source_out_of_phase_gets_its_capture_stamp(cell):
    """Where its ticks began is not known."""
    request = Write(cell.world("plant"), Entity("clock"), TICKS)
    with Lock(request) as lock:
        lock.put(request, [123], stamp_ns=123)
    actor = type("Apart", (Clock,), {"in_phase": False})

    assert not Step(cell, "plant", "clock", TICKS.name).run(actor()).differs


class Sums(Actor):
    """Sums many levels."""

    plant, model = World("plant"), World("model")
    levels = ViewEach(plant, Entities("tank/*"), LEVEL)
    total = Write(model, Entity("total"), LEVEL)
    triggers = (levels,)

    def update(self, lock):
        lock[self.total] = sum(lock[self.levels].values())


def test_more_inputs_than_one_view_may_ask_for(cell, monkeypatch):
    """They are asked for in parts."""
    for number in range(2, 8):
        put(cell, "plant", float(number), Entity(f"tank/{number}"))
    enact_testing.run_once(Sums(), cell)
    asked, as_of = [], version_data._as_of

    def counted(session, wanted, at_ns):
        asked.append(len(wanted))
        return as_of(session, wanted, at_ns)

    monkeypatch.setattr(version_data, "ITEMS_MAX", 3)
    monkeypatch.setattr(version_data, "_as_of", counted)
    result = Step(cell, "model", "total", LEVEL.name).run(Sums())

    assert (result.differs, result.inputs) == (False, 7)
    assert max(asked) == 3


def test_each_context_is_dropped_by_itself(cell, step, monkeypatch):
    """What cannot be dropped is named with the command for it, and hides no other error."""
    drop, names = Cell.drop_world, []

    def away(self, name):
        if name.endswith("-plant"):
            names.append(name)
            raise ShardUnreachableError("shard local does not answer", shard="local")
        return drop(self, name)

    class Lost(Doubles):
        def start(self):
            raise MisuseError("no camera")

    monkeypatch.setattr(Cell, "drop_world", away)
    with pytest.raises(LinkError, match=r"enact world drop step-\w+-plant\).*does not answer"):
        step.run(Doubles())
    with pytest.raises(MisuseError, match="no camera") as found:
        step.run(Lost())

    assert f"enact world drop {names[1]}" in found.value.__notes__[0]
    assert set(cell.worlds()) == {"plant", "model", "log", *names}


def test_a_second_interrupt_names_the_contexts_that_remain(cell, step, monkeypatch):
    """The first one ends the update, the second one the dropping."""

    class Interrupted(Doubles):
        def update(self, lock):
            raise KeyboardInterrupt

    def interrupted(self, name):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt) as found:
        patch.setattr(Cell, "drop_world", interrupted)
        step.run(Interrupted())
    remaining = set(cell.worlds()) - {"plant", "model", "log"}
    assert remaining
    for name in remaining:
        assert f"enact world drop {name}" in found.value.__notes__[0]
        cell.drop_world(name)


def test_output_in_a_context_that_the_actor_is_not_bound_to_is_named(cell):
    """It is no output that the code of today leaves out."""
    view = View(cell.world("plant"), TANK, LEVEL)
    writes = [Write(cell.world(name), TANK, LEVEL) for name in ("model", "log")]
    with Lock(view, *writes) as lock:
        for write in writes:
            lock[write] = 8.0
    result = Step(cell, "model", "tank/1", LEVEL.name).run(Doubles())

    assert not result.differs
    (remark,) = result.remarks
    assert remark.startswith("written by the commit, and not compared: log:tank/1/level_in_edges")


def test_own_commits_are_settled_before_the_step_is_compared(cell, step, monkeypatch):
    """A shard that another one decides for may show a commit of the step only later."""
    seen, settle, list_slots = [], Session.settle, type(cell.world("plant")).list_slots

    def settles(self, shard):
        seen.append(shard)
        settle(self, shard)

    def lists(self, *words, **options):
        seen.append("listed")
        return list_slots(self, *words, **options)

    class Told(Doubles):
        def stop(self):
            seen.append("stop")

    monkeypatch.setattr(Session, "settle", settles)
    monkeypatch.setattr(type(cell.world("plant")), "list_slots", lists)
    step.run(Told())

    after = seen[seen.index("stop") + 1 :]
    assert after[: after.index("listed")] == ["local"]
