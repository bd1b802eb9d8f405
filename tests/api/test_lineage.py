"""Where data come from and what came of them: what a lock tells of its reads, and both trees."""

import pytest

from enact_dist import (
    Actor,
    Aspect,
    Entities,
    Entity,
    Lock,
    Read,
    ReadEach,
    Together,
    View,
    ViewEach,
    World,
    Write,
    WriteEach,
)
from enact_dist.errors import ForgottenError, MisuseError, NullDatumError, UnknownWorldError
from enact_dist.testing import ManualClock, run_once, worlds
from enact_dist.world.lineage import DEPTH_MAX, EffectTree

pytestmark = pytest.mark.carrier("local", "drawn")

COUNT = Aspect("count", int)
SUM = Aspect("sum", int)
FEW = Aspect("few", int, retention=2)
here, there, total = Entity("a/1"), Entity("b/1"), Entity("a/total")


def put(request, value):
    with Lock(request) as lock:
        lock[request] = value


def names(trees):
    return [f"{one.world}:{one.entity}/{one.aspect} v{one.version}" for one in trees]


def added(world, *reads):
    """Commit a sum of what is read."""
    target = Write(world, total, SUM)
    with Lock(*reads, target) as lock:
        lock[target] = sum(lock.get(read, 0) for read in reads)


def causes(cell, **options):
    return names(cell.why("online", total, SUM, **options).children)


# ---------------------------------------------------------------- what counts as read


def test_reads_and_views_are_causes_null_ones_too(cell, online):
    """What a lock has asked for counts, though the block did not look at it."""
    online.init(here, COUNT, 1)
    read, view, target = (
        Read(online, here, COUNT),
        View(online, there, COUNT),
        Write(online, total, SUM),
    )

    with Lock(read, view, target) as lock:
        lock[target] = 7

    assert causes(cell) == ["online:a/1/count v1", "online:b/1/count v0"]
    assert [one.kind for one in cell.why("online", total, SUM).children] == ["commit", "null"]


def test_replaced_datum_is_a_cause_where_the_block_looked_at_it(cell, online):
    """A sum that goes on comes from the one before; one that is set anew does not."""
    target = Write(online, total, SUM)
    put(target, 1)
    with Lock(target) as lock:
        lock[target] += 1
    put(target, 5)

    assert names(cell.why("online", total, SUM, 2).children) == ["online:a/total/sum v1"]
    assert cell.why("online", total, SUM, 3).children == ()


def test_first_datum_has_no_cause(cell, online):
    """That nothing was there is nothing that was read: `init` and `get` with a default."""
    online.init(here, COUNT, 1)
    target = Write(online, total, SUM)
    with Lock(target) as lock:
        lock[target] = lock.get(target, 0) + 1

    assert cell.why("online", here, COUNT).children == ()
    assert cell.why("online", total, SUM).children == ()


@pytest.mark.parametrize("kind", [ReadEach, ViewEach])
def test_pattern_tells_what_the_block_looked_at(cell, online, kind):
    """One datum of many that was looked at is the cause; the others are none."""
    for number in range(5):
        online.init(Entity(f"part/{number}"), COUNT, number)
    each, target = kind(online, Entities("part/*"), COUNT), Write(online, total, SUM)

    with Lock(each, target) as lock:
        lock[target] = lock[each][Entity("part/3")]

    assert causes(cell) == ["online:part/3/count v1"]


@pytest.mark.parametrize("look", [len, list, lambda parts: Entity("part/1") in parts])
def test_pattern_whose_set_was_used_tells_all_of_it(cell, online, look):
    """Whoever goes by which entities there are depends on each of them."""
    for number in range(2):
        online.init(Entity(f"part/{number}"), COUNT, number)
    each, target = ViewEach(online, Entities("part/*"), COUNT), Write(online, total, SUM)

    with Lock(each, target) as lock:
        lock[target] = len(str(look(lock[each])))

    assert causes(cell) == [f"online:part/{number}/count v1" for number in range(2)]


def test_pattern_that_was_not_used_is_no_cause(cell, online):
    """An update that takes another way does not depend on what it left alone."""
    online.init(here, COUNT, 1)
    each, target = ViewEach(online, Entities("a/*"), COUNT), Write(online, total, SUM)

    with Lock(each, target) as lock:
        lock[target] = 1

    assert causes(cell) == []


def test_written_pattern_tells_what_was_looked_at_before(cell, online):
    """Of `WriteEach` the replaced data count that the block has seen, not their names."""
    each = WriteEach(online, Entities("part/*"), COUNT)
    for number in range(3):
        online.init(Entity(f"part/{number}"), COUNT, number)

    with Lock(each) as lock:
        parts = lock[each]
        parts[Entity("part/new")] = len(parts) + parts[Entity("part/2")]

    tree = cell.why("online", "part/new", COUNT)
    assert names(tree.children) == ["online:part/2/count v1"]


class Paired(Actor):
    """Add up a set of data that bear one capture stamp."""

    pair = Together([View(World("online"), entity, COUNT) for entity in (here, there)])
    sum = Write(World("online"), total, SUM)
    triggers = (pair,)

    def update(self, lock):
        """Add them up."""
        lock[self.sum] = sum(lock[self.pair])


def test_set_comes_from_the_versions_that_bear_its_stamp():
    """An update for an older set names the older version, not the newest one."""
    with worlds("online") as cell:
        online = cell.world("online")
        for entity, stamp_ns in ((here, 10), (there, 10), (here, 20)):
            with Lock(Write(online, entity, COUNT)) as lock:
                lock.put(Write(online, entity, COUNT), stamp_ns, stamp_ns=stamp_ns)

        assert run_once(Paired(), cell) == 1

        assert causes(cell) == ["online:a/1/count v1", "online:b/1/count v1"]


@pytest.mark.carrier("local")  # a limit of the core; over a carrier it is the same and takes long
def test_more_reads_than_a_commit_names_are_counted(cell, online):
    """Of 1,100 data 1,024 are named, and the tree says how many more there were."""
    each, target = WriteEach(online, Entities("part/*"), COUNT), Write(online, total, SUM)
    with Lock(each) as lock:
        for number in range(1100):
            lock[each][Entity(f"part/{number}")] = 1
    parts = ViewEach(online, Entities("part/*"), COUNT)

    with Lock(parts, target) as lock:
        lock[target] = sum(lock[parts].values())

    tree = cell.why("online", total, SUM)
    assert (len(tree.children), tree.left_out) == (1024, 76)


# ---------------------------------------------------------------- trees of causes


def test_tree_names_who_committed_and_when(cell, online):
    """Actor, host, process, time, how long it held the lock, and when the datum was captured."""
    target = Write(online, here, COUNT)
    with Lock(target) as lock:
        lock.put(target, 1, stamp_ns=77)
    position = lock.position

    tree = cell.why(online, here, COUNT)

    session = cell.actors()[0]
    assert (tree.actor, tree.host, tree.pid) == (session.actor, session.host, session.pid)
    assert (tree.position, tree.kind, tree.stamp_ns) == (position, "commit", 77)
    assert 0.0 < tree.held_s < 60.0
    assert 0.0 <= tree.age_s < 60.0


def test_shared_cause_is_shown_in_full_once(cell, online):
    """A datum that two causes come from has its own causes where it is nearest to the root."""
    online.init(here, COUNT, 1)
    chain = [Write(online, Entity(f"a/{name}"), COUNT) for name in ("base", "left", "right")]
    for target, source in zip(chain, (here, "a/base", "a/base"), strict=True):
        read = Read(online, Entity(str(source)), COUNT)
        with Lock(read, target) as lock:
            lock[target] = lock[read]
    added(online, *(Read(online, Entity(name), COUNT) for name in ("a/left", "a/right")))

    tree = cell.why("online", total, SUM)

    bases = [one.children[0] for one in tree.children]
    assert names(bases) == ["online:a/base/count v1"] * 2
    assert [base.elsewhere for base in bases] == [False, True]
    assert [len(base.children) for base in bases] == [1, 0]
    assert len(list(tree.walk())) == 5


def test_depth_limits_the_tree_and_says_so(cell, online):
    """What was not followed is counted where the tree ends."""
    target = Write(online, total, SUM)
    put(target, 0)
    for _ in range(5):
        with Lock(target) as lock:
            lock[target] += 1

    tree = cell.why("online", total, SUM, depth=2)

    assert [one.version for one in tree.walk()] == [6, 5, 4]
    assert [one.unfollowed for one in tree.walk()] == [0, 0, 1]
    assert [one.version for one in cell.why("online", total, SUM).walk()] == [6, 5, 4, 3, 2, 1]


def replaced(online, clock, *, times):
    """Set a datum of two retained versions so often, 5 s apart."""
    for value in range(times):
        put(Write(online, here, FEW), value)
        clock.advance(5.0)


def test_forgotten_cause_stands_in_the_tree_by_name():
    """What has left its retention is not left out: version and stamp are known, no more."""
    clock = ManualClock()
    with worlds("online", clock=clock) as cell:
        online = cell.world("online")
        replaced(online, clock, times=1)
        added(online, Read(online, here, FEW))
        replaced(online, clock, times=3)

        tree = cell.why("online", total, SUM)

    (cause,) = tree.children
    assert (cause.version, cause.kind, cause.actor, cause.known) == (1, "forgotten", "", False)
    assert 0 < cause.position.stamp_ns < tree.position.stamp_ns


def test_forgotten_version_cannot_be_explained_itself():
    """The error says from when on the datum is known."""
    clock = ManualClock()
    with worlds("online", clock=clock) as cell:
        replaced(cell.world("online"), clock, times=4)

        with pytest.raises(ForgottenError, match="the oldest that is known is 3") as raised:
            cell.why("online", here, FEW, 1)

        third = cell.why("online", here, FEW, 3)
    assert raised.value.oldest_ns == third.position.stamp_ns


def test_kept_tree_outlives_the_retention():
    """What `cell.pin` takes of a tree is explained later, too, with what went into it."""
    clock = ManualClock()
    with worlds("online", clock=clock) as cell:
        online = cell.world("online")
        replaced(online, clock, times=1)
        added(online, Read(online, here, FEW))
        cell.pin("incident", cell.why("online", total, SUM).walk())
        replaced(online, clock, times=3)

        tree = cell.why("online", total, SUM)

        assert [one.kind for one in tree.walk()] == ["commit", "commit"]
        assert [version.version for version in cell.pinned()["incident"]] == [1, 1]


def test_deletion_is_a_version_with_a_cause(cell, online):
    """Who deleted a datum is told as who set it; what saw the null says so."""
    online.init(here, COUNT, 1)
    target = Write(online, here, COUNT)
    with Lock(target) as lock:
        del lock[target]
    added(online, Read(online, here, COUNT))

    (cause,) = cell.why("online", total, SUM).children

    assert (cause.version, cause.kind, cause.null_reason) == (2, "commit", "deleted")


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        (("nowhere", here, COUNT), UnknownWorldError, "no world context 'nowhere'"),
        (("online", there, COUNT), NullDatumError, "never set"),
        (("online", here, COUNT, 9), MisuseError, "no version 9; the newest is 1"),
        (("online", here, COUNT, -1), MisuseError, "no version -1"),
        (("online", "a b", COUNT), MisuseError, "cannot name an entity"),
    ],
)
def test_what_cannot_be_explained_is_refused_by_name(cell, online, arguments, error, words):
    """Each wrong question has its own error."""
    online.init(here, COUNT, 1)

    with pytest.raises(error, match=words):
        cell.why(*arguments)


def test_past_context_is_asked_about_by_version(cell, online):
    """Of what was the newest version then the history tells the number."""
    online.init(here, COUNT, 1)
    past = online.at(cell.why("online", here, COUNT).position)

    with pytest.raises(MisuseError, match="name 'online' and a version"):
        cell.why(past, here, COUNT)


def test_depth_outside_its_limits_is_refused(cell, online):
    """A tree has a greatest depth, so that whoever goes through it may recurse."""
    online.init(here, COUNT, 1)

    for depth in (-1, DEPTH_MAX + 1):
        with pytest.raises(MisuseError, match="depth"):
            cell.why("online", here, COUNT, depth=depth)


# ---------------------------------------------------------------- trees of effects


def test_effects_follow_a_datum_to_all_that_came_of_it(cell, online):
    """Direct effects by time, theirs below; who did not read it is not there."""
    online.init(here, COUNT, 1)
    online.init(there, COUNT, 5)
    added(online, Read(online, here, COUNT))
    added(online, Read(online, there, COUNT))
    report = Write(online, Entity("report"), SUM)
    read = Read(online, total, SUM)
    with Lock(read, report) as lock:
        lock[report] = lock[read]

    first, second = cell.impact("online", here, COUNT), cell.impact("online", there, COUNT)

    assert isinstance(first, EffectTree)
    assert names(first.walk()) == ["online:a/1/count v1", "online:a/total/sum v1"]
    assert names(second.walk()) == [
        "online:b/1/count v1",
        "online:a/total/sum v2",
        "online:report/sum v1",
    ]


def test_depth_of_effects_says_how_many_more_there_are(cell, online):
    """At the depth the next effects are counted, not followed."""
    online.init(here, COUNT, 1)
    added(online, Read(online, here, COUNT))
    target, read = Write(online, Entity("report"), SUM), Read(online, total, SUM)
    with Lock(read, target) as lock:
        lock[target] = lock[read]

    tree = cell.impact("online", here, COUNT, depth=1)

    assert [(one.unfollowed, one.children) for one in tree.children] == [(1, ())]


def test_answers_that_would_be_too_long_lose_nothing_silently(cell, online, monkeypatch):
    """Causes and effects beyond one page are asked for on the next."""
    each, source = WriteEach(online, Entities("part/*"), COUNT), Read(online, here, COUNT)
    online.init(here, COUNT, 1)
    for number in range(5):
        with Lock(each, source) as lock:
            lock[each][Entity(f"part/{number}")] = lock[source]
    added(online, *(Read(online, Entity(f"part/{number}"), COUNT) for number in range(5)))
    monkeypatch.setattr("enact_dist.core.protocol.pages.PAGE_BYTES_MAX", 1_000)

    why, impact = cell.why("online", total, SUM), cell.impact("online", here, COUNT)

    assert {one.kind for one in why.walk()} == {"commit"}
    assert len(why.children) == 5
    assert (len(impact.children), impact.left_out) == (5, 0)
