"""The profile `packing` of the compose file: the palletizing robot, a container per process."""

import json

import pytest

pytest.importorskip("mujoco", exc_type=ImportError)
pytest.importorskip("open3d", exc_type=ImportError)

from stack import Stack

from actors.palletizing.demo_robot_cell import TEMPLATE

pytestmark = pytest.mark.containers

PACKAGES = 2


def test_packages_are_packed_and_judged_as_on_one_machine(engine, images, tmp_path_factory):
    """Every verdict is that of physics, and the report names what became of each package."""
    folder = tmp_path_factory.mktemp("packing")
    file = folder / "packing.toml"
    text = TEMPLATE.read_text("utf-8")
    file.write_text(text.replace("packages = 12", f"packages = {PACKAGES}"), "utf-8")
    with Stack(
        engine,
        "packing",
        folder,
        *("--file", "deploy/compose.yaml", "--profile", "packing"),
        ENACT_SHARED_SIZE="256m",
        ENACT_PACKING_FILE=file,
        ENACT_PACKAGES=PACKAGES,
    ) as stack:
        stack.compose("up", "--detach", "packing")

        assert stack.ended("packing") == 0, stack.docker("logs", "packing")
        report = json.loads((stack.out / "report.json").read_text("utf-8"))
        assert [package["correct"] for package in report["packages"]] == [True] * PACKAGES, report
        assert (stack.out / "tray_1.png").stat().st_size > 20_000
