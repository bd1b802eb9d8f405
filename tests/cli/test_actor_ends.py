"""What a person sees of an actor that hangs, leaves or cannot be imported, and how it ends."""

import contextlib
import re
import signal
import subprocess

import polling
import pytest

HUNG = """\
import sys
import threading

from enact_dist import Actor, Aspect, Entity, World, Write


class Hung(Actor):
    count = Write(World("online"), Entity("hung"), Aspect("count_of_hung", int))
    hold_s = 0.2

    def update(self, lock):
        print("updates", flush=True)
        threading.Event().wait()


class HungStart(Hung):
    def start(self):
        print("starts", flush=True)
        threading.Event().wait()


class Spins(Hung):
    every_s = 0.05

    def start(self):
        threading.Thread(target=threading.Event().wait, name="spins").start()

    def update(self, lock):
        lock[self.count] = 1


class SpinsAndFails(Spins):
    def start(self):
        super().start()
        raise OSError("no camera")


class Leaver(Hung):
    every_s = 0.05

    def update(self, lock):
        sys.exit("no arm")


class LeaverAtStart(Hung):
    def start(self):
        sys.exit(3)
"""
AWAY = """\
from enact_dist import Actor, Aspect, Entity, World, Write


class Camera(Actor):
    count = Write(World("online"), Entity("away"), Aspect("count_of_away", int))

    def METHOD(self):
        raise ConnectionRefusedError("no camera at 1.2.3.4")

    def OTHER(self):
        pass

    def update(self, lock):
        lock[self.count] = 1
"""
ARM = """\
from drivers import LIMITS


def unused():
    pass
"""
DRIVERS = """\
LIMITS = {"speed": 1 / 0}
"""
SLOW = """\
import threading

print("imports", flush=True)
threading.Event().wait()
"""
PATIENCE_S = 60.0


@pytest.fixture
def module(tmp_path):
    """Modules in the working folder, as a user would have them."""
    for name, text in (("hung", HUNG), ("arm", ARM), ("drivers", DRIVERS), ("slow", SLOW)):
        (tmp_path / f"{name}.py").write_text(text, encoding="utf-8")


def listed(enact, cell_file, mark):
    """Return the row of `actor ls` that has a mark, once there is one."""

    def rows():
        return enact("actor", "ls", "--cell", cell_file).out.splitlines()

    return polling.until(lambda: next((row for row in rows() if mark in row), ""), missed=rows)


def test_update_that_hangs_is_stuck_and_ends_with_its_process(
    module, spawn, until, cell_file, enact
):
    """`actor ls` says for how long and that its lock is lost; SIGTERM says what it cut off."""
    actor = spawn("actor", "run", "hung:Hung", "--cell", cell_file, "--drain", "0.3")
    until(actor, "ready: actor Hung")
    row = listed(enact, cell_file, "in update (lock lost)")
    (report,) = [
        one
        for info in enact("actor", "ls", "--json", "--cell", cell_file).json
        if info["pid"] == actor.pid
        for one in info["report"]["actors"]
    ]
    actor.send_signal(signal.SIGTERM)
    rest = actor.stdout.read()

    assert row.startswith("Hung")
    assert "stuck for " in row
    assert report["state"] == "stuck"
    assert report["updating_s"] > 0.2
    assert report["lock_lost"] is True
    assert actor.wait(60) == 1
    assert "cut off: actor Hung did not end within 0.3 s of SIGTERM: " in rest
    assert "in update (lock lost), at hung.py:13 (update); nothing of it was written" in rest


def test_second_signal_cuts_off_at_once(module, spawn, until, cell_file):
    """Whoever presses Ctrl-C twice does not wait for the drain."""
    actor = spawn("actor", "run", "hung:HungStart", "--cell", cell_file, "--drain", "3600")
    until(actor, "starts")
    actor.send_signal(signal.SIGINT)
    until(
        actor, "finishes its current call and ends, within 3600 s; a second signal ends it at once"
    )
    while actor.poll() is None:  # those of the first second belong to the first one
        actor.send_signal(signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            actor.wait(0.2)
    rest = actor.stdout.read()

    assert actor.wait(60) == 1
    assert "cut off: actor HungStart received a second signal" in rest
    assert re.search(r"in start, at hung\.py:1[89] \(start\)", rest)  # it may still print


def test_drain_of_the_cell_file_is_taken(module, spawn, until, tmp_path, cell_file):
    """As a shard's, it stands in the actor's table."""
    file = tmp_path / "drained.toml"
    table = '\n[actors.hung]\nclass = "hung:Hung"\ndrain_s = 0.1\n'
    file.write_text(cell_file.read_text(encoding="utf-8") + table, encoding="utf-8")
    actor = spawn("actor", "run", "hung", "--cell", file)
    until(actor, "updates")
    actor.send_signal(signal.SIGTERM)

    assert "did not end within 0.1 s of SIGTERM" in actor.stdout.read()
    assert actor.wait(60) == 1


def test_actor_that_calls_sys_exit_is_not_silent(module, spawn, until, cell_file):
    """In an update it is a failure with its place, and the actor goes on; in `start` its end."""
    actor = spawn("actor", "run", "hung:Leaver", "--cell", cell_file)
    until(actor, "Leaver.update called sys.exit('no arm') at hung.py:42; raise an exception")
    actor.send_signal(signal.SIGTERM)
    rest = actor.stdout.read()
    start = spawn("actor", "run", "hung:LeaverAtStart", "--cell", cell_file)

    assert actor.wait(60) == 0
    assert "stopped: actor Leaver after 0 updates" in rest
    assert start.wait(60) == 1
    assert "LeaverAtStart.start called sys.exit(3) at hung.py:47" in start.stdout.read()


@pytest.mark.parametrize(("target", "number"), [("Spins", signal.SIGTERM), ("SpinsAndFails", 0)])
def test_thread_that_an_actor_has_started_does_not_keep_its_process(
    target, number, module, spawn, until, cell_file
):
    """`enact up` and systemd start a process again only once it has ended."""
    actor = spawn("actor", "run", f"hung:{target}", "--cell", cell_file, "--drain", "0.2")
    if number:
        until(actor, "ready: actor")
        actor.send_signal(number)
    rest = actor.stdout.read()

    assert actor.wait(60) == 1
    assert ("start of actor SpinsAndFails failed" if not number else "stopped: actor") in rest
    assert "did not end within 0.2 s of its actors, as threads of theirs still run: spins" in rest


@pytest.mark.parametrize(("method", "does"), [("start", "stop"), ("stop", "start")])
def test_a_device_that_is_away_is_an_error_with_its_place(enact, tmp_path, cell_file, method, does):
    """One line: which actor, what went wrong, and where in the user's own code."""
    text = AWAY.replace("METHOD", method).replace("OTHER", does)
    (tmp_path / f"away_{method}.py").write_text(text, encoding="utf-8")

    ended = enact("actor", "run", f"away_{method}:Camera", "--cell", cell_file)

    assert ended.status == 1
    assert ended.err.splitlines()[-1] == (
        f"enact: {method} of actor Camera failed: ConnectionRefusedError at away_{method}.py:8:"
        " no camera at 1.2.3.4"
    )


def test_module_that_fails_to_import_shows_the_lines_of_its_own(module, enact, cell_file):
    """Those of its user, and none of what has imported it."""
    result = enact("actor", "run", "arm:Arm", "--cell", cell_file)

    assert result.status == 2
    assert result.err.splitlines() == [
        '  File "arm.py", line 1, in <module>',
        "    from drivers import LIMITS",
        '  File "drivers.py", line 1, in <module>',
        '    LIMITS = {"speed": 1 / 0}',
        "enact: arm of actor 'arm:Arm' cannot be imported: ZeroDivisionError: division by zero",
    ]


def test_interrupted_import_ends_without_a_traceback(module, spawn, until, cell_file):
    """Ctrl-C while a module is imported ends the command as it does elsewhere."""
    actor = spawn("actor", "run", "slow:Slow", "--cell", cell_file)
    until(actor, "imports")
    actor.send_signal(signal.SIGINT)

    assert actor.wait(60) == 130
    assert actor.stdout.read() == ""
