"""Live and played views of a scenario are the same but for noise; recordings come back whole."""

import dataclasses
import importlib.util
import json
import shutil
import sys
import threading

import cv2
import numpy as np
import pytest

from actors.geometry.arms.kinematics import capsules_at
from actors.workcell.cameras.sources import FRAME_S, CameraError, source_of
from actors.workcell.demo.options import Options
from actors.workcell.scenarios import scenario_of
from actors.workcell.simulation import sources
from actors.workcell.simulation.arm import ARM, HOME_RAD, shown_at
from actors.workcell.simulation.camera import SimulatedCamera
from actors.workcell.simulation.drawing.backdrop import backdrop_of
from actors.workcell.simulation.drawing.render import NOISE_LEVELS
from actors.workcell.simulation.recording import kept_recording, read_info, record
from actors.workcell.simulation.room import cameras
from actors.workcell.simulation.stage import Stage
from actors.workcell.simulation.truth import TruthHuman, TruthRobot
from actors.workcell.vocabulary import (
    BODY,
    CALIBRATION,
    HUMANS,
    IMAGE,
    JOINTS,
    PERIOD_NS,
    PLAYING,
    ROBOT,
    SCENARIO,
    Body,
    Joints,
    Playing,
    camera_entity,
    human_entity,
)
from enact_dist import View, ViewEach, testing
from enact_dist.errors import ConfigError

BEGIN_NS = 1_000_000 * PERIOD_NS
VIEWS = cameras(0.25)[:2]
SECONDS = 4.0


def joints_of(q, dq=None, end_ns=BEGIN_NS, period_s=0.01):
    count = 30
    dq = np.zeros(7) if dq is None else np.asarray(dq, float)
    back_s = np.arange(count - 1, -1, -1)[:, None] * period_s
    stamps = end_ns - np.rint(back_s[:, 0] * 1e9).astype(np.int64)
    return Joints(np.asarray(q, float) - back_s * dq, np.tile(dq, (count, 1)), stamps)


def playing(name="visit", seed=3, robot=True, seconds=SECONDS):
    return Playing(name, seed, BEGIN_NS, seconds, robot)


def opened(address, what, joints=None, camera="0"):
    source = source_of(address, camera)
    source.open(VIEWS[int(camera)])
    source.look(what, joints)
    return source


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    root = tmp_path_factory.mktemp("recordings")
    told = []
    scenario = scenario_of("visit", 3, SECONDS)
    folder = kept_recording(
        root, scenario, calibrations=VIEWS, progress=lambda done, of: told.append((done, of))
    )
    assert sorted(told) == [(n, 80) for n in range(1, 81)]
    return root, folder


def test_live_view_is_the_same_for_the_same_stamp_and_has_the_arm_where_its_joints_are():
    """Equal inputs give equal images; other joints, or no robot, change over 100 pixels."""
    away = np.add(HOME_RAD, [1.2, 0, 0, 0, 0, 0, 0])
    one, same, other, bare = (
        opened("live", what, joints).frame(BEGIN_NS + 20 * PERIOD_NS)
        for what, joints in (
            (playing(), joints_of(HOME_RAD)),
            (playing(), joints_of(HOME_RAD)),
            (playing(), joints_of(away)),
            (playing(robot=False), None),
        )
    )
    np.testing.assert_array_equal(one, same)
    assert (np.abs(one.astype(int) - other).max(2) > 40).sum() > 100
    assert (np.abs(one.astype(int) - bare).max(2) > 40).sum() > 100


def test_prepared_view_is_the_view():
    """Preparing a stamp beforehand changes no pixel of its image."""
    ready, unready = (opened("live", playing(), joints_of(HOME_RAD)) for _ in range(2))
    stamp_ns = BEGIN_NS + 25 * PERIOD_NS
    ready.prepare(stamp_ns)
    np.testing.assert_array_equal(ready.frame(stamp_ns), unready.frame(stamp_ns))


def test_nobody_is_there_before_and_after():
    """Before the scenario the image is that of the empty room, after it but for noise."""
    source = opened("live", playing(robot=False))
    empty = opened("live", None).frame(BEGIN_NS - PERIOD_NS)
    np.testing.assert_array_equal(source.frame(BEGIN_NS - PERIOD_NS), empty)
    inside = source.frame(BEGIN_NS + 30 * PERIOD_NS)
    after = source.frame(BEGIN_NS + 40 * PERIOD_NS)
    limit = 8 * NOISE_LEVELS
    assert (np.abs(inside.astype(int) - empty).max(2) > limit).sum() > 50
    assert (np.abs(after.astype(int) - empty).max(2) > limit).sum() == 0


def test_scenario_must_begin_at_a_tick():
    """A begin one nanosecond after a tick is refused."""
    late = dataclasses.replace(playing(), start_ns=BEGIN_NS + 1)
    with pytest.raises(CameraError, match="asked for a scenario that begins at a tick"):
        opened("live", late).frame(BEGIN_NS)


def test_without_numba_a_simulated_camera_says_what_to_install(monkeypatch):
    """The error names the camera and the extra."""
    monkeypatch.setitem(sys.modules, "actors.workcell.simulation.drawing.kernels", None)
    with pytest.raises(CameraError, match=r"camera/0: .*install the extra workcell"):
        opened("live", None)


def test_scenario_that_begins_at_another_time_is_compared_only_once(recording, monkeypatch):
    """One of ten minutes takes a second to compare with its recording; only that may take long."""
    compared = []
    known = sources.check_truth
    monkeypatch.setattr(
        sources, "check_truth", lambda *given: (compared.append(given), known(*given))
    )
    source = opened(f"playback+robot:{recording[1]}", None, joints_of(HOME_RAD))
    source.look(playing(), joints_of(HOME_RAD))
    allowed_s = [source.frame_s]
    source.prepare(BEGIN_NS)
    allowed_s.append(source.frame_s)
    source.look(dataclasses.replace(playing(), start_ns=BEGIN_NS + PERIOD_NS), None)
    allowed_s.append(source.frame_s)
    source.prepare(BEGIN_NS + PERIOD_NS)
    assert len(compared) == 1
    assert allowed_s == [sources.FOLLOW_S, FRAME_S, FRAME_S]


def test_stuck_camera_repeats_its_image():
    """Its image stays the same while it is stuck, and changes afterwards."""
    source = opened("live", playing(), joints_of(HOME_RAD))
    first = source.frame(BEGIN_NS)
    source.look(playing(), joints_of(HOME_RAD), stuck=True)
    np.testing.assert_array_equal(source.frame(BEGIN_NS + PERIOD_NS), first)
    source.look(playing(), joints_of(HOME_RAD))
    assert (source.frame(BEGIN_NS + 2 * PERIOD_NS) != first).any()


@pytest.mark.parametrize("frame", [0, 15, 30])
def test_played_view_with_the_live_arm_is_the_live_view_but_for_noise_and_jpeg(recording, frame):
    """Blurred, the two differ by less than 0.3 levels on average."""
    stamp_ns, joints = BEGIN_NS + frame * PERIOD_NS, joints_of(HOME_RAD)
    live = opened("live", playing(), joints).frame(stamp_ns)
    played = opened(f"playback+robot:{recording[1]}", playing(), joints).frame(stamp_ns)
    difference = cv2.blur(live, (3, 3)).astype(int) - cv2.blur(played, (3, 3))
    assert np.abs(difference).mean() < 0.3
    assert (np.abs(difference).max(2) > 20).sum() < 12  # JPEG at the outline of a small person


def test_recording_is_made_once_and_again_if_it_is_of_something_else(recording):
    """A second request for the same scenario returns the folder untouched."""
    root, folder = recording
    made_ns = (folder / "recording.json").stat().st_mtime_ns
    scenario = scenario_of("visit", 3, SECONDS)
    assert kept_recording(root, scenario, calibrations=VIEWS) == folder
    assert (folder / "recording.json").stat().st_mtime_ns == made_ns
    assert [path.name for path in root.iterdir() if path.is_dir()] == [folder.name]


def test_programs_that_want_a_recording_at_once_make_one(tmp_path):
    """The second one waits for the first and plays what it made; nobody's images are replaced."""
    scenario, start, drawn, made = scenario_of("S1", 1, 0.5), threading.Barrier(2), [], []

    def want():
        start.wait()
        folder = kept_recording(
            tmp_path, scenario, calibrations=VIEWS[:1], progress=lambda *_: drawn.append(1)
        )
        made.append((folder / "recording.json").stat().st_ino)

    programs = [threading.Thread(target=want) for _ in range(2)]
    for program in programs:
        program.start()
    for program in programs:
        program.join()

    assert (len(made), len(set(made)), len(drawn)) == (2, 1, 5)


@pytest.mark.parametrize("there", ["a file", "a folder of files"])
def test_what_is_no_recording_is_not_replaced_by_one(tmp_path, there):
    """A wrong folder after --record would be gone."""
    kept = tmp_path / "thesis" if there == "a file" else tmp_path / "thesis" / "text"
    kept.parent.mkdir(exist_ok=True)
    kept.write_text("years of work")
    with pytest.raises(CameraError, match="thesis: asked for a new folder"):
        record(tmp_path / "thesis", scenario_of("S1", 1, 0.2), calibrations=VIEWS[:1])
    assert kept.read_text() == "years of work"


def test_recording_that_a_full_disk_cuts_short_is_none(tmp_path, monkeypatch):
    """Neither the empty room nor a frame is left out in silence."""
    monkeypatch.setattr("cv2.imwrite", lambda path, *_: not path.endswith("still.png"))
    with pytest.raises(OSError, match=r"still\.png: could not be written; is the disk full"):
        record(tmp_path / "views", scenario_of("S1", 1, 0.2), calibrations=VIEWS[:1])
    assert not (tmp_path / "views").exists()


def test_options_refuse_a_recording_of_something_else(recording, tmp_path):
    """At once, with the options that play it; its cameras would refuse it minutes later."""
    source = f"playback+robot:{recording[1]}"
    with pytest.raises(ConfigError, match=r"play it with --scenario visit --seed 3 --seconds 4$"):
        Options(tmp_path, source=source)
    assert Options(tmp_path, seed=3, seconds=SECONDS, source=source).seed == 3


def test_options_refuse_a_recording_that_lacks_a_camera(recording, tmp_path):
    """A folder that was copied in part is named before a cell is started for it."""
    shutil.copytree(recording[1], tmp_path / "part")
    (tmp_path / "part" / "camera_1" / "windows.npy").unlink()

    with pytest.raises(ConfigError, match=r"found no camera_1/windows.npy; record it again"):
        Options(tmp_path, source=f"playback:{tmp_path / 'part'}")


def test_recording_knows_its_truth(recording):
    """It has the bodies of its scenario, and no joints if it was made without the arm."""
    truth = np.load(recording[1] / "truth.npz")
    stage = Stage(scenario_of("visit", 3, SECONDS))
    np.testing.assert_array_equal(truth["bodies"][30, 0], stage.bodies_at(3.0)[0])
    assert np.isnan(truth["bodies"][0]).all()
    assert truth["joints"].shape == (0, 7)


@pytest.mark.parametrize("changed", ["bodies", "boxes"])
def test_recording_of_what_its_scenario_was_before_is_refused_and_made_anew(tmp_path, changed):
    """The images of an older version disagree with the truth of the run."""
    scenario = scenario_of("visit", 3, 3.0)
    folder = kept_recording(tmp_path, scenario, calibrations=VIEWS[:1])
    with np.load(folder / "truth.npz") as file:
        truth = dict(file)
    now = truth[changed].copy()
    truth[changed] = now + 0.1
    np.savez(folder / "truth.npz", **truth)

    with pytest.raises(CameraError, match=r"as it is now; found one in which .*; record it again"):
        opened(f"playback:{folder}", playing(seconds=3.0)).frame(BEGIN_NS)
    assert kept_recording(tmp_path, scenario, calibrations=VIEWS[:1]) == folder
    with np.load(folder / "truth.npz") as file:
        np.testing.assert_array_equal(file[changed], now)


def test_a_scenario_that_begins_anew_is_not_compared_again(recording, monkeypatch):
    """Ten minutes of a recording take three seconds to compare: no image came meanwhile."""
    compared = []
    monkeypatch.setattr(
        "actors.workcell.simulation.sources.check_truth", lambda *_: compared.append(1)
    )
    source = opened(f"playback:{recording[1]}", playing())
    first = source.frame(BEGIN_NS + 30 * PERIOD_NS)
    source.look(dataclasses.replace(playing(), start_ns=BEGIN_NS + 50 * PERIOD_NS), None)
    again = source.frame(BEGIN_NS + 80 * PERIOD_NS)

    assert compared == [1]
    assert np.abs(cv2.blur(first, (5, 5)).astype(int) - cv2.blur(again, (5, 5))).max() < 8
    with pytest.raises(CameraError, match="begins at a tick"):
        source.look(dataclasses.replace(playing(), start_ns=BEGIN_NS + 1), None)
        source.frame(BEGIN_NS)


def test_recording_with_the_arm_plays_as_it_was(tmp_path):
    """Its arm is where the motion put it; no second arm can be drawn over it."""
    scenario = scenario_of("S1", 1, 0.3)

    def motion(at_s):
        return np.add(HOME_RAD, [at_s, 0, 0, 0, 0, 0, 0])

    folder = record(tmp_path / "swing", scenario, calibrations=VIEWS[:1], motion=motion)
    what = playing("S1", 1, seconds=0.3)
    played = opened(f"playback:{folder}", what).frame(BEGIN_NS + 2 * PERIOD_NS)
    live = opened("live", what, joints_of(motion(0.2))).frame(BEGIN_NS + 2 * PERIOD_NS)
    assert np.abs(cv2.blur(played, (3, 3)).astype(int) - cv2.blur(live, (3, 3))).mean() < 0.3
    with pytest.raises(CameraError, match="asked for a recording without the arm"):
        opened(f"playback+robot:{folder}", what)


def test_recordings_that_do_not_fit_are_one_line_each(recording, tmp_path):
    """Another seed, size, camera, format or a missing image is named."""
    address = f"playback+robot:{recording[1]}"
    with pytest.raises(CameraError, match="asked for a recording of visit, seed 4"):
        opened(address, playing(seed=4)).frame(BEGIN_NS)
    source = source_of(address, "0")
    with pytest.raises(CameraError, match="asked for 640 x 480 pixels"):
        source.open(cameras()[0])
    with pytest.raises(CameraError, match="asked for camera 5; found 2 cameras"):
        source_of(address, "5").open(VIEWS[0])
    broken = kept_recording(tmp_path, scenario_of("visit", 3, 3.0), calibrations=VIEWS)
    next((broken / "camera_0").glob("*.jpg")).unlink()
    with pytest.raises(CameraError, match="found no such file; record it again"):
        source_of(f"playback:{broken}", "0").open(VIEWS[0])
    info = json.loads((broken / "recording.json").read_text())
    (broken / "recording.json").write_text(json.dumps(info | {"format": 99}))
    with pytest.raises(CameraError, match="found format 99"):
        read_info(broken)


def test_mujoco_draws_the_same_scene_or_says_why_not():
    """Where MuJoCo can draw, arm and people stand where the composite renderer puts them."""
    if importlib.util.find_spec("mujoco") is None:
        pytest.skip("MuJoCo is not installed")
    from actors.workcell.simulation.drawing.mujoco_views import mujoco_draws
    from actors.workcell.simulation.drawing.render import View as Composite

    stage = Stage(scenario_of("visit", 3, 8.0))
    draw = mujoco_draws(VIEWS, stage)[1]
    try:
        empty = draw(stage.scene_at(-1.0)).astype(int)
    except CameraError as error:
        assert "renderer mujoco: it cannot draw here" in str(error)  # noqa: PT017
        pytest.skip(str(error))
    scene = stage.scene_at(5.0, capsules_at(ARM, np.array(HOME_RAD))[0])
    shown = Composite(VIEWS[1], 0).render(scene.capsules, scene.colours, scene.boxes).names > 0
    changed = np.abs(draw(scene).astype(int) - empty).max(2) > 25
    assert shown.sum() > 150
    assert (shown & changed).sum() > 0.85 * shown.sum()
    near = cv2.dilate(shown.astype(np.uint8), np.ones((3, 3))) > 0
    assert (changed & ~near).sum() < 1.5 * shown.sum()  # shadows


def test_arm_is_shown_between_its_samples_and_ahead_of_them():
    """It goes on at its last speed, and hardly moves on if it was braking."""
    speed = np.array([1.0, 0, 0, 0, 0, 0, -0.5])
    joints = joints_of(HOME_RAD, speed)
    np.testing.assert_allclose(
        shown_at(joints, BEGIN_NS - 105_000_000), np.array(HOME_RAD) - 0.105 * speed, atol=1e-9
    )
    np.testing.assert_allclose(
        shown_at(joints, BEGIN_NS + PERIOD_NS), np.array(HOME_RAD) + 0.1 * speed, atol=1e-9
    )
    braking = dataclasses.replace(joints, dq=joints.dq * np.linspace(30.0, 1.0, 30)[:, None] / 30.0)
    ahead = shown_at(braking, BEGIN_NS + PERIOD_NS)
    assert 0.0 < ahead[0] - HOME_RAD[0] < 0.001


def test_simulated_camera_and_truth_write_what_plays():
    """Image, joints and bodies are written; the body of a person who has left goes."""
    with testing.worlds("online", "truth") as cell:
        online, truth = cell.world("online"), cell.world("truth")
        start_ns = 1_000 * 1_000_000_000 - 3 * 1_000_000_000
        truth.init(SCENARIO, PLAYING, dataclasses.replace(playing(), start_ns=start_ns))
        online.init(camera_entity(0), CALIBRATION, VIEWS[0])
        online.init(ROBOT, JOINTS, joints_of(HOME_RAD))
        truth.init(human_entity(1), BODY, Body(np.zeros((17, 7), "f4"), np.zeros(2), np.zeros(2)))
        camera = SimulatedCamera("live")
        camera.only_entity = camera_entity(0)
        testing.run_once(camera, cell)
        testing.run_once(TruthRobot(), cell)
        testing.run_once(TruthHuman(), cell)
        image, joints = View(online, camera_entity(0), IMAGE), View(truth, ROBOT, JOINTS)
        bodies = ViewEach(truth, HUMANS, BODY)
        assert online.view(image)[image].shape == (120, 160, 3)
        np.testing.assert_allclose(truth.view(joints)[joints].q[-1], HOME_RAD)
        found = truth.view(bodies)[bodies]
        assert list(found) == [human_entity(0)]
        stage = Stage(scenario_of("visit", 3, SECONDS))
        np.testing.assert_allclose(
            found[human_entity(0)].capsules, stage.bodies_at(3.0)[0], atol=1e-6
        )
        assert 0.8 < np.linalg.norm(found[human_entity(0)].velocity_m_s) < 1.4
        wrong = SimulatedCamera("v4l2:/dev/video0")
        wrong.only_entity = camera_entity(0)
        with pytest.raises(CameraError, match="asked for a simulated source"):
            testing.run_once(wrong, cell)


def test_opening_draws_all_rooms_of_the_scenario(monkeypatch):
    """A frame has one second; the rooms of a walk-in cabinet, and of a box that is left, take it."""
    drawn = []
    monkeypatch.setattr(
        "actors.workcell.simulation.drawing.render.backdrop_of",
        lambda *_: drawn.append(1) or backdrop_of(*_),
    )
    for name, rooms in (("S4", 2), ("S6", 2)):  # S4: without and with the cabinet
        source = source_of("live", "0")
        source.look(playing(name), None)
        source.open(VIEWS[0])
        assert len(drawn) == rooms
        source.frame(BEGIN_NS + round((SECONDS - 1.0) * 1e9))
        assert len(drawn) == rooms
        drawn.clear()
