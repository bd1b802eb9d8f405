"""Actors that share a process: `process` of cell.toml, `enact up` and `enact actor run A B`."""

import os
import signal

import pytest

MODULE = """\
import os
from pathlib import Path

from enact_dist import Actor, Aspect, Entities, Entity, View, World, Write

ONLINE = World("online")
FRAME = Aspect("frame_number", int)
DOUBLE = Aspect("double_number", int)


class Camera(Actor):
    frame = Write(ONLINE, Entity("camera/3"), FRAME)
    every_s = 0.05
    step: int = 1

    def update(self, lock):
        lock[self.frame] = lock.get(self.frame, 0) + self.step


class Subtraction(Actor):
    frame = View(ONLINE, Entity("camera/3"), FRAME)
    double = Write(ONLINE, Entity("camera/3"), DOUBLE)
    triggers = [frame]

    def update(self, lock):
        lock[self.double] = 2 * lock[self.frame]


class Flaky(Actor):
    count = Write(ONLINE, Entity("flaky"), Aspect("count_of_flaky", int))
    every_s = 0.05

    def start(self):
        print("gain", os.environ["GAIN"], flush=True)
        before = Path("flaky_was_here")
        if not before.exists():
            before.touch()
            raise ConnectionRefusedError("no device")

    def update(self, lock):
        lock[self.count] = 1


class Once(Actor):
    count = Write(ONLINE, Entities("once/*"), Aspect("count_of_once", int))

    def update(self, lock):
        lock[self.count] = 1
"""
ACTORS = """
[actors.camera-3]
class = "rig:Camera"
process = "rig"

[actors.subtraction-3]
class = "rig:Subtraction"
process = "rig"
drain_s = 3

[actors.flaky]
class = "rig:Flaky"
process = "rig"
env = { GAIN = "0.5" }
"""


@pytest.fixture
def rig(tmp_path, write_cell):
    """The file of a cell with three actors in one process."""
    (tmp_path / "rig.py").write_text(MODULE, encoding="utf-8")
    return write_cell(ACTORS)


def running(enact, file):
    """Return pid and session of the actors that run, by name."""
    infos = enact("actor", "ls", "--json", "--cell", file).json
    return {info["actor"]: (info["pid"], info["session"]) for info in infos if info["pid"]}


@pytest.mark.slow
def test_actors_of_one_process_fail_restart_and_end_alone(rig, spawn, until, enact):
    """One process, three sessions; what becomes of one leaves the others running."""
    up = spawn("up", rig)
    lines = until(up, "gain 0.5")
    lines += until(up, "gain 0.5")  # its first start fails; the others serve meanwhile
    lines += until(up, "ready: actor flaky")
    text = "".join(lines)
    assert "3 actors in 1 processes" in text
    assert "start of actor flaky failed: ConnectionRefusedError" in text
    assert "actor flaky failed; started again in" in text
    assert text.count("ready: actor camera-3") == text.count("ready: actor subtraction-3") == 1

    first = running(enact, rig)
    assert set(first) == {"camera-3", "subtraction-3", "flaky"}
    pids, sessions = zip(*first.values(), strict=True)
    assert (len(set(pids)), len(set(sessions))) == (1, 3)

    assert enact("actor", "set", "camera-3", "step=5", "--cell", rig).status == 0
    shown = enact("actor", "ls", "--cell", rig).out
    assert "camera-3: step=5" in shown
    why = enact("why", "online", "camera/3/double_number", "--cell", rig).out
    assert "subtraction-3" in why
    assert "camera-3" in why
    picture = rig.with_name("rig.svg")
    assert enact("actor", "check", "--cell", rig, "--graph", picture).status == 0
    assert "/s</text>" in picture.read_text(encoding="utf-8")  # rates, as the cell runs

    again = enact("actor", "restart", "camera-3", "--cell", rig)
    assert again.status == 0, again
    after = running(enact, rig)
    assert after["camera-3"][0] == pids[0]
    assert after["camera-3"][1] != first["camera-3"][1]
    assert {name: after[name] for name in ("subtraction-3", "flaky")} == {
        name: first[name] for name in ("subtraction-3", "flaky")
    }
    assert "camera-3: step=1" in enact("actor", "ls", "--cell", rig).out

    os.kill(pids[0], signal.SIGKILL)
    until(up, "ended by SIGKILL; started again")
    for _ in range(3):
        until(up, "ready: actor")
    up.send_signal(signal.SIGTERM)
    rest = up.stdout.read()
    assert up.wait(60) == 0
    assert rest.count("stopped: actor") == 3
    assert "killed" not in rest


def test_some_actors_of_a_process_are_chosen_and_run_by_hand(rig, spawn, until, enact):
    """The name of the process stands for all of them; `actor run` takes several names."""
    up = spawn("up", rig, "--without", "rig")
    lines = until(up, "ready: shard") + until(up, "ready: shard")
    assert "2 shards, 0 actors" in "".join(lines)

    pair = spawn("actor", "run", "camera-3", "subtraction-3", "--cell", rig, "--log", "json")
    until(pair, "ready: actor")
    until(pair, "ready: actor")
    listed = running(enact, rig)
    assert {pid for pid, _ in listed.values()} == {pair.pid}
    assert set(listed) == {"camera-3", "subtraction-3"}
    pair.send_signal(signal.SIGTERM)
    ends = pair.stdout.read()
    assert pair.wait(60) == 0
    assert ends.count('"event": "actor.end"') == 2
    assert '"process": "actor camera-3"' in ends


def test_process_whose_actors_are_done_ends(rig, spawn, until):
    """Each once; with the status of one that is done."""
    names = ("first", "second")
    with rig.open("a") as file:
        for name in names:
            file.write(f'\n[actors.{name}]\nclass = "rig:Once"\nprocess = "once"\n')
            file.write(f'entity = "once/{name}"\n')
    up = spawn("up", rig, "--only", "left", "right", "once")
    rest = "".join(until(up, "once  | done; it is not started again"))
    for name in names:
        assert f"actor {name} is done; it is not started again" in rest


@pytest.mark.slow
def test_module_that_sets_a_variable_does_not_make_the_process_begin_for_ever(rig, spawn, until):
    """As OpenCV sets LD_LIBRARY_PATH when it is loaded, which another actor's `env` gives, too."""
    source = rig.with_name("rig.py")
    setting = "with open('begins', 'a') as file:\n    print(file=file)\n"
    setting += "if len(open('begins').readlines()) > 3:\n    os._exit(9)\n"
    source.write_text(f"{MODULE}\n{setting}os.environ['GAIN'] += '/own'\n", encoding="utf-8")
    with rig.open("a") as file:
        for name in ("first", "second"):
            file.write(f'\n[actors.{name}]\nclass = "rig:Once"\nprocess = "once"\n')
            file.write(f'entity = "once/{name}"\nenv = {{ GAIN = "2" }}\n')

    once = spawn("actor", "run", "--process", "once", "--cell", rig, "--timeout", "1")

    until(once, "actor first failed")  # it finds no shard


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["camera-3", "camera-3"], "actor camera-3 is named twice"),
        (["camera-3", "flaky", "--every", "1"], "--every belongs to one actor"),
        (["camera-3", "flaky", "--name", "x"], "--name belongs to one actor"),
        (["camera-3", "rig:Once"], "rig:Once runs in a process of its own"),
        (["camera-3", "--process", "rig"], "not both"),
        (["--process", "rigg"], "has no process 'rigg'; did you mean 'rig'? (known: rig)"),
        ([], "name an actor of cell.toml, MODULE:CLASS, or --process NAME"),
        (["camera-3", "once", "flaky"], "GAIN to '0.5' for flaky and to '2' for another"),
    ],
)
def test_wrong_choice_of_actors_is_refused_in_one_line(rig, enact, words, said):
    """Before anything of them runs."""
    with rig.open("a") as file:
        file.write('\n[actors.once]\nclass = "rig:Once"\nenv = { GAIN = "2" }\n')
    if "once" in words:
        words = ["camera-3", "flaky", "once"]

    done = enact("actor", "run", *words, "--cell", rig)

    assert done.status == 2
    assert said in done.err
    assert len(done.err.splitlines()) == 1
