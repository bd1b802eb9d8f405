"""Claims about the data that the handling of packages goes round by: each travels unchanged."""

import numpy as np
import pytest

from actors.palletizing import vocabulary as words
from actors.palletizing.placing.finger_room import Grasp
from enact_dist import View, testing
from tests.actors.palletizing.sound_nets import net, primitive, way

GRASP = Grasp(np.array([0.0, 0.0, 0.04]), np.array([0.0, 1.0, 0.0]), 0.095, 45.0, 0.03, 0.5)
NET = net(
    {"hold": primitive(way("done", "elapsed_s > 0.5"), way("failed", "force > 20"), frame="tool")}
)


@pytest.mark.parametrize(
    ("entity", "aspect", "datum"),
    [
        (words.product_entity("milk_carton"), words.GRASP, GRASP),
        (words.CELL, words.FRAMES, {"tray": np.eye(4)}),
        (words.CONVEYOR, words.ARRIVAL, words.Arrival(0, 7)),
        (words.SYSTEM, words.REQUEST, words.Request(1, "pack", "place/0", "package/a", "why")),
        (words.SYSTEM, words.CANDIDATE, words.Candidate(1, "push", None, "too wide", {})),
        (words.SYSTEM, words.NET, words.Attached(1, 1, "push", NET, {"place/0": np.eye(4)})),
        (words.SYSTEM, words.OUTCOME, words.Outcome(1, "push", "in_contact", True, 7)),
        (words.SYSTEM, words.LOOK, words.Look(1, "tray", 7, ("place/0", "place/1"))),
        (words.CONVEYOR, words.SIGHT, words.Sight(0, "the belt sensor gave no image: unplugged")),
        (words.CONVEYOR, words.LOOKS, words.BeltLooks(7, 2, 3, 1, is_seen=False)),
        (words.CELL, words.PLANNED, words.Planned({"place/0": "rejected"}, (0,))),
        (words.USER, words.QUESTION, words.Question(1, "what now?", ("reject", "stop"))),
        (words.SYSTEM, words.DECISION, words.Decision(1, "reject", "a test")),
        (words.GRIPPER, words.COMMAND, words.GripCommand(1, "width", 0.1)),
        (words.GRIPPER, words.STATE, words.GripState(1, 0.1, 0.0, 0.0, 7)),
    ],
)
def test_datum_comes_back_as_it_was(entity, aspect, datum):
    """Every field is there again, arrays and optional ones included."""
    with testing.worlds("online") as cell:
        world = cell.world("online")
        world.init(entity, aspect, datum)
        request = View(world, entity, aspect)
        back = world.view(request)[request]
    assert repr(back) == repr(datum)
