"""A cell in process with two products and a plan, and what actors would write into it."""

import contextlib

import numpy as np
import slots

from actors.geometry.shapes import Surface
from actors.palletizing import vocabulary as words
from actors.palletizing.action import Action
from actors.palletizing.action_generator import ActionGenerator
from actors.palletizing.feedback import HandlingFeedback
from actors.palletizing.handling.nets import Execution
from actors.palletizing.planning import RowPlanning
from actors.palletizing.simulation.cell.scene import HOME_RAD
from actors.palletizing.simulation.products import product_mesh
from actors.palletizing.training_grasp import TrainingGrasp
from actors.workcell.vocabulary import JOINTS, JOINTS_KEPT, Joints
from enact_dist import Entity, testing

REMOTE = "actors.palletizing.simulation.remote_cell"
ARM = f"{REMOTE}:arm?port=1"
PACKAGE, PLACE = Entity("package/a"), Entity("place/0")
NAMES = ("milk_carton", "meal_tray")


def shape_of(product):
    """Return the true shape of a product, for tests that look at no picture of it."""
    return Surface.free_form(*product_mesh(product))


@contextlib.contextmanager
def handled_cell():
    """A cell with two products, grasps, and a plan of four packages."""
    with testing.worlds("training", "online") as cell:
        training = cell.world("training")
        for name in NAMES:
            training.init(words.product_entity(name), words.SURFACE, shape_of(name))
        planned(cell)
        testing.run_once(TrainingGrasp("milk_carton=0.5 meal_tray=0.35"), cell)
        still = np.tile(np.array(HOME_RAD), (JOINTS_KEPT, 1))
        stamps = np.arange(JOINTS_KEPT, dtype=np.int64)
        write(cell, words.ROBOT, JOINTS, Joints(still, 0.0 * still, stamps))
        yield cell


def planned(cell):
    """Let planning have taken note of all results."""
    testing.run_once(RowPlanning(4, " ".join(NAMES), f"{REMOTE}:cell_frames"), cell)


def write(cell, entity, aspect, datum, world="online"):
    slots.put(cell.world(world), entity, aspect, datum)


def read(cell, entity, aspect, world="online"):
    return slots.get(cell.world(world), entity, aspect)


def each(cell, pattern, aspect, world="training"):
    return slots.each(cell.world(world), pattern, aspect)


def come(cell, *, product="milk_carton", number=0, package=PACKAGE):
    """Let perception have seen a package on the belt."""
    pose = np.eye(4)
    pose[0, 3] = -0.1
    seen = words.Sighting(0, pose, number, number, "belt", product)
    write(cell, package, words.SIGHTING, seen)


def executed(cell, result):
    """Let the robot have ended the attached net."""
    net = read(cell, words.SYSTEM, words.NET)
    doing = Execution(
        net.net.name, net.number, net.net.start, 7, (), result, np.zeros(6), 0.07, np.eye(4)
    )
    write(cell, words.ROBOT, words.EXECUTION, doing)


def looked(cell, seen, verdict="", *, error="", x_m=0.0, captured_ns=9, **neighbours):
    """Let perception and deviation detection have answered the outcome.

    Neighbours that have moved are verdicts by the number of their place: `place_0="tipped"`.
    """
    request = read(cell, words.SYSTEM, words.REQUEST)
    found = {request.place: verdict} if verdict else {}
    found |= {name.replace("_", "/"): one for name, one in neighbours.items()}
    look = words.Look(request.number, seen, captured_ns if found else 0, tuple(found), error)
    write(cell, words.SYSTEM, words.LOOK, look)
    flags = read(cell, words.SYSTEM, words.DEVIATIONS) or {}
    for place, judged in found.items():
        plan = each(cell, words.PLACES, words.PLAN)[Entity(place)]
        pose = np.array(plan.tray_from_product)
        pose[0, 3] += x_m
        flag = (PACKAGE.name, plan.product, judged, 1.0, 1.0, 1.0, 1.0, captured_ns)
        flags = {**flags, place: words.Deviation(*flag, tray_from_product=pose)}
    write(cell, words.SYSTEM, words.DEVIATIONS, flags)


def packed(cell, *results):
    """Run the stages of the present request with these results; the last one may fail."""
    generator, action = ActionGenerator(ARM), Action()
    stages = []
    for result in results:
        testing.run_once(generator, cell)
        testing.run_once(action, cell)
        stages.append(read(cell, words.SYSTEM, words.NET).stage)
        executed(cell, result)
    testing.run_once(generator, cell)
    return stages


def closed(cell, **results):
    """Let feedback have closed places: `place_0="placed"`."""
    found = {
        name.replace("_", "/"): words.Result(f"package/{name}", "milk_carton", "", one, (), "why")
        for name, one in results.items()
    }
    write(cell, words.SYSTEM, words.RESULTS, found)


def placed(cell, number=0, *, package=PACKAGE, product="milk_carton", captured_ns=9):
    """Let a package have come, been packed and judged sound."""
    come(cell, number=number, package=package, product=product)
    testing.run_once(HandlingFeedback(), cell)
    packed(cell, "held", "placed", "in_contact", "aside")
    on_tray = each(cell, words.PLACES, words.PLAN)[Entity(f"place/{number}")].tray_from_product
    seen = words.Sighting(0, on_tray, number, number, "tray", product)
    write(cell, package, words.SIGHTING, seen)
