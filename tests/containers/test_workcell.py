"""The profile `workcell` of the compose file: a camera's container is killed while the cell runs."""

import json

import pytest

pytest.importorskip("cv2", exc_type=ImportError)

from stack import Stack, until

from actors.running_cell import toml_of
from actors.workcell.demo.cell import TEMPLATE, configured
from actors.workcell.demo.options import Options

pytestmark = [pytest.mark.containers, pytest.mark.sampled(1, of="applications in containers")]

KILLED = "camera/3"


@pytest.fixture(scope="module")
def stack(engine, images, tmp_path_factory):
    """The cell, conducted by its demo: a coarse grid, so that two busy cores suffice."""
    folder = tmp_path_factory.mktemp("workcell")
    file = folder / "workcell.toml"
    options = Options(folder, source="live", voxel_m=0.05, seconds=300.0)
    file.write_text(toml_of(configured(TEMPLATE.read_text("utf-8"), options)), "utf-8")
    with Stack(
        engine,
        "workcell",
        folder,
        *("--file", "deploy/compose.yaml", "--profile", "workcell"),
        ENACT_SHARED_SIZE="256m",
        ENACT_WORKCELL_FILE=file,
    ) as stack:
        stack.compose("up", "--detach", "workcell")
        stack.log_until("workcell", "scenario visit, seed 1, 300 s")
        yield stack


def read(stack, entity, aspect):
    """Return a datum as the shard's container prints it, by name of the line."""
    said = stack.enact("world", "get", "online", f"{entity}/{aspect}", inside="workcell-speed")
    return dict(line.strip().partition(": ")[::2] for line in said.splitlines())


def test_the_robot_goes_on_without_a_camera_whose_container_was_killed(stack):
    """Sets reach the robot; the camera is named; sets of later images reach the robot, too."""

    def captured_ns():
        return int(read(stack, "robot", "execution").get("captured_ns", 0))

    first_ns = until(captured_ns, lambda: stack.docker("logs", "workcell-speed")[-2000:])
    stack.docker("kill", "workcell-camera-3")

    named = until(
        lambda: KILLED in read(stack, "robot", "speed").get("reason", ""),
        lambda: read(stack, "system", "cameras"),
    )
    killed_ns = last_image_ns(stack)
    later_ns = until(
        lambda: (now_ns := captured_ns()) > killed_ns and now_ns,
        lambda: read(stack, "robot", "execution"),
    )

    assert named
    assert later_ns > first_ns
    assert last_image_ns(stack) == killed_ns, "the camera gives images though it is dead"
    states = [stack.state(f"workcell-{name}")["Running"] for name in ("robot", "camera-2")]
    assert states == [True, True]


def last_image_ns(stack):
    """Return the stamp of the last image of the killed camera."""
    versions = json.loads(
        stack.enact(
            *("world", "history", "online", f"{KILLED}/image", "--json"), inside="workcell-speed"
        )
    )
    return versions[-1]["captured_ns"]
