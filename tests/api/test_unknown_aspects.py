"""An aspect that is only asked for: reading registers nothing, and a misspelt name is told."""

import pytest

from enact_dist import (
    Aspect,
    Entities,
    Entity,
    Lock,
    Read,
    ReadEach,
    Retention,
    View,
    ViewEach,
    Write,
    local,
)
from enact_dist.core.protocol.datum import Slot
from enact_dist.errors import DatumTypeError, MisuseError, NullDatumError

PLAN = Aspect("plan", list[float])
MISSPELT = Aspect("plann", list[float])
robot = Entity("robot")


@pytest.fixture
def world(online):
    """A world context with one plan in it."""
    online.init(robot, PLAN, [1.0])
    return online


def registered(world) -> set[str]:
    """Return the names of the aspects that the cell knows."""
    client = world.session.client
    client.greet()
    return set(client.aspect_entries())


@pytest.mark.carrier("local", "socket", "zenoh")
def test_reading_a_misspelt_aspect_registers_nothing(world):
    """Views, locks that read and watches leave the cell as it was."""
    view, each = View(world, robot, MISSPELT), ViewEach(world, Entities("*"), MISSPELT)
    plan = Write(world, robot, PLAN)
    seen = world.view(view, each)
    assert seen.get(view) is None
    assert dict(seen[each]) == {}
    read, every = Read(world, robot, MISSPELT), ReadEach(world, Entities("r*"), MISSPELT)
    with Lock(read, every, plan) as lock:
        assert lock.is_null(read)
        lock[plan] = [2.0]
    with world.watch("*", MISSPELT) as watch:
        assert watch.next(0.0) is None

    assert registered(world) == {"plan"}


@pytest.mark.carrier("local", "socket", "zenoh")
def test_null_datum_of_an_unknown_aspect_says_so_and_names_a_near_one(world):
    """A slip of the pen reads like one, in a view and in a lock; a known aspect reads as before."""
    view, read = View(world, robot, MISSPELT), Read(world, robot, MISSPELT)
    with pytest.raises(NullDatumError, match=r"no shard knows an aspect 'plann'.*'plan'\?"):
        world.view(view)[view]
    with (
        Lock(read) as lock,
        pytest.raises(NullDatumError, match=r"no shard knows an aspect 'plann'.*'plan'\?"),
    ):
        lock[read]
    other = View(world, Entity("cart"), PLAN)
    with pytest.raises(NullDatumError) as null:
        world.view(other)[other]
    assert "knows" not in str(null.value)


@pytest.mark.carrier("local", "socket", "zenoh")
def test_known_aspect_is_refused_to_a_reader_of_another_type(cell, world):
    """Also where it came into use only after the reader had asked for it in vain."""
    wrong = Aspect("plan", dict)
    for make in (
        lambda: world.view(View(world, robot, wrong)),
        lambda: Lock(Read(world, robot, wrong)).__enter__(),
        lambda: world.watch("*", wrong),
    ):
        with pytest.raises(DatumTypeError, match="'plan' is registered with datum type"):
            make()

    goal, late = Aspect("goal", int), Aspect("goal", str)
    view, read = View(world, robot, late), Read(world, robot, late)
    assert world.view(view).get(view) is None
    other = type(world)(world.name, type(world.session)(world.session.client))
    other.init(robot, goal, 3)
    with pytest.raises(DatumTypeError, match="'goal' is registered with datum type int"):
        world.view(view)
    with pytest.raises(DatumTypeError, match="'goal' is registered with datum type int"):
        Lock(read).__enter__()
    assert cell.locks() == ()


@pytest.mark.carrier("local", "socket", "zenoh")
def test_reader_of_an_aspect_to_come_sees_it_when_it_has_come(world):
    """Who asks before the writer has come is shown null, and then the datum."""
    goal = Aspect("goal", int)
    view, each = View(world, robot, goal), ReadEach(world, Entities("*"), goal)
    assert world.view(view).get(view) is None
    with world.watch("*", goal) as watch:
        assert watch.next(0.0) is None
        other = type(world)(world.name, type(world.session)(world.session.client))
        other.init(robot, goal, 3)
        change = watch.next(60.0)

    assert change is not None
    assert (change.aspect, change.version) == ("goal", 1)
    assert world.view(view)[view] == 3
    with Lock(each) as lock:
        assert dict(lock[each]) == {robot: 3}


@pytest.mark.carrier("local", "socket", "zenoh")
def test_reader_may_want_more_retained_of_an_aspect_that_is_in_use(world):
    """What a reader says of a known aspect counts as before."""
    more = Aspect("plan", list[float], retention=Retention(versions=77))
    view, plan = View(world, robot, more), Write(world, robot, PLAN)
    world.view(view)
    for step in range(30):
        with Lock(plan) as lock:
            lock[plan] = [float(step)]

    assert len(world.history(robot, PLAN)) == 31


def test_unknown_aspect_stays_unknown_after_a_restart(tmp_path):
    """A reader leaves nothing behind on the disk, and the name is free for any type."""
    with local(tmp_path, worlds=["online"]) as cell:
        online = cell.world("online")
        view = View(online, robot, MISSPELT)
        assert online.view(view).get(view) is None
    with local(tmp_path, worlds=["online"]) as cell:
        assert cell.aspects() == ()
        assert cell.world("online").init(robot, Aspect("plann", int), 3)


def aspects_of(cell, shard) -> set[str]:
    """Return the names of the aspects that one shard knows."""
    client = cell.world("online").session.client
    return {entry.name for entry in client.call(shard, client.core.hello(shard)).aspects}


def test_observer_registers_nothing(two_shards):
    """A connection that only looks leaves no aspect on a shard, not even one that another has."""
    left, right = Entity("left/box"), Entity("right/box")
    online = two_shards.cell.world("online")
    online.init(left, PLAN, [1.0])
    with two_shards.connect(observer=True) as looking:
        seen = looking.world("online")
        for asked in (View(seen, right, PLAN), View(seen, left, MISSPELT)):
            assert seen.view(asked).get(asked) is None
        assert seen.get_untyped(left, "plan") == [1.0]
        with pytest.raises(NullDatumError):
            seen.get_untyped(right, "plan")
        assert len(seen.at(online.history(left, PLAN)[0].position).list_slots()) == 1
        assert seen.diff(seen, "**", PLAN).rows == ()
        with seen.watch("**", PLAN, MISSPELT) as watch:
            assert watch.next(60.0) is not None
        with pytest.raises(DatumTypeError, match="'plan' is registered with datum type"):
            seen.view(View(seen, left, Aspect("plan", int)))
        with pytest.raises(MisuseError, match="only observes"):
            looking.create_world("another")

    assert aspects_of(two_shards.cell, "left") == {"plan"}
    assert aspects_of(two_shards.cell, "right") == set()


@pytest.mark.carrier("local")
def test_comparison_by_a_misspelt_name_is_refused(world, cell):
    """A name alone says nothing of an aspect; one with its type is null until somebody writes it."""
    with pytest.raises(MisuseError, match=r"no aspect 'plann' is registered.*'plan'\?"):
        world.diff(cell.world("training"), "**", "plann")
    assert world.diff(cell.world("training"), "**", MISSPELT).rows == ()
    with world.watch_diff(cell.world("training"), "**", MISSPELT) as watch:
        assert watch.next(0.0) is None
        world.init(robot, MISSPELT, [1.0])
        found = watch.next(60.0)
    assert found is not None
    assert found.aspect == "plann"


def test_watch_begun_before_its_aspect_came_counts_right_over_a_restart(two_stored):
    """Whether versions go on after a restart is known of an aspect that came later, too."""
    left, goal = Entity("left/box"), Aspect("goal", int)
    online = two_stored.cell.world("online")
    write = Write(online, left, goal)
    with (
        two_stored.connect(observer=True) as looking,
        looking.world("online").watch("**", goal) as watch,
    ):
        assert watch.next(0.0) is None
        online.init(left, goal, 1)
        assert watch.next(60.0).version == 1
        client = looking.world("online").session.client
        assert "goal" not in client.aspect_entries()
        epoch = client.core.epoch("left")
        assert watch._goes_on("left", Slot("online", "left/box", "goal"), epoch)  # what a gap is

        two_stored.stop("left")
        two_stored.start("left")
        with Lock(write) as lock:
            lock[write] = 2
        change = watch.next(60.0)
        assert (change.version, change.gap) == (2, 0)


@pytest.mark.carrier("local")
def test_early_reader_of_a_wrong_type_keeps_nobody_from_the_right_one(world, cell):
    """Who corrects the type in a notebook goes on; who does not is told each time."""
    wrong, right = Aspect("late", int), Aspect("late", str)
    assert world.view(View(world, robot, wrong)).get(View(world, robot, wrong)) is None
    world.init(robot, right, "there")

    for _ in range(2):
        with pytest.raises(DatumTypeError, match="late"):
            world.view(View(world, robot, wrong))
        assert world.view(View(world, robot, right))[View(world, robot, right)] == "there"
        with Lock(Read(world, robot, right)) as lock:
            assert lock[Read(world, robot, right)] == "there"


@pytest.mark.carrier("socket", "zenoh")
def test_reader_of_an_aspect_that_comes_into_use_needs_no_other_shard(two_shards):
    """Who asked before it was written reads it while a shard that it does not need is away."""
    box, goal = Entity("left/box"), Aspect("goal", int)
    world = two_shards.cell.world("online")
    with two_shards.connect() as reader:
        read = Read(reader.world("online"), box, goal)
        two_shards.stop("right")
        with Lock(read) as lock:
            assert lock.is_null(read)
        with Lock(Write(world, box, goal)) as lock:
            lock[Write(world, box, goal)] = 3

        with Lock(read, wait_s=1.0) as lock:
            assert lock[read] == 3
