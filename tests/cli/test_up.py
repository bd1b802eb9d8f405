"""`enact up`: what it starts on this machine, what it leaves out, and what it refuses to start."""

import sys

import pytest
from ports import free_port

ACTORS = """
import os
import sys
from enact_dist import Actor, Aspect, Entity, World, Write

class Beat(Actor):
    '''Says what it was given.'''
    online = World("online")
    count = Write(online, Entity("beat"), Aspect("count", int))
    every_s = 0.05
    step: int = 1
    label: str = "none"

    def __init__(self, first: int = 0) -> None:
        self.first = first

    def update(self, lock):
        if not lock.get(self.count, 0):
            print("given", self.first, self.step, self.label, os.environ.get("GAIN"), flush=True)
        lock[self.count] = lock.get(self.count, self.first) + self.step
"""
ARGS = """
[actors.beat]
class = "beside_actors:Beat"
args = { first = 7, step = 2, label = "front" }
env = { GAIN = "0.5" }
"""


@pytest.fixture
def beside(tmp_path, write_cell):
    """A cell.toml with a module beside it, and another folder to work in."""
    (tmp_path / "cells").mkdir()
    (tmp_path / "cells" / "beside_actors.py").write_text(ACTORS)

    def write(more=""):
        file = write_cell(more)
        return file.rename(tmp_path / "cells" / "cell.toml")

    return write


def own_host(file, name, more):
    """Give a shard of a cell.toml further lines."""
    text = file.read_text()
    file.write_text(text.replace(f"[shards.{name}]\n", f"[shards.{name}]\n{more}\n"))


def test_shard_without_a_host_in_a_cell_of_two_machines_is_refused(enact, write_cell):
    """Each `enact up` would start it: the one that has none must get one."""
    file = write_cell()
    own_host(file, "right", 'host = "tray-pc"')

    done = enact("up", file, "--host", "robot-pc")

    assert done.status == 2
    assert "[shards.left]" in done.err
    assert 'host = "robot-pc"' in done.err


def test_shard_that_runs_on_another_machine_is_not_started_again(spawn, until, enact, write_cell):
    """It is asked for where others reach it, and the error says what to write."""
    file = write_cell()
    first = spawn("up", file, "--no-actors")
    for _ in range(2):
        until(first, "ready: shard")
    reached = next(line for line in file.read_text().splitlines() if "listen" in line)
    here = f'listen = "tcp/0.0.0.0:{free_port()}"\nadvertise{reached.removeprefix("listen")}'
    file.write_text(file.read_text().replace(reached, here, 1))

    done = enact("up", file, "--only", "left")

    assert done.status == 1
    assert "shard left" in done.err
    assert "[shards.left]" in done.err
    assert "host" in done.err
    assert "ready:" not in done.out


def test_shard_that_listens_at_another_machine_is_refused_by_host(enact, write_cell):
    """An address that is none of this machine's, and no `host` that would say whose it is."""
    file = write_cell()
    text = file.read_text().replace("127.0.0.1", "192.0.2.7", 1)
    file.write_text(text)

    done = enact("up", file)

    assert done.status == 2
    assert "192.0.2.7" in done.err
    assert "not an address of this machine" in done.err
    assert "`host` in [shards.left]" in done.err


def test_only_and_without_choose_shards_and_actors(enact, beside, spawn, until):
    """By name; a name that there is not is refused with those that there are."""
    file = beside(ARGS)
    for words in (("--only", "beats"), ("--without", "lefd")):
        done = enact("up", file, *words)
        assert done.status == 2, words
    assert "beat, left, right" in enact("up", file, "--only", "beats").err

    nothing = enact("up", file, "--only", "beat", "--without", "beat")
    assert (nothing.status, "--only beat --without beat leaves nothing" in nothing.err) == (2, True)

    up = spawn("up", file, "--only", "left", "right", "--without", "right")
    lines = until(up, "ready: shard left")
    assert any("up: cell clitest" in line and "1 shards, 0 actors" in line for line in lines)


def test_actor_gets_its_arguments_and_environment_from_the_file(beside, spawn, until):
    """From a module beside the file, in another working folder: by `up`, and run alone."""
    file = beside(ARGS)
    up = spawn("up", file)
    assert "given 7 2 front 0.5" in until(up, "given")[-1]
    alone = spawn("actor", "run", "beat", "--cell", file, "--name", "alone", "--every", "0.01")
    lines = until(alone, "ready: actor alone")
    assert not any("Traceback" in line for line in lines)


def test_environment_of_an_actor_that_is_run_alone(beside, spawn, until):
    """It stands before its first import: the process begins anew with it, once."""
    file = beside(ARGS)
    up = spawn("up", file, "--no-actors")
    for _ in range(2):
        until(up, "ready: shard")
    alone = spawn("actor", "run", "beat", "--cell", file)
    assert "given 7 2 front 0.5" in until(alone, "given")[-1]


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (
            "args = { stp = 2 }",
            r"has no option 'stp'; it has first, step, label; did you mean 'step'?",
        ),
        (
            'args = { step = "two" }',
            "option step of actor Beat is 'two'; it must be a whole number",
        ),
        ("args = { first = 1 }\noptions = { first = 2 }", "'first' stands in args and in options"),
        ("env = { GAIN = 5 }", "'GAIN' in [actors.beat.env] is a string, not an integer (5)"),
        ('env = { "A-B" = "5" }', "'A-B' is no name of a variable"),
        ("args = { every_s = 1.0 }", "has no option 'every_s'"),
    ],
)
def test_wrong_arguments_are_found_by_check(enact, beside, monkeypatch, lines, said):
    """With the name of what there is, before anything runs."""
    monkeypatch.setattr("sys.path", list(sys.path))
    monkeypatch.delitem(sys.modules, "beside_actors", raising=False)
    file = beside(f'[actors.beat]\nclass = "beside_actors:Beat"\n{lines}\n')

    done = enact("actor", "check", "--cell", file)

    assert done.status in (1, 2)
    assert said in done.out + done.err


def test_module_beside_the_file_wins_over_the_working_folder(enact, beside, tmp_path, monkeypatch):
    """A cell means the same program from wherever it is started."""
    monkeypatch.setattr("sys.path", list(sys.path))
    monkeypatch.delitem(sys.modules, "beside_actors", raising=False)
    (tmp_path / "beside_actors.py").write_text("raise SystemExit('the wrong one')")
    file = beside(ARGS)

    assert enact("actor", "check", "--cell", file).status == 0


def test_running_actor_is_told_other_values_and_to_begin_anew(enact, beside, spawn, until):
    """From anywhere, by its name; a wrong value is refused and changes nothing."""
    file = beside(ARGS)
    up = spawn("up", file)
    until(up, "ready: actor beat")

    told = enact("actor", "set", "beat", "step=3", "label=rear", "--cell", file)
    assert (told.status, "step = 3, label = rear" in told.out) == (0, True)
    assert "beat: step=3, label=rear, first=7" in enact("actor", "ls", "--cell", file).out
    for wrong, said in (
        ("step=three", "step of actor Beat is 'three'; it must be a whole number"),
        ("first=1", "first of actor Beat cannot be changed while it runs; these can: step"),
    ):
        refused = enact("actor", "set", "beat", "label=no", wrong, "--cell", file)
        assert refused.status == 1
        assert said in refused.err
    assert "step=3, label=rear" in enact("actor", "ls", "--cell", file).out
    assert "running: beat" in enact("actor", "set", "bead", "step=1", "--cell", file).err
    tree = enact("world", "tree", "online", "--cell", file, "--json").json
    assert [slot["entity"] for slot in tree if not slot.get("null_reason")] == ["beat"]

    again = enact("actor", "restart", "beat", "--cell", file)
    assert again.status == 0
    assert "actor beat restarted at" in again.out
    assert "beat: step=2, label=front, first=7" in enact("actor", "ls", "--cell", file).out
    assert enact("actor", "set", "beat", "step=4", "--cell", file).status == 0
    tree = enact("world", "tree", "online", "--cell", file, "--json").json
    slots = {slot["entity"] for slot in tree if slot["entity"].startswith("actor")}
    assert slots <= {"actor"}  # none for each session that there ever was
