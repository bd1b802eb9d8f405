"""A step of an actor runs again on what its commit had read, and changes nothing else."""

import threading
from dataclasses import dataclass

import pytest

from enact_dist import (
    Actor,
    Aspect,
    Entities,
    Entity,
    Lock,
    Outcome,
    Read,
    ReadEach,
    Retention,
    Together,
    Tolerance,
    View,
    World,
    Write,
    local,
    testing,
)
from enact_dist.actor.running.step import Step
from enact_dist.errors import ForgottenError, MisuseError, NullDatumError

LEVEL = Aspect("level_in_steps", float, compare=Tolerance(absolute=0.5))
SUM = Aspect("sum_in_steps", float)
NOTE = Aspect("note_in_steps", str)
SHORT = Aspect("short_in_steps", int, retention=Retention(versions=1))
ROWS = Aspect("rows_in_steps", list)
TANKS = Entities("tank/*")


@pytest.fixture
def cell():
    with local(worlds=["plant", "model"]) as opened:
        yield opened


def put(world, entity, aspect, datum, stamp_ns=None):
    request = Write(world, Entity(entity), aspect)
    with Lock(request) as lock:
        lock.put(request, datum, stamp_ns=stamp_ns)


def everything(cell):
    """Each slot of each world context with its version and stamp, and what contexts there are."""
    return {
        name: [
            (i.entity.name, i.aspect, i.version, i.position) for i in cell.world(name).list_slots()
        ]
        for name in cell.worlds()
    }


class Scaled(Actor):
    """Writes a level of one context into another, by the factor of its model."""

    plant, model = World("plant"), World("model")
    level = View(plant, TANKS, LEVEL)
    factor = Read(model, Entity("scale"), SUM)
    scaled = Write(model, TANKS, LEVEL)
    count = Write(model, Entity("scale"), NOTE)
    triggers = (level,)

    def __init__(self, more: float = 0.0) -> None:
        self.more = more

    def update(self, lock):
        lock[self.scaled] = lock[self.level] * lock[self.factor] + self.more
        lock[self.count] = lock.get(self.count, "") + "x"


def scaled_cell(cell):
    """Two tanks, whose levels were scaled by 2; then all has changed."""
    plant, model = cell.world("plant"), cell.world("model")
    put(model, "scale", SUM, 2.0)
    actor = Scaled()
    for name, level in (("tank/1", 10.0), ("tank/2", 20.0)):
        put(plant, name, LEVEL, level)
        testing.run_once(actor, cell)
    put(model, "scale", SUM, 7.0)
    put(plant, "tank/1", LEVEL, 99.0)
    put(plant, "tank/2", LEVEL, 99.0)


def test_same_code_makes_no_difference_and_changes_nothing(cell):
    """Over two world contexts, of a version that is not the newest, and of its entity."""
    scaled_cell(cell)
    before = everything(cell)
    result = Step(cell, "model", "tank/1", LEVEL.name, 1).run(Scaled())

    assert not result.differs
    assert (result.entity, result.error, result.remarks) == ("tank/1", "", ())
    assert sorted(result.contexts) == ["model", "plant"]
    (diff,) = result.differences
    assert (diff.left, diff.right, diff.equal) == ("model then", "model now", 2)
    assert everything(cell) == before


def test_changed_code_shows_the_difference(cell):
    """By the comparator of the aspect, or by another that is given."""
    scaled_cell(cell)
    step = Step(cell, "model", "tank/2", LEVEL.name, 1)
    little, much = step.run(Scaled(more=0.4)), step.run(Scaled(more=3.0))
    loose = {LEVEL.name: Aspect(LEVEL.name, object, compare=Tolerance(absolute=5.0))}

    assert not little.differs
    assert little.differences[0].within == 1
    ((row,),) = much.differences
    assert (row.entity.name, row.difference.distance) == ("tank/2", pytest.approx(3.0))
    assert not step.run(Scaled(more=3.0), tolerances=loose).differs


def test_what_code_writes_no_more_or_anew_is_a_difference(cell):
    """One side alone has it."""
    scaled_cell(cell)

    class Other(Scaled):
        def update(self, lock):
            lock[self.scaled] = lock[self.level] * lock[self.factor]
            lock[self.count] = ""
            del lock[self.count]

    ((row,),) = Step(cell, "model", "tank/1", LEVEL.name, 1).run(Other()).differences
    assert (row.aspect, row.kind.value) == (NOTE.name, "only left")


def test_contexts_of_a_step_can_be_kept(cell):
    """Under a name, of several with the world's own; a name that is taken is refused before."""
    scaled_cell(cell)
    step = Step(cell, "model", "tank/1", LEVEL.name, 1)
    result = step.run(Scaled(more=1.0), keep_as="tried")

    assert result.contexts == {"plant": "tried-plant", "model": "tried-model"}
    assert cell.world("tried-model").get_untyped(Entity("tank/1"), LEVEL.name) == 21.0
    assert cell.world("tried-plant").get_untyped(Entity("tank/1"), LEVEL.name) == 10.0
    with pytest.raises(MisuseError, match="world context 'tried-plant'; take another name"):
        step.run(Scaled(), keep_as="tried")
    assert "tried-plant" in cell.worlds()


def test_roles_are_bound_to_other_contexts(cell):
    """As when the actor runs."""
    put(cell.world("plant"), "scale", SUM, 2.0)
    put(cell.world("model"), "tank/1", LEVEL, 4.0)
    worlds = {"plant": "model", "model": "plant"}
    testing.run_once(Scaled(), cell, worlds)
    step = Step(cell, "plant", "tank/1", LEVEL.name)

    assert not step.run(Scaled(), worlds).differs
    with pytest.raises(MisuseError, match="Scaled does not write plant:tank/1/level_in_steps"):
        step.run(Scaled())


class Totals(Actor):
    """Adds the levels of all tanks that are there."""

    plant = World("plant")
    levels = ReadEach(plant, TANKS, LEVEL)
    total = Write(plant, Entity("total"), SUM)
    triggers = (levels,)

    def update(self, lock):
        lock[self.total] = sum(lock[self.levels].values())


def test_set_of_a_pattern_is_that_of_its_time(cell):
    """A tank that came later is not in it, one that went is."""
    plant = cell.world("plant")
    for name in ("tank/1", "tank/2"):
        put(plant, name, LEVEL, 5.0)
    testing.run_once(Totals(), cell)
    put(plant, "tank/3", LEVEL, 50.0)
    gone = Write(plant, Entity("tank/1"), LEVEL)
    with Lock(gone) as lock:
        del lock[gone]
    result = Step(cell, "plant", "total", SUM.name).run(Totals())

    assert not result.differs
    assert result.inputs == 2


class Slow(Actor):
    """Views a level, which changes before it has written."""

    plant = World("plant")
    level = View(plant, Entity("tank/1"), LEVEL)
    total = Write(plant, Entity("total"), SUM)
    triggers = (level,)

    def update(self, lock):
        lock[self.total] = lock[self.level]


def test_view_shows_what_the_commit_had_seen(cell):
    """Not what was there at the moment of the commit."""
    plant = cell.world("plant")
    put(plant, "tank/1", LEVEL, 1.0)
    view, total = View(plant, Entity("tank/1"), LEVEL), Write(plant, Entity("total"), SUM)

    def meanwhile():
        thread = threading.Thread(target=put, args=(plant, "tank/1", LEVEL, 2.0))
        thread.start()
        thread.join()

    with Lock(view, total) as lock:
        seen = lock[view]
        meanwhile()
        lock[total] = seen
    result = Step(cell, "plant", "total", SUM.name).run(Slow())

    assert not result.differs


class Tick(Actor):
    """A source: it reads nothing, and writes when it ran."""

    plant = World("plant")
    rows = Write(plant, Entity("clock"), ROWS)
    every_s = 0.5

    def update(self, lock):
        lock[self.rows] = [lock.tick_ns]


def test_source_has_the_tick_of_its_time(cell):
    """Its capture stamp says which it was."""
    testing.run_once(Tick(), cell)
    result = Step(cell, "plant", "clock", ROWS.name).run(Tick())

    assert (result.inputs, result.differs, result.entity) == (0, False, "")


class Pairs(Actor):
    """Adds two levels of one capture stamp."""

    plant = World("plant")
    pair = Together([View(plant, Entity("tank/1"), LEVEL), View(plant, Entity("tank/2"), LEVEL)])
    total = Write(plant, Entity("total"), SUM)
    triggers = (pair,)

    def update(self, lock):
        lock[self.total] = sum(lock[self.pair])


def test_set_of_one_capture_stamp_is_given_again(cell):
    """Its data were replaced at different times, and never were the newest together."""
    plant = cell.world("plant")
    put(plant, "tank/1", LEVEL, 1.0, 100)
    put(plant, "tank/1", LEVEL, 10.0, 200)
    put(plant, "tank/2", LEVEL, 2.0, 100)
    testing.run_once(Pairs(), cell)
    put(plant, "tank/2", LEVEL, 20.0, 200)
    result = Step(cell, "plant", "total", SUM.name).run(Pairs())

    assert (result.differs, result.inputs) == (False, 2)
    assert result.differences[0].equal == 1


def test_exception_of_update_is_returned_with_its_place(cell):
    """Nothing is published by it, `stop` is called, and the contexts are gone."""
    scaled_cell(cell)
    stopped = []

    class Fails(Scaled):
        def update(self, lock):
            lock[self.scaled] = 1.0
            raise ValueError("no such level")

        def stop(self):
            stopped.append(1)

    class Leaves(Scaled):
        def update(self, lock):
            raise SystemExit(3)

    before = everything(cell)
    step = Step(cell, "model", "tank/1", LEVEL.name, 1)
    result, left = step.run(Fails()), step.run(Leaves())

    assert result.error.startswith("ValueError at ")
    assert result.error.endswith(": no such level")
    assert any("raise ValueError" in line for line in result.traceback)
    assert (result.differs, result.differences) == (False, ())
    assert left.error.startswith("SystemExit at ")
    assert stopped == [1]
    assert everything(cell) == before


def test_failing_start_is_told_as_that(cell):
    """It is not the step that failed."""
    scaled_cell(cell)

    class NoCamera(Scaled):
        def start(self):
            raise OSError("no camera")

    before = everything(cell)
    with pytest.raises(MisuseError, match=r"start of actor NoCamera failed: OSError .*no camera"):
        Step(cell, "model", "tank/1", LEVEL.name, 1).run(NoCamera())
    assert everything(cell) == before


class Doubled(Actor):
    """Doubles a datum of which no history is kept."""

    plant = World("plant")
    short = Read(plant, Entity("short"), SHORT)
    note = Write(plant, Entity("short"), NOTE)
    triggers = (short,)

    def update(self, lock):
        lock[self.note] = str(2 * lock[self.short])


def test_forgotten_input_is_named_with_how_to_keep_it(cell):
    """A label that pins it in time is enough; the rest of the world context need not be known."""
    plant = cell.world("plant")
    for number in (1, 2):
        put(plant, "short", SHORT, number)
        testing.run_once(Doubled(), cell)
        if number == 2:
            cell.pin("kept", (one for one in cell.why("plant", "short", NOTE.name).walk()))
        put(plant, "other", SHORT, number)
    put(plant, "short", SHORT, 3)

    with pytest.raises(ForgottenError, match=r"plant:short/short_in_steps v1, which .*--pin LABEL"):
        Step(cell, "plant", "short", NOTE.name, 1).run(Doubled())
    result = Step(cell, "plant", "short", NOTE.name, 2).run(Doubled())
    assert not result.differs


class Both(Actor):
    """Writes a datum with history and one without."""

    plant = World("plant")
    level = Read(plant, Entity("tank/1"), LEVEL)
    note, short = Write(plant, Entity("both"), NOTE), Write(plant, Entity("both"), SHORT)
    triggers = (level,)

    def update(self, lock):
        lock[self.note] = str(lock[self.level])
        lock[self.short] = int(lock[self.level])


def test_output_that_is_forgotten_is_named_and_the_others_are_compared(cell):
    """The version that was asked for is known."""
    plant, actor = cell.world("plant"), Both()
    for level in (1.0, 2.0, 3.0):
        put(plant, "tank/1", LEVEL, level)
        testing.run_once(actor, cell)
    result = Step(cell, "plant", "both", NOTE.name, 2).run(Both())

    assert result.remarks == (
        "null in the step, because their state of that time is forgotten: plant:both/short_in_steps",
        "not compared, because that version is forgotten: plant:both/short_in_steps",
    )
    assert [(diff.equal, diff.rows) for diff in result.differences] == [(1, ())]


def test_versions_that_cannot_be_run_again_are_refused(cell):
    """Never set, not there yet, forked, written by an actor that moves something."""
    scaled_cell(cell)
    with pytest.raises(NullDatumError):
        Step(cell, "plant", "nothing", LEVEL.name)
    with pytest.raises(MisuseError, match="has no version 99"):
        Step(cell, "model", "tank/1", LEVEL.name, 99)
    cell.world("model").fork("copy")
    with pytest.raises(MisuseError, match=r"made by a fork.*replay model:tank/1/level_in_steps@1"):
        Step(cell, "copy", "tank/1", LEVEL.name)

    @dataclass
    class Moves(Actor):
        plant = World("plant")
        level = Read(plant, TANKS, LEVEL)
        outcome = Write(plant, TANKS, Aspect("outcome_in_steps", Outcome))
        triggers = (level,)
        once = True

        def update(self, lock):
            raise AssertionError("it must not move")

    testing.run_once(Totals(), cell)
    with pytest.raises(MisuseError, match="Moves has once = True"):
        Step(cell, "plant", "total", SUM.name).run(Moves())


def test_entity_that_is_not_clear_is_asked_for(cell):
    """Two entities were read in the same way, and none was written."""
    scaled_cell(cell)
    plant = cell.world("plant")

    class Any1(Actor):
        plant = World("plant")
        level = View(plant, TANKS, LEVEL)
        total = Write(plant, Entity("total"), SUM)
        triggers = (level,)

        def update(self, lock):
            lock[self.total] = lock[self.level]

    reads = [View(plant, Entity(name), LEVEL) for name in ("tank/1", "tank/2")]
    total = Write(plant, Entity("total"), SUM)
    with Lock(*reads, total) as lock:
        lock[total] = lock[reads[0]]
    step = Step(cell, "plant", "total", SUM.name)
    with pytest.raises(MisuseError, match="may be tank/1, tank/2; name it"):
        step.run(Any1())
    actor = Any1()
    actor.only_entity = Entity("tank/1")
    result = step.run(actor)
    assert (result.entity, result.differs) == ("tank/1", False)
    assert result.remarks == (
        "read by the commit, and not declared by this actor: plant:tank/2/level_in_steps",
    )
