"""Claims about perception where a robot packs: the physical cell before its sensors, no robot."""

import numpy as np
import pytest
from lost_commits import lose_commit

pytest.importorskip("open3d", exc_type=ImportError)
pytest.importorskip("mujoco", exc_type=ImportError)

from slots import each, get
from slots import put_online as write

from actors.geometry.poses import turned
from actors.palletizing import vocabulary as words
from actors.palletizing.deviation import DeviationDetection
from actors.palletizing.handling.data import TAKEN_OUT, UNRECOGNISED, UNSEEN_LOOKS
from actors.palletizing.handling.grounding import aside_net
from actors.palletizing.handling.nets import Execution
from actors.palletizing.handling_perception import EmptyBelt, HandlingPerception
from actors.palletizing.planning import RowPlanning
from actors.palletizing.sight.sensor import SensorError
from actors.palletizing.simulation.cell.scene import CellLayout
from actors.palletizing.simulation.physical_sensors import PhysicalBeltSensor, PhysicalTraySensor
from actors.palletizing.simulation.physics import PhysicalCell
from actors.palletizing.training_grasp import TrainingGrasp
from enact_dist import Entity, View, testing

pytestmark = pytest.mark.sampled(9, of="file")

NAMES = ("milk_carton", "meal_tray")
LAYOUT = CellLayout()


@pytest.fixture
def physical():
    return PhysicalCell(2, seed=4)


@pytest.fixture
def cell(trained, physical, monkeypatch):
    """A planned cell whose sensors look at the physical one."""
    sensors = {
        "belt": PhysicalBeltSensor(physical.shown, seed=4),
        "tray": PhysicalTraySensor(physical.shown, seed=4),
    }
    opened = "actors.palletizing.handling_perception.open_sensor"
    monkeypatch.setattr(opened, sensors.__getitem__)
    with testing.worlds("training", "online") as cell:
        training = cell.world("training")
        for name in NAMES:
            training.init(words.product_entity(name), words.SURFACE, trained(name))
        frames = "actors.palletizing.simulation.remote_cell:cell_frames"
        testing.run_once(RowPlanning(2, " ".join(NAMES), frames), cell)
        training.init(words.TRAY, words.EMPTY, sensors["tray"].capture_empty())
        testing.run_once(EmptyBelt("belt"), cell)
        yield cell


def ended(cell, number, package, place, *, stage="push", success=True, kind="pack", aside="aside"):
    """Let the robot have ended a request and gone aside."""
    request = words.Request(number, kind, place, package, "test", "tray" if package else "")
    write(cell, words.SYSTEM, words.REQUEST, request)
    outcome = words.Outcome(number, stage, "any", success, 7)
    write(cell, words.SYSTEM, words.OUTCOME, outcome)
    net = aside_net(turned=False)
    write(cell, words.SYSTEM, words.NET, words.Attached(number, number, "aside", net, {}))
    doing = Execution("go_aside", number, "go", 7, (), aside, np.zeros(6), 0.07, np.eye(4))
    write(cell, words.ROBOT, words.EXECUTION, doing)


def on_belt(physical, number):
    """Put a package into the light barrier, as the belt brings it; return its true pose."""
    pose = np.array(LAYOUT.base_from_belt)
    pose[:3, 3] += pose[:3, :3] @ [-0.1, 0.0, 0.0]
    physical.put(number, pose)
    return pose


def on_tray(cell, physical, number, *, beside_m=0.0):
    plan = each(cell.world("training"), words.PLACES, words.PLAN)[Entity(f"place/{number}")]
    pose = np.array(plan.tray_from_product)
    pose[1, 3] += beside_m
    physical.put(number, LAYOUT.base_from_tray @ pose)


def arrived(cell, physical):
    """Let the first package come and be seen on the belt; return perception and the package."""
    perception = HandlingPerception("belt", "tray", frames=2)
    on_belt(physical, 0)
    write(cell, words.CONVEYOR, words.ARRIVAL, words.Arrival(0, 7))
    testing.run_once(perception, cell)
    (package,) = each(cell.world("online"), words.PACKAGES, words.SIGHTING)
    return perception, package


def test_a_package_has_one_entity_from_the_belt_to_the_tray(cell, physical):
    """It is recognised where it comes, and judged where it goes; so is its neighbour, when moved."""
    perception, detection = HandlingPerception("belt", "tray", frames=2), DeviationDetection()
    true = on_belt(physical, 0)
    write(cell, words.CONVEYOR, words.ARRIVAL, words.Arrival(0, 7))
    testing.run_once(perception, cell)
    ((package, seen),) = each(cell.world("online"), words.PACKAGES, words.SIGHTING).items()
    assert (seen.product, seen.frame, seen.first_stop) == ("milk_carton", "belt", 0)
    found = LAYOUT.base_from_belt @ seen.frame_from_package
    assert np.hypot(*(found - true)[:2, 3]) < 0.012  # the sensor is off by some millimetres

    on_tray(cell, physical, 0)
    ended(cell, 1, package.name, "place/0")
    testing.run_once(perception, cell)
    testing.run_once(detection, cell)
    assert get(cell.world("online"), words.SYSTEM, words.LOOK).seen == "tray"
    assert get(cell.world("online"), words.SYSTEM, words.DEVIATIONS)["place/0"].verdict == "ok"

    on_belt(physical, 1)
    write(cell, words.CONVEYOR, words.ARRIVAL, words.Arrival(1, 8))
    testing.run_once(perception, cell)
    sightings = each(cell.world("online"), words.PACKAGES, words.SIGHTING)
    (second,) = sightings.keys() - {package}
    assert sightings[second].product == "meal_tray"
    on_tray(cell, physical, 1)
    on_tray(cell, physical, 0, beside_m=0.03)  # as if it had been pushed away
    ended(cell, 2, second.name, "place/1")
    testing.run_once(perception, cell)
    testing.run_once(detection, cell)
    flags = get(cell.world("online"), words.SYSTEM, words.DEVIATIONS)
    assert {place: flag.verdict for place, flag in flags.items()} == {
        "place/0": "moved",
        "place/1": "ok",
    }
    assert len(each(cell.world("online"), words.PACKAGES, words.SIGHTING)) == 2
    before_mm = each(cell.world("online"), words.PLACES, words.OBSERVATION)[
        Entity("place/1")
    ].before_mm
    assert (before_mm % 1.0 != 0.0).any()  # the neighbour is drawn as exactly as it was seen


def test_a_package_that_was_missed_is_seen_on_the_belt_again(cell, physical):
    """After a grasp that failed only the belt is looked at; the tray is not judged."""
    perception, package = arrived(cell, physical)
    ended(cell, 1, package.name, "place/0", stage="grasp", success=False)
    testing.run_once(perception, cell)
    look = get(cell.world("online"), words.SYSTEM, words.LOOK)
    assert (look.seen, look.captured_ns) == ("belt", 0)
    assert each(cell.world("online"), words.PLACES, words.OBSERVATION) == {}


def test_a_package_that_is_nowhere_is_missing(cell, physical):
    """Lost on the way: not on the tray; the place is flagged, the package has left the cell."""
    perception, package = arrived(cell, physical)
    physical.take_away(0)
    ended(cell, 1, package.name, "place/0", stage="place", success=False)
    testing.run_once(perception, cell)
    testing.run_once(DeviationDetection(), cell)
    assert get(cell.world("online"), words.SYSTEM, words.LOOK).seen == ""
    assert get(cell.world("online"), words.SYSTEM, words.DEVIATIONS)["place/0"].verdict == "missing"


@pytest.mark.parametrize(
    ("roll_deg", "unfit"), [(0.0, ""), (90.0, "the package lies on its side on the belt")]
)
def test_a_package_that_was_lost_on_its_way_is_looked_for_on_the_belt(
    cell, physical, roll_deg, unfit
):
    """It is not on the tray, and nothing else has come: it is seen where and how it lies."""
    perception, package = arrived(cell, physical)
    lies = on_belt(physical, 0)
    lies[:3, :3] = lies[:3, :3] @ turned(np.deg2rad(roll_deg), 0.0, 0.0)
    lies[:3, 3] += LAYOUT.base_from_belt[:3, :3] @ [0.05, -0.02, 0.0475 if roll_deg else 0.0]
    physical.put(0, lies)
    ended(cell, 1, package.name, "place/0", stage="place", success=False)
    testing.run_once(perception, cell)
    testing.run_once(DeviationDetection(), cell)
    assert get(cell.world("online"), words.SYSTEM, words.LOOK).seen == "belt"
    assert get(cell.world("online"), words.SYSTEM, words.DEVIATIONS)["place/0"].verdict == "missing"
    seen = each(cell.world("online"), words.PACKAGES, words.SIGHTING)[package]
    assert (seen.frame, seen.product, seen.unfit) == ("belt", "milk_carton", unfit)
    off = LAYOUT.base_from_belt @ seen.frame_from_package - lies
    assert unfit or np.hypot(*off[:2, 3]) < 0.012
    write(cell, words.CONVEYOR, words.ARRIVAL, words.Arrival(1, 8))
    testing.run_once(perception, cell)
    ended(cell, 2, package.name, "place/0", stage="place", success=False)
    testing.run_once(perception, cell)
    assert get(cell.world("online"), words.SYSTEM, words.LOOK).seen == "", "it may be the next one"


def test_a_package_in_the_hand_is_not_judged(cell, physical):
    """What could not be put down hangs above the tray and tells nothing of its place."""
    testing.run_once(TrainingGrasp("milk_carton=0.5 meal_tray=0.35"), cell)
    perception, package = arrived(cell, physical)
    grasp = each(cell.world("training"), words.PRODUCTS, words.GRASP)[Entity("product/milk_carton")]
    ended(cell, 1, package.name, "place/0", stage="place", success=False)
    state = words.GripState(1, grasp.width_m - 0.002, 0.0, 40.0, 7)
    write(cell, words.GRIPPER, words.COMMAND, words.GripCommand(1, "force", 40.0))
    write(cell, words.GRIPPER, words.STATE, state)
    testing.run_once(perception, cell)
    look = get(cell.world("online"), words.SYSTEM, words.LOOK)
    assert (look.seen, look.captured_ns, look.judged) == ("hand", 0, ())
    assert each(cell.world("online"), words.PLACES, words.OBSERVATION) == {}


@pytest.mark.parametrize("result", ["blocked", "timeout:away", "interrupted:away"])
def test_an_arm_that_is_not_aside_hides_the_tray(cell, physical, result):
    """It stopped on its way: nothing is judged below it, and the request is answered by name."""
    perception, package = arrived(cell, physical)
    on_tray(cell, physical, 0)
    ended(cell, 1, package.name, "place/0", aside=result)
    testing.run_once(perception, cell)
    look = get(cell.world("online"), words.SYSTEM, words.LOOK)
    assert (look.judged, look.error) == ((), f"the arm is not aside: {result}")
    assert each(cell.world("online"), words.PLACES, words.OBSERVATION) == {}


@pytest.mark.parametrize("kind", ["reject", "removed"])
@pytest.mark.parametrize("stays", [True, False])
def test_what_shall_be_gone_is_looked_for(cell, physical, kind, stays):
    """After a removal the tray tells whether the package is gone; its place is not judged."""
    perception, package = arrived(cell, physical)
    on_tray(cell, physical, 0)
    ended(cell, 1, package.name, "place/0")
    testing.run_once(perception, cell)
    if not stays:
        physical.take_away(0)
    ended(cell, 2, package.name, "place/0", stage="remove", kind=kind)
    testing.run_once(perception, cell)
    look = get(cell.world("online"), words.SYSTEM, words.LOOK)
    assert (look.request, look.seen, look.judged) == (2, "tray" if stays else "", ())


@pytest.mark.parametrize(
    ("kind", "error"),
    [
        ("blind", "the tray sensor gave no image: the sensor gives no image"),
        ("camera", "the tray sensor stands still: 2 images in a row are the very same"),
    ],
)
def test_a_tray_sensor_that_fails_is_named_and_nothing_is_judged(cell, physical, kind, error):
    """The look says why; once it works, the next look judges."""
    perception, package = arrived(cell, physical)
    on_tray(cell, physical, 0)
    ended(cell, 1, package.name, "place/0")
    testing.run_once(perception, cell)
    physical.step(5)
    physical.fail(kind, 60.0)
    on_tray(cell, physical, 0, beside_m=0.1)
    for number in (2, 3):
        ended(cell, number, package.name, "place/0", kind="look")
        testing.run_once(perception, cell)
        look = get(cell.world("online"), words.SYSTEM, words.LOOK)
        assert (look.request, look.judged, look.error) == (number, (), error)
    physical.fail(kind, 0.0)
    ended(cell, 4, package.name, "place/0", kind="look")
    testing.run_once(perception, cell)
    testing.run_once(DeviationDetection(), cell)
    assert get(cell.world("online"), words.SYSTEM, words.DEVIATIONS)["place/0"].verdict == "moved"


@pytest.mark.parametrize("kind", ["blind", "camera"])
def test_a_package_that_the_belt_sensor_does_not_show_is_not_forgotten(cell, physical, kind):
    """The arrival says why it was not seen; a request to look sees it when the sensor works."""
    perception = HandlingPerception("belt", "tray", frames=2)
    physical.fail(kind, 60.0)
    on_belt(physical, 0)
    write(cell, words.CONVEYOR, words.ARRIVAL, words.Arrival(0, 7))
    testing.run_once(perception, cell)
    assert each(cell.world("online"), words.PACKAGES, words.SIGHTING) == {}
    sight = get(cell.world("online"), words.CONVEYOR, words.SIGHT)
    assert sight.number == 0
    assert sight.error.startswith("the belt sensor ")
    ended(cell, 1, "", "place/0", kind="look")
    testing.run_once(perception, cell)
    assert get(cell.world("online"), words.SYSTEM, words.LOOK).error.startswith("the belt sensor ")
    physical.fail(kind, 0.0)
    ended(cell, 2, "", "place/0", kind="look")
    testing.run_once(perception, cell)
    assert get(cell.world("online"), words.SYSTEM, words.LOOK).error == ""
    assert len(each(cell.world("online"), words.PACKAGES, words.SIGHTING)) == 1


def test_what_has_come_is_looked_for_until_its_sighting_stands(cell, physical):
    """The commit of the first look fails: without a second one the package would have no entity."""
    perception = HandlingPerception("belt", "tray", frames=2)
    on_belt(physical, 0)
    write(cell, words.CONVEYOR, words.ARRIVAL, words.Arrival(0, 7))
    lose_commit(perception, cell)
    assert each(cell.world("online"), words.PACKAGES, words.SIGHTING) == {}
    testing.run_once(perception, cell)
    assert len(each(cell.world("online"), words.PACKAGES, words.SIGHTING)) == 1


def test_what_is_seen_again_and_again_nowhere_is_reported(cell, physical):
    """Something is in the light barrier; after a few looks the sight says that none is recognised."""
    perception = HandlingPerception("belt", "tray", frames=2)
    errors = []
    for stamp_ns in range(1, UNSEEN_LOOKS + 1):
        write(cell, words.CONVEYOR, words.ARRIVAL, words.Arrival(0, stamp_ns))
        testing.run_once(perception, cell)
        sight = get(cell.world("online"), words.CONVEYOR, words.SIGHT)
        errors.append("" if sight is None else sight.error)
    assert errors == [*[""] * (UNSEEN_LOOKS - 1), UNRECOGNISED]
    on_belt(physical, 0)
    write(cell, words.CONVEYOR, words.ARRIVAL, words.Arrival(0, UNSEEN_LOOKS + 1))
    testing.run_once(perception, cell)
    assert get(cell.world("online"), words.CONVEYOR, words.SIGHT).error == ""
    assert len(each(cell.world("online"), words.PACKAGES, words.SIGHTING)) == 1


def test_what_was_taken_out_of_the_light_barrier_is_reported_at_once(cell, physical):
    """The barrier is free and the belt shows nothing; something on the belt is seen all the same."""
    perception = HandlingPerception("belt", "tray", frames=2)
    write(cell, words.CONVEYOR, words.ARRIVAL, words.Arrival(0, 1, is_gone=True))
    testing.run_once(perception, cell)
    assert get(cell.world("online"), words.CONVEYOR, words.SIGHT).error == TAKEN_OUT
    on_belt(physical, 0)
    write(cell, words.CONVEYOR, words.ARRIVAL, words.Arrival(0, 2, is_gone=True))
    testing.run_once(perception, cell)
    assert get(cell.world("online"), words.CONVEYOR, words.SIGHT).error == ""
    assert len(each(cell.world("online"), words.PACKAGES, words.SIGHTING)) == 1


def test_an_empty_belt_that_could_not_be_seen_is_looked_at_again(physical, monkeypatch):
    """The sensor is not there yet: the error names it, and the next try finds it."""
    sensor, errors = PhysicalBeltSensor(physical.shown, seed=4), [OSError("no such device")]

    class Late:
        def capture_empty(self):
            if errors:
                raise errors.pop()
            return sensor.capture_empty()

    opened = "actors.palletizing.handling_perception.open_sensor"
    monkeypatch.setattr(opened, lambda _: Late())
    with testing.worlds("training", "online") as cell:
        belt = EmptyBelt("late")
        with pytest.raises(SensorError, match="the belt sensor gave no image: no such device"):
            testing.run_once(belt, cell)
        testing.run_once(belt, cell)
        view = View(cell.world("training"), words.BELT, words.EMPTY)
        assert cell.world("training").view(view)[view].depth_mm.any()
    assert belt.every_s
