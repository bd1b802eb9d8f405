"""Lists and dicts that a block changes in place: never dropped without a word."""

from dataclasses import dataclass

import numpy as np
import pytest

from enact_dist import (
    Aspect,
    Entities,
    Entity,
    Lock,
    Read,
    ReadEach,
    View,
    Write,
    WriteEach,
    register_codec,
)
from enact_dist.errors import MisuseError

FLAGS = Aspect("flags", dict)
WAY = Aspect("way", list[float])
robot = Entity("robot")


@dataclass(frozen=True)
class Plan:
    name: str
    steps: list[str]
    costs: np.ndarray
    notes: tuple[dict[str, int], ...] = ()


PLAN = Aspect("plan", Plan)


def a_plan() -> Plan:
    """Return a plan with a long text, an array and a dict inside a tuple."""
    return Plan("p" * 300, ["up", "down"], np.arange(100_000.0), ({"n": 1},))


def refused_in_place(lock: Lock, change) -> str:
    """Let a block change something; return what it is told."""
    with pytest.raises(MisuseError, match="changed in place") as refused, lock:
        change(lock)
    return str(refused.value)


def test_dict_changed_in_place_is_refused_by_name_and_nothing_is_written(online):
    """Neither the changed dict nor another write of the block is published."""
    flags, way = Write(online, robot, FLAGS), Write(online, robot, WAY)
    online.init(robot, FLAGS, {"a": True})

    def change(lock):
        lock[way] = [1.0]
        lock[flags]["b"] = True

    text = refused_in_place(Lock(flags, way), change)

    assert "robot/flags in online" in text
    assert "lock[Write(" in text
    with Lock(Read(online, robot, FLAGS), Read(online, robot, WAY)) as lock:
        assert lock[Read(online, robot, FLAGS)] == {"a": True}
        assert lock.is_null(Read(online, robot, WAY))


def test_part_of_a_dataclass_changed_in_place_is_refused(online):
    """A list or a dict inside a frozen dataclass counts, too; one only looked at does not."""
    plan = Write(online, robot, PLAN)
    online.init(robot, PLAN, a_plan())
    with Lock(plan) as lock:
        assert lock[plan].notes[0] == {"n": 1}

    assert "robot/plan" in refused_in_place(Lock(plan), lambda lock: lock[plan].steps.append("x"))
    text = refused_in_place(Lock(plan), lambda lock: lock[plan].notes[0].clear())
    assert "robot/plan" in text


def test_what_cannot_be_a_datum_any_more_is_refused_too(online):
    """A value of another type put into a list in place is a change like any."""
    way = Write(online, robot, WAY)
    online.init(robot, WAY, [1.0])

    assert "robot/way" in refused_in_place(Lock(way), lambda lock: lock[way].append("far"))


def test_change_in_place_after_the_assignment_is_refused(online):
    """What was assigned is a copy: the block sees its own change, and is told that it is lost."""
    way = Write(online, robot, WAY)

    def change(lock):
        lock[way] = [3.0]
        lock[way].append(5.0)
        assert lock[way] == [3.0, 5.0]

    assert "robot/way" in refused_in_place(Lock(way), change)
    assert online.view(View(online, robot, WAY)).get(View(online, robot, WAY)) is None


def test_change_in_place_under_a_pattern_names_the_entity(online):
    """Of many data the changed one is named, with how to assign it."""
    each = WriteEach(online, Entities("cup/*"), WAY)
    for number in range(3):
        online.init(Entity(f"cup/{number}"), WAY, [float(number)])

    text = refused_in_place(Lock(each), lambda lock: lock[each][Entity("cup/1")].append(9.0))

    assert "cup/1/way in online" in text
    assert "[Entity('cup/1')] = value" in text


def test_lists_of_what_new_handed_out_are_fixed(online):
    """`new` hands out arrays to be filled; a list beside them is published as it was."""
    plan = Write(online, robot, PLAN)

    def change(lock):
        made = lock.new(plan, like=a_plan())
        made.costs[:] = 7.0
        made.steps.append("x")

    assert "robot/plan" in refused_in_place(Lock(plan), change)
    with Lock(plan) as lock:
        lock.new(plan, like=a_plan()).costs[:] = 7.0
    with Lock(plan) as lock:
        assert lock[plan].costs.max() == 7.0


def test_changed_in_place_and_assigned_is_published(online):
    """Whoever assigns what he has changed has said all: also a deletion, or another value."""
    flags, way = Write(online, robot, FLAGS), Write(online, robot, WAY)
    online.init(robot, FLAGS, {"a": True})
    online.init(robot, WAY, [1.0])
    with Lock(flags, way) as lock:
        lock[flags]["b"] = False
        lock[flags] = lock[flags]
        lock[way].append(2.0)
        del lock[way]

    with Lock(flags, way) as lock:
        assert lock[flags] == {"a": True, "b": False}
        assert lock.is_null(way)
        lock[way] = [4.0, float("nan")]
        assert lock[way][0] == 4.0


def test_what_is_only_read_is_the_blocks_own(online):
    """A block may sort what it reads: nobody else sees it, and the data under Write go out."""
    online.init(robot, WAY, [3.0, 1.0])
    online.init(robot, FLAGS, {})
    read, each = View(online, robot, WAY), ReadEach(online, Entities("*"), WAY)
    flags = Write(online, robot, FLAGS)
    with Lock(read, flags) as lock:
        lock[read].sort()
        lock[flags] = {"first": lock[read][0]}
    with Lock(each) as lock:
        lock[each][robot].sort()

    with Lock(Read(online, robot, WAY), Read(online, robot, FLAGS)) as lock:
        assert lock[Read(online, robot, WAY)] == [3.0, 1.0]
        assert lock[Read(online, robot, FLAGS)] == {"first": 1.0}
    assert online.view(read)[read] == [3.0, 1.0]


class Odd:
    """A value whose bytes are never twice the same."""

    made = 0

    def encoded(self) -> int:
        """Count."""
        Odd.made += 1
        return Odd.made


register_codec(Odd, "in_place.odd", encode=Odd.encoded, decode=lambda _: Odd())


def test_a_codecs_values_are_not_compared(online):
    """What a codec makes of a value is its own affair, and may take long."""
    odd = Write(online, robot, Aspect("odd", Odd))
    with Lock(odd) as lock:
        lock[odd] = Odd()
        assert isinstance(lock[odd], Odd)
    with Lock(odd) as lock:
        assert isinstance(lock[odd], Odd)


def test_nor_is_a_list_that_has_some(online):
    """Bytes that differ each time would say of every block that it changed something."""
    odds, way = Write(online, robot, Aspect("odds", list[Odd])), Write(online, robot, WAY)
    online.init(robot, odds.aspect, [Odd(), Odd()])
    with Lock(odds, way) as lock:
        assert len(lock[odds]) == 2
        lock[way] = [1.0]

    assert online.view(View(online, robot, WAY))[View(online, robot, WAY)] == [1.0]


def test_block_that_fails_tells_its_own_error(online):
    """An exception of the block is not hidden behind what it changed before."""
    way = Write(online, robot, WAY)
    online.init(robot, WAY, [1.0])
    with pytest.raises(ZeroDivisionError), Lock(way) as lock:
        lock[way].append(1 / 0)
    with pytest.raises(ZeroDivisionError), Lock(way) as lock:
        lock[way].append(2.0)
        raise ZeroDivisionError
