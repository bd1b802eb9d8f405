"""Arguments of a wrong type: refused by name, with what was given and what is wanted."""

import re

import numpy as np
import pytest

from enact_dist import Aspect, Entities, Entity, Lock, View, World, Write, connect
from enact_dist.errors import MisuseError

PLAN = Aspect("plan", dict)
robot = Entity("robot")

CALLS = {
    "swapped history": (
        lambda world, _: world.history(PLAN, robot),
        "history(entity, aspect): entity is Aspect(",
        "which is no Entity",
    ),
    "history by names": (
        lambda world, _: world.history("robot", "plan"),
        "history(entity, aspect): entity is 'robot', which is no Entity; write Entity('robot')",
    ),
    "history of a name": (
        lambda world, _: world.history(robot, "plan"),
        "history(entity, aspect): aspect is 'plan', which is no Aspect; write Aspect('plan', TYPE)",
    ),
    "watch of a name": (
        lambda world, _: world.watch(robot, "plan"),
        "watch(entities, *aspects): one of aspects is 'plan', which is no Aspect",
    ),
    "watch of an aspect alone": (
        lambda world, _: world.watch(PLAN),
        "watch(entities, *aspects): entities is Aspect(",
        "which is no Entities or Entity or str",
    ),
    "diff with a name": (
        lambda world, _: world.diff("online"),
        "diff(other, entities, *aspects): other is 'online', which is no world context of a cell",
        "cell.world(name)",
    ),
    "diff with a role": (
        lambda world, _: world.diff(World("online")),
        "other is World('online'), which is no world context of a cell",
    ),
    "diff by a list": (
        lambda world, past: past.diff(world, "robot", [PLAN]),
        "diff(other, entities, *aspects): one of aspects is [Aspect(",
        "which is no Aspect or str",
    ),
    "diff of numbers": (
        lambda world, _: world.diff(world, "robot", 3),
        "one of aspects is 3, which is no Aspect or str",
    ),
    "watch_diff with a name": (
        lambda world, _: world.watch_diff("training"),
        "watch_diff(other, entities, *aspects): other is 'training', which is no world context",
    ),
    "watch_diff of an aspect": (
        lambda world, _: world.watch_diff(world, PLAN),
        "watch_diff(other, entities, *aspects): entities is Aspect(",
    ),
    "list_slots of one name": (
        lambda world, _: world.list_slots("robot", "plan"),
        "list_slots(entities, aspects): aspects is 'plan', which is no list of str",
    ),
    "list_slots of aspects": (
        lambda _, past: past.list_slots(Entities("*"), (PLAN,)),
        "list_slots(entities, aspects): one of aspects is Aspect(",
        "which is no str",
    ),
    "get_untyped by names": (
        lambda world, _: world.get_untyped("robot", "plan"),
        "get_untyped(entity, aspect): entity is 'robot', which is no Entity; write Entity('robot')",
    ),
    "get_untyped of an aspect": (
        lambda _, past: past.get_untyped(robot, PLAN),
        "get_untyped(entity, aspect): aspect is Aspect(",
        "which is no str",
    ),
    "view by names": (
        lambda world, _: View(world, "robot", PLAN),
        "View(world, entity, aspect): entity is 'robot', which is no Entity or Entities",
        "write Entity('robot')",
    ),
}


@pytest.mark.carrier("local")
@pytest.mark.parametrize("name", CALLS)
def test_wrong_argument_is_refused_by_name(online, name):
    """Nothing is looked for by it, and nothing is said of the inside."""
    online.init(robot, PLAN, {})
    past = online.at(online.history(robot, PLAN)[0].position)
    call, *texts = CALLS[name]
    with pytest.raises(TypeError, match=re.escape(texts[0])) as refused:
        call(online, past)
    for text in texts:
        assert text in str(refused.value)


SECONDS = {
    "wait_s": lambda world, wrong: Lock(Write(world, robot, PLAN), wait_s=wrong),
    "hold_s": lambda world, wrong: Lock(Write(world, robot, PLAN), hold_s=wrong),
    "timeout_s of a watch": lambda world, wrong: world.watch("**").next(wrong),
    "timeout_s of connect": lambda _, wrong: connect("tcp/127.0.0.1:1", timeout_s=wrong),
    "request_timeout_s": lambda _, wrong: connect("tcp/127.0.0.1:1", request_timeout_s=wrong),
}


@pytest.mark.parametrize("wrong", ["1", float("nan"), -1.0, [2.0]])
@pytest.mark.parametrize("name", SECONDS)
def test_what_is_no_number_of_seconds_is_refused_by_name(online, name, wrong):
    """A text from a configuration or an option is none, and said at once."""
    with pytest.raises(MisuseError) as refused:
        SECONDS[name](online, wrong)

    assert f"{name.split()[0]} is {wrong!r}" in str(refused.value)
    assert "second" in str(refused.value)
    if wrong == "1":
        assert "float('1')" in str(refused.value)


def test_seconds_may_be_any_number(online):
    """Of numpy too, and without limit where that has a meaning."""
    for wait_s in (1, 0.5, np.float32(0.5), np.int64(1), float("inf")):
        with Lock(Write(online, robot, PLAN), wait_s=wait_s) as lock:
            lock[Write(online, robot, PLAN)] = {}


def test_former_name_of_the_time_limit_of_requests_still_counts():
    """For one release; the warning names the new one."""
    with (
        pytest.warns(DeprecationWarning, match=r"connect\(request_timeout_s=…\)"),
        pytest.raises(MisuseError, match="request_timeout_s is -1"),
    ):
        connect("tcp/127.0.0.1:1", patience_s=-1)
