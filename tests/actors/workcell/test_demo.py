"""Claims about the demonstration around the cell: its configuration, its recording, its faults."""

import dataclasses
import json
import os
import pickle
import re
import subprocess
import threading
import time
import tracemalloc
import types
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

pytest.importorskip("cv2", exc_type=ImportError)
pytest.importorskip("mcap", exc_type=ImportError)

from actors import running_cell
from actors.running_cell import DemoCell, DemoError
from actors.workcell import vocabulary as words
from actors.workcell.demo import cell as demo_cell
from actors.workcell.demo import conduct as demo_conduct
from actors.workcell.demo.cell import configured
from actors.workcell.demo.conduct import Conductor, Notes, recording, told
from actors.workcell.demo.options import Options
from actors.workcell.demo.report import (
    report_of,
    show_lineage,
    show_past,
    stop_checks,
    value_text,
)
from actors.workcell.demo.run import run_quietly
from actors.workcell.demo.unshared import PlainEach, PlainLock, Version
from actors.workcell.demo.what_if import in_both
from actors.workcell.scenarios import Fault, scenario_of
from actors.workcell.scores.trace import ASPECTS, trace_of
from actors.workcell.setup import Setup
from actors.workcell.simulation.truth import TruthHuman
from enact_dist import Aspect, Entity, Lock, View, Write, local, testing
from enact_dist.actor.running.commands import ACTOR, COMMANDS
from enact_dist.errors import ConfigError, MisuseError

NOTE = Aspect("note", str)


def put_hull_and_speed(online, views, stamp_ns):
    """Commit a hull of one voxel, made of masks, and the speed made of it."""
    hull = Write(online, words.WORKSPACE, words.HULL)
    speed = Write(online, words.ROBOT, words.SPEED)
    with Lock(hull, *views) as lock:
        for view in views:
            assert lock[view] is not None
        flags = np.ones(1, np.bool_), np.zeros(1, np.int16)
        one = words.Hull(
            np.ones((1, 3), np.int16), np.full(1, 0.1, np.float32), *flags, {}, (), 0.1, 0
        )
        lock.put(hull, one, stamp_ns=stamp_ns)
    seen = View(online, words.WORKSPACE, words.HULL)
    with Lock(seen, speed) as lock:
        assert lock[seen].nearest_m == 0.1
        near = words.Speed(0.0, 0.0, 0.1, "someone is too near", 250.0, stamp_ns, stamp_ns)
        lock.put(speed, near, stamp_ns=stamp_ns)


def test_a_recording_gives_back_what_was_committed(tmp_path):
    """Data, stamps and order; what is null is left out."""
    with local(worlds=["online", "truth"]) as cell:
        speed = Write(cell.world("online"), words.ROBOT, words.SPEED)
        with recording(cell, tmp_path / "run.mcap"):
            for number in range(3):
                with Lock(speed) as lock:
                    datum = words.Speed(number / 2.0, 1.0, 2.0, "test", 250.0, number, number)
                    lock.put(speed, datum, stamp_ns=1000 + number)

    kept = trace_of(tmp_path / "run.mcap").of(words.ROBOT.name, words.SPEED)

    assert [one.datum.scale for one in kept] == [0.0, 0.5, 1.0]
    assert [one.stamp_ns for one in kept] == [1000, 1001, 1002]
    assert [one.committed_ns for one in kept] == sorted(one.committed_ns for one in kept)


def test_a_trace_takes_a_small_part_of_what_was_recorded(tmp_path):
    """Ten minutes hold 48,000 masks and 6,000 hulls: neither they nor their chunks stay whole."""
    packed = np.zeros((480, 80), np.uint8)
    packed[100:200, 20:40] = 255
    with local(worlds=["online", "truth"]) as cell:
        mask = Write(cell.world("online"), Entity("camera/0"), words.SILHOUETTE)
        speed = Write(cell.world("online"), words.ROBOT, words.SPEED)
        with recording(cell, tmp_path / "run.mcap"):
            for number in range(100):
                with Lock(mask, speed) as lock:
                    lock.put(mask, words.Silhouette(packed, 16_000, False))
                    lock.put(speed, words.Speed(1.0, 1.0, 2.0, "", 250.0, number, number))

    tracemalloc.start()
    trace = trace_of(tmp_path / "run.mcap")
    taken, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    masks = trace.of("camera/0", words.SILHOUETTE)
    assert len(masks) == 100
    assert taken < 100 * packed.nbytes / 8
    np.testing.assert_array_equal(masks[0].datum.packed, packed)


def test_why_it_stopped_goes_to_where_the_progress_goes(capsys):
    """With --json, standard output holds the report alone."""
    with local(worlds=["online", "truth"]) as cell:
        hull = Write(cell.world("online"), words.WORKSPACE, words.HULL)
        speed = Write(cell.world("online"), words.ROBOT, words.SPEED)
        with Lock(hull) as lock:
            empty = np.empty((0, 3), np.int16), np.empty(0, np.float32)
            flags = np.empty(0, np.bool_), np.empty(0, np.int16)
            lock.put(hull, words.Hull(*empty, *flags, {}, (), np.inf, -1))
        with Lock(View(cell.world("online"), words.WORKSPACE, words.HULL), speed) as lock:
            lock.put(speed, words.Speed(0.0, 0.0, 0.1, "someone is too near", 250.0, 1, 1))
        tree = cell.why("online", words.ROBOT, words.SPEED, depth=3)
    console = Console(stderr=True)
    show_lineage(tree, 0, console)
    told = capsys.readouterr()
    assert told.out == ""
    assert "workspace/hull v1" in told.err
    show_lineage(tree, 0, Console(quiet=True))  # a bench prints rows only
    assert capsys.readouterr().out == ""


def test_a_stop_leads_to_the_images_that_were_committed_with_its_masks(tmp_path):
    """A smart camera writes image and mask in one step, so neither is a cause of the other."""
    options, told = Options(tmp_path), []
    running = DemoCell(tmp_path / "cell.toml", log="")
    with local(worlds=["online", "truth"]) as cell:
        online = cell.world("online")
        views = []
        for number in range(2):
            camera = words.camera_entity(number)
            image, mask = (Write(online, camera, one) for one in (words.IMAGE, words.SILHOUETTE))
            with Lock(image, mask) as lock:
                lock.put(image, np.zeros((4, 8, 3), np.uint8), stamp_ns=7)
                lock.put(mask, words.Silhouette(np.zeros((4, 1), np.uint8), 0), stamp_ns=7)
            views.append(View(online, camera, words.SILHOUETTE))
        put_hull_and_speed(online, views, 7)
        conductor = Conductor(cell, running, options, told.append)
        conductor.notes.cameras = 2

        conductor._keep_stop()

        assert set(stop_checks(conductor.notes).values()) == {True}
        kept = [str(one.aspect) for one in cell.pinned()["first-stop"]]
        assert kept.count("image") == kept.count("silhouette") == 2


def test_a_frozen_process_goes_on_when_the_run_fails(tmp_path, monkeypatch):
    """It could not end with its cell, and would stay."""
    freeze = dataclasses.replace(scenario_of("S1", 1), faults=(Fault(0.0, "freeze", "one", 60.0),))
    monkeypatch.setattr(demo_conduct, "scenario_of", lambda *_: freeze)
    rounds = iter([None])
    with local(worlds=["online", "truth"]) as cell, subprocess.Popen(["sleep", "60"]) as process:
        running = types.SimpleNamespace(
            check=lambda: next(rounds), shard_pid=lambda _: process.pid, config=tmp_path
        )
        conductor = Conductor(cell, running, Options(tmp_path), lambda _: None)
        conductor.notes.start_ns = time.time_ns()

        with pytest.raises(StopIteration):
            conductor.follow()

        state = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[0]
        process.kill()
    assert conductor.notes.faults == ["freeze one"]
    assert state != "T"
    demo_conduct.go_on(process.pid)  # of a process that has ended: nothing


def test_a_camera_repeats_its_image_until_its_time_is_over(tmp_path, monkeypatch):
    """The commands are in the cell when their moment is over: no process brings them later."""
    stuck = dataclasses.replace(scenario_of("S1", 1), faults=(Fault(0.0, "stuck", "one", 0.3),))
    monkeypatch.setattr(demo_conduct, "scenario_of", lambda *_: stuck)
    with testing.worlds("online", "truth") as cell:
        world = cell.world("online")
        session = world.session.client.core.session
        row = {"name": "one", "state": "running", "words_in": "online"}
        info = types.SimpleNamespace(
            session=session, silent=False, rows=lambda: [row], names=lambda: {"one"}
        )
        monkeypatch.setattr(cell, "actors", lambda: [info])
        taken = []

        def look_at_commands():
            seen = View(world, ACTOR, COMMANDS)
            taken.append(world.view(seen).get(seen, {}).get(session, {}).get("set"))
            if taken[-1] == {"stuck": "false"}:
                raise DemoError

        running = types.SimpleNamespace(check=look_at_commands, config=tmp_path, log="a log")
        conductor = Conductor(cell, running, Options(tmp_path), lambda _: None)
        conductor.notes.start_ns = time.time_ns()

        with pytest.raises(DemoError):
            conductor.follow()

    assert taken[0] is None
    assert {"stuck": "true"} in taken


def test_an_actor_that_reads_no_commands_ends_the_run_in_one_line(tmp_path):
    """The error names the actor and the log to look at."""
    with local(worlds=["online", "truth"]) as cell:
        running = DemoCell(tmp_path / "cell.toml", log="a log")
        conductor = Conductor(cell, running, Options(tmp_path), lambda _: None)
        with pytest.raises(DemoError, match="actor camera-3 accepts no commands; see a log"):
            conductor._set("camera-3", "stuck", "true")


def test_the_nearest_approach_is_shown_when_hulls_of_its_time_are_forgotten(capsys):
    """A plain run of a minute is longer than hulls stay; those that were kept are there."""
    with local(worlds=["online", "truth"]) as cell:
        online = cell.world("online")
        put_hull_and_speed(online, (), 1)
        put_hull_and_speed(online, (), 2)
        near = [
            online.history(entity, aspect, count=1)[0]
            for entity, aspect in ((words.WORKSPACE, words.HULL), (words.ROBOT, words.SPEED))
        ]
        cell.pin("nearest", near)
        for stamp_ns in range(3, 130):
            put_hull_and_speed(online, (), stamp_ns)

        show_past(cell, Notes(nearest_ns=2), Console())

    assert "1 voxels, the nearest 0.10 m from the arm" in capsys.readouterr().out


def test_who_looks_on_gives_way_to_the_cell():
    """Only the thread that looks on: its process goes on as it was."""
    found = []

    def look_on():
        running_cell.give_way()
        found.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))

    before = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    thread = threading.Thread(target=look_on)
    thread.start()
    thread.join()

    assert found == [running_cell.LOOKING_ON_NICE]
    assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) == before


def test_updates_without_sharing_do_what_they_do_in_a_cell():
    """A set-up, and people of a scenario, leave the same data in a dictionary as on a shard."""
    slots = {}
    clock = testing.ManualClock()
    tick_ns = clock.wall_ns()
    actors = Setup("S2", 3, 12.0), TruthHuman()
    start_ns = tick_ns - 4_000_000_000
    playing = words.Playing("S2", 3, start_ns, 12.0, robot=True)
    with testing.worlds("online", "truth", clock=clock) as cell:
        for actor in actors:
            testing.run_once(actor, cell)
            actor.update(PlainLock(slots, None, tick_ns))
            request = Write(cell.world("truth"), words.SCENARIO, words.PLAYING)
            with Lock(request) as lock:
                lock[request] = playing
            slots["truth", words.SCENARIO.name, words.PLAYING.name] = Version(playing, 0, 2)
        for (world, entity, aspect), version in slots.items():
            request = View(cell.world(world), Entity(entity), ASPECTS[aspect])
            there = cell.world(world).view(request)[request]
            assert pickle.dumps(there) == pickle.dumps(version.datum)
        assert ("truth", "human/0", "body") in slots
        bodies = PlainEach(PlainLock(slots, None, tick_ns), ("truth", "human/*", "body"))
        assert list(bodies) == [Entity("human/0")]
        bodies.pop(Entity("human/0"))
        assert not bodies


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"voxel_m": 0.0}, "--voxel-m is 0"),
        ({"voxel_m": 5.0}, "--voxel-m is 5"),
        ({"seed": -1}, "the seed is -1"),
        ({"source": "playback+robot:/nowhere"}, "/nowhere: asked for a recording"),
        ({"scenario": "S99"}, "no scenario 'S99'"),
        ({"out": Path(__file__)}, "is a file; name a folder"),
    ],
)
def test_options_that_cannot_work_are_one_line_each(tmp_path, given, said):
    """The error names the option, and what was given."""
    with pytest.raises(ConfigError, match=re.escape(said)):
        Options(**{"out": tmp_path, **given})


def test_report_names_what_was_missed():
    """Infinities are no JSON."""
    scores = {"robot_p99_ms": 120.0, "violations": 0.0, "distance_max_m": float("inf")}
    report = report_of(scores, {"seed": 1}, {"holds": True})
    assert json.loads(json.dumps(report))["missed"] == ["robot_p99_ms", "distance_max_m"]
    assert report["scores"]["distance_max_m"] is None
    assert value_text("lost_share", 0.0001) == "0.0100%"


def test_a_state_without_a_reason_is_one_word():
    """What is reported after the colon is the reason, without its semicolon."""
    assert told(words.Safety("run", "", 0), None, 0) == ("run", "run")
    without = words.Safety("run", "; without camera/3", 0)
    assert told(without, None, 0) == ("run", "run: without camera/3")
    near = words.Safety("stop", "someone is too near", 0)
    assert told(near, None, 0) == ("stop", "stop: someone is too near")


def test_a_cell_without_commands_is_not_said_to_run():
    """Speed control, which says how the cell does, says so once per hull."""
    run, begun_ns = words.Safety("run", "", 0), 1_000_000_000
    speed = words.Speed(1.0, 1.5, np.inf, "no person is there", 250.0, begun_ns, begun_ns)

    assert told(run, speed, begun_ns + 400_000_000) == ("run", "run")
    state, line = told(run, speed, begun_ns + 1_200_000_000)
    assert state != "run"
    assert "its newest command is 1.2 s old" in line


@pytest.mark.timing
def test_the_robot_rests_while_its_reconstruction_is_dead_and_goes_on(tmp_path, monkeypatch):
    """Real processes: no moment is too fast, commands stop with the hulls, and come back."""
    killed_s = 3.0

    def with_fault(name, seed, seconds):
        return dataclasses.replace(
            scenario_of(name, seed, seconds),
            faults=(Fault(killed_s, "kill", "reconstruction"),),
        )

    monkeypatch.setattr(demo_conduct, "scenario_of", with_fault)
    options = Options(tmp_path, scenario="S2", seconds=20.0, source="live", voxel_m=0.05)

    outcome = run_quietly(options)

    assert outcome.scores["violations"] == 0.0
    assert outcome.scores["moments"] > 100
    trace = trace_of(tmp_path / "run.mcap")
    start_ns = trace.newest(words.SCENARIO.name, words.PLAYING, "truth").start_ns
    seconds = [(kept.stamp_ns - start_ns) / 1e9 for kept in trace.of(words.ROBOT.name, words.SPEED)]
    assert max(np.diff(seconds)) > 0.5  # nobody commands while it is away
    assert max(seconds) > killed_s + 0.5  # and somebody does again
    for name in ("report.json", "timeline.png", "cell.toml", "run.mcap"):
        assert (tmp_path / name).stat().st_size > 1000


def test_a_cell_in_one_process_ends_its_actors_before_its_shard(tmp_path, monkeypatch):
    """Else they find their cell closed, and the run fails at its end."""

    def small(text, options):
        config = configured(text, options)
        return config | {"actors": {name: config["actors"][name] for name in ("setup", "watch")}}

    monkeypatch.setattr(demo_cell, "configured", small)
    running = demo_cell.EmbeddedCell(Options(tmp_path, embedded=True))

    with running, running.joined() as cell:
        grid = View(cell.world("online"), words.WORKSPACE, words.GRID)
        with cell.world("online").watch(str(words.WORKSPACE), words.GRID) as watch:
            assert watch.next(30.0) is not None
        assert cell.world("online").view(grid)[grid].voxel_m == 0.025

    with pytest.raises(MisuseError, match="closed"):
        cell.world("online").view(grid)


def test_paths_of_a_fork_are_told_from_those_of_its_own_process():
    """With --embedded both planners write from one session."""
    with local(worlds=["online"]) as cell:
        online = cell.world("online")
        fork = online.fork("what_if")
        for world in (online, fork, fork, online):
            request = Write(world, words.ROBOT, NOTE)
            with Lock(request) as lock:
                lock[request] = "a path"
        here, there = (world.history(words.ROBOT, NOTE) for world in (online, fork))
        assert (len(here), len(there)) == (2, 2)
        assert in_both(there, here) == 0
        assert in_both(there, [*here, there[-1]]) == 1
