"""The profile `packing` of the compose file: the palletizing robot, a container per process."""

import json

import pytest

pytest.importorskip("mujoco", exc_type=ImportError)
pytest.importorskip("open3d", exc_type=ImportError)

from stack import Stack

from actors.palletizing.demo.robot_cell import TEMPLATE

pytestmark = [pytest.mark.containers, pytest.mark.sampled(1, of="applications in containers")]

PACKAGES = 2


def test_packages_are_packed_in_containers(engine, images, tmp_path_factory):
    """The report names what became of each package, and every verdict is what physics did.

    That holds without containers, too; what physics does is no constant: on processors that others
    use a grasp may fail and a package be rejected.  One at least stands as planned.
    """
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
        ended = [(one["result"], one["verdict"], one["correct"]) for one in report["packages"]]
        assert len(ended) == PACKAGES
        assert all(result for result, _, _ in ended), report
        assert all(correct for _, _, correct in ended), report["packages"]
        assert ("placed", "ok", True) in ended, report
        assert (stack.out / "tray_1.png").stat().st_size > 20_000
