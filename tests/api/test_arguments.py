"""Arguments of a wrong type: refused by name, with what was given and what is wanted."""

import re

import pytest

from enact_dist import Aspect, Entities, Entity, View, World

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
        "diff(other, entities, aspects): other is 'online', which is no world context of a cell",
        "cell.world(name)",
    ),
    "diff with a role": (
        lambda world, _: world.diff(World("online")),
        "other is World('online'), which is no world context of a cell",
    ),
    "diff by one aspect": (
        lambda world, _: world.diff(world, "robot", PLAN),
        "diff(other, entities, aspects): aspects is Aspect(",
        "which is no list of Aspect or str",
    ),
    "diff by one name": (
        lambda world, past: past.diff(world, "robot", "plan"),
        "diff(other, entities, aspects): aspects is 'plan', which is no list of Aspect or str",
    ),
    "diff of numbers": (
        lambda world, _: world.diff(world, "robot", [3]),
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
    "survey of one name": (
        lambda world, _: world.survey("robot", "plan"),
        "survey(entities, aspects): aspects is 'plan', which is no list of str",
    ),
    "survey of aspects": (
        lambda _, past: past.survey(Entities("*"), (PLAN,)),
        "survey(entities, aspects): one of aspects is Aspect(",
        "which is no str",
    ),
    "raw by names": (
        lambda world, _: world.raw("robot", "plan"),
        "raw(entity, aspect): entity is 'robot', which is no Entity; write Entity('robot')",
    ),
    "raw of an aspect": (
        lambda _, past: past.raw(robot, PLAN),
        "raw(entity, aspect): aspect is Aspect(",
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
