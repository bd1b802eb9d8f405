"""`enact actor` and `enact up`: real actors in processes of their own."""

import signal

import pytest

from enact_dist.cli import up
from enact_dist.config.read import load_config
from enact_dist.errors import LinkError
from enact_dist.link.daemon import second_daemon
from enact_dist.link.zenoh import endpoints
from enact_dist.operate import supervise

MODULE = """\
from enact_dist import Actor, Aspect, Entity, Entities, View, World, Write

COUNT = Aspect("count", int)
TWICE = Aspect("twice", int)


class Beat(Actor):
    online = World("online")
    count = Write(online, Entity("beat"), COUNT)
    every_s = 0.05

    def __init__(self, step: int = 1) -> None:
        self.step = step

    def update(self, lock):
        lock[self.count] = lock.get(self.count, 0) + self.step


class Double(Actor):
    online = World("online")
    seen = View(online, Entities("beat"), COUNT)
    twice = Write(online, Entities("beat"), TWICE)
    triggers = (seen,)

    def update(self, lock):
        lock[self.twice] = 2 * lock[self.seen]


class Rival(Beat):
    pass


class Camera(Actor):
    count = Write(World("online"), Entities("camera/*"), Aspect("count_of_camera", int))
    every_s = 0.05

    def update(self, lock):
        lock[self.count] = lock.get(self.count, 0) + 1


class Own(Camera):
    only_entity = Entity("camera/1")


class Broken(Actor):
    online = World("online")
    count = Write(online, Entity("broken"), COUNT)

    def update(self, lock):
        raise RuntimeError("no light")
"""

ACTORS = """
[actors.beat]
class = "my_actors:Beat"
worlds = { online = "online" }
options = { step = 5 }
every_s = 0.1

[actors.double]
class = "my_actors:Double"
worlds = { online = "online" }
"""


CAMERAS = """
[actors.camera-0]
class = "my_actors:Camera"
entity = "camera/0"

[actors.camera-1]
class = "my_actors:Camera"
entity = "camera/1"
"""


@pytest.fixture
def module(tmp_path):
    """The actors' module in the working folder, as a user would have it."""
    (tmp_path / "my_actors.py").write_text(MODULE, encoding="utf-8")


def test_run_takes_options_and_roles_from_the_command_line(module, spawn, until, cell_file, enact):
    """A running actor is listed with what it reports, and ends with status 0 on SIGTERM."""
    actor = spawn("actor", "run", "my_actors:Beat", "--cell", cell_file, "--world",
                  "online=training", "--option", "step=100", "--name", "heart")  # fmt: skip
    until(actor, "ready: actor heart in cell clitest")
    watch = enact("world", "watch", "training", "--aspect", "count", "--count", "3",
                  "--cell", cell_file)  # fmt: skip
    value = enact("world", "get", "training", "beat/count", "--json", "--cell", cell_file).json
    listed = {
        info["actor"]: info for info in enact("actor", "ls", "--json", "--cell", cell_file).json
    }
    table = enact("actor", "ls", "--cell", cell_file).out
    actor.send_signal(signal.SIGTERM)
    rest = actor.stdout.read()

    assert watch.status == 0
    assert value % 100 == 0
    assert listed["heart"]["pid"] == actor.pid
    assert "heart" in table
    assert actor.wait(60) == 0
    assert "stopped: actor heart after" in rest


def test_an_actor_of_another_host_with_the_number_of_this_process_is_listed(
    module, spawn, until, cell_file, enact, monkeypatch
):
    """In containers most processes have the same few numbers."""
    words = ("my_actors:Beat", "--world", "online=training")
    actor = spawn("actor", "run", *words, "--cell", cell_file)
    until(actor, "ready: actor Beat")
    monkeypatch.setattr("enact_dist.link.zenoh.config._used_in", set())  # else this were a child
    monkeypatch.setattr("os.getpid", lambda: actor.pid)
    monkeypatch.setattr("socket.gethostname", lambda: "another")

    listed = enact("actor", "ls", "--json", "--cell", cell_file).json

    assert [(info["actor"], info["pid"]) for info in listed] == [("Beat", actor.pid)]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("my_actors:Beta",), "Beat"),
        (("no_such_module:Beat",), "no module no_such_module"),
        (("my_actors:Beat", "--option", "stp=1"), "no option 'stp'"),
        (("my_actors:Beat", "--option", "step=fast"), "must be a whole number"),
        (
            ("my_actors:Beat", "--option", "step=1", "--option", "step=2"),
            "--option step is given twice",
        ),
        (("heart",), "has no actor 'heart' (known: none)"),
    ],
)
def test_run_refuses_a_wrong_command_line(module, enact, cell_file, words, reason):
    """What names no actor or option is status 2 before anything is joined."""
    result = enact("actor", "run", *words, "--cell", cell_file)

    assert result.status == 2
    assert reason in result.err


def test_run_refuses_an_unknown_role(module, enact, cell_file):
    """A role that the class does not have is named; the same command would fail the same way."""
    result = enact(
        "actor", "run", "my_actors:Beat", "--world", "offline=online", "--cell", cell_file
    )

    assert result.status == 2
    assert "offline" in result.err


def test_one_class_serves_several_entities(module, spawn, until, cell_file, tmp_path, enact):
    """Each writes its own: the one of the file, or the one that the command line names."""
    file = tmp_path / "cameras.toml"
    file.write_text(cell_file.read_text(encoding="utf-8") + CAMERAS, encoding="utf-8")
    first = spawn("actor", "run", "camera-1", "--cell", file)
    until(first, "ready: actor camera-1 in cell clitest")
    second = spawn("actor", "run", "my_actors:Camera", "--entity", "camera/7", "--cell", file)
    until(second, "ready: actor Camera-camera-7 in cell clitest")
    for number in (1, 7):
        one = ("online", f"camera/{number}", "--aspect", "count_of_camera", "--count", "2")
        assert enact("world", "watch", *one, "--cell", file).status == 0
    tree = enact("world", "tree", "online", "--cell", file).out

    assert tree.count("count_of_camera") == 2


def test_entity_that_is_missing_or_does_not_fit_is_refused(module, enact, write_cell):
    """By the run itself, and by the check before it, with what to do."""
    file = write_cell(CAMERAS + '\n[actors.lost]\nclass = "my_actors:Camera"\n')
    run = enact("actor", "run", "my_actors:Camera", "--cell", file)
    other = enact("actor", "run", "camera-0", "--entity", "tray/1", "--cell", file)
    check = enact("actor", "check", "--cell", file)

    assert (run.status, other.status) == (2, 2)
    assert "has no triggers and no only_entity" in run.err
    assert "which tray/1 does not match" in other.err
    assert check.status == 0
    assert "warning: entity unsaid: actor lost: Camera.count is " in check.out
    with pytest.raises(SystemExit) as ended:
        enact("actor", "run", "camera-0", "--entity", "camera/*", "--cell", file)
    assert ended.value.code == 2


def test_check_goes_by_the_entity_that_a_class_says(module, enact, write_cell):
    """It needs none in the file, and is told apart from the others."""
    own = '\n[actors.own]\nclass = "my_actors:Own"\n'
    alone = enact("actor", "check", "--cell", write_cell(own))
    both = enact("actor", "check", "--cell", write_cell(CAMERAS + own), "--json")

    assert alone.status == 0
    assert alone.out.splitlines()[-1] == "ok: 1 actors of cell clitest fit together"
    assert [(each["kind"], each["actors"]) for each in both.json] == [
        ("two writers", ["camera-1", "own"]),
        ("durable stream", ["camera-0"]),
    ]


def test_check_accepts_actors_that_fit(module, enact, write_cell):
    """Two actors that read and write past each other are fine; advice does not change that."""
    result = enact("actor", "check", "--cell", write_cell(ACTORS))
    said = '\n[aspects.count]\ndurability = "volatile"\n'
    quiet = enact("actor", "check", "--cell", write_cell(ACTORS + said))

    advice, ok = result.out.splitlines()
    assert advice.startswith("advice: durable stream: beat.count (Write online/beat count) may be")
    assert "10 times a second" in advice
    assert (result.status, ok) == (0, "ok: 2 actors of cell clitest fit together")
    assert (quiet.status, quiet.out) == (0, "ok: 2 actors of cell clitest fit together\n")


def test_check_reports_two_writers_with_status_1(module, enact, write_cell):
    """Two actors that write one slot are an error, also as JSON."""
    rival = '\n[actors.rival]\nclass = "my_actors:Rival"\nworlds = { online = "online" }\n'
    file = write_cell(ACTORS + rival)

    result = enact("actor", "check", "--cell", file, "--json")

    assert result.status == 1
    assert [finding["kind"] for finding in result.json if finding["level"] == "error"] == [
        "two writers"
    ]
    up = enact("up", file)
    assert up.status == 2
    assert "beat" in up.err


@pytest.mark.slow
def test_up_runs_the_cell_restarts_what_dies_and_drains_in_order(
    module, spawn, until, write_cell, enact
):
    """Shards, then actors; a killed actor comes back; a signal ends actors, then shards."""
    file = write_cell(ACTORS)
    up = spawn("up", file)
    lines = until(up, "ready: actor double")
    watch = enact("world", "watch", "online", "--aspect", "twice", "--count", "3", "--cell", file)
    listed = {
        info["actor"]: info["pid"] for info in enact("actor", "ls", "--json", "--cell", file).json
    }
    import os

    os.kill(listed["beat"], signal.SIGKILL)
    lines += until(up, "ended by SIGKILL; started again in 0.2 s")
    lines += until(up, "ready: actor beat")
    up.send_signal(signal.SIGINT)
    rest = up.stdout.read().splitlines()

    assert watch.status == 0
    assert up.wait(60) == 0
    assert lines[0].startswith("enact  | up: cell clitest on ")
    assert any(line.startswith("left   | ready: shard left") for line in lines)
    ends = [index for index, line in enumerate(rest) if "stopped: actor" in line]
    drained = [index for index, line in enumerate(rest) if "SIGTERM received" in line]
    assert len(ends) == 2
    assert max(ends) < min(drained)
    assert rest[-1] == "enact  | down"


def test_up_refuses_a_host_that_runs_nothing(enact, write_cell):
    """A host name without any shard or actor is a mistake."""
    pinned = (
        write_cell()
        .read_text()
        .replace("[shards.right]", '[shards.right]\nhost = "b"')
        .replace("[shards.left]", '[shards.left]\nhost = "a"')
    )
    write_cell().write_text(pinned, encoding="utf-8")

    result = enact("up", "--host", "c")

    assert result.status == 2
    assert "runs on host 'c'" in result.err


def test_second_up_of_a_cell_ends_with_what_is_wrong(spawn, until, write_cell, enact, monkeypatch):
    """It would start its shards for ever, each refused because the first one's runs."""
    file = write_cell()
    first = spawn("up", file, "--no-actors")
    for _ in range(2):
        until(first, "ready: shard")
    monkeypatch.setitem(supervise.END_S, "shard", 0.1)

    second = enact("up", file, "--no-actors")

    assert second.status == 1
    assert second.err.startswith("enact: shard left runs already; waiting up to ")
    assert "of cell clitest already runs at tcp/127.0.0.1:" in second.err
    assert "ready:" not in second.out


def test_up_waits_for_a_shard_that_is_just_ending(write_cell, monkeypatch):
    """A supervisor that was killed leaves its shards behind, which end by themselves."""
    config = load_config(write_cell())
    refusals = [LinkError("already runs"), LinkError("already runs")]

    def refuse(*_, **__):
        if refusals:
            raise refusals.pop()

    monkeypatch.setattr(endpoints, "somebody_listens", lambda _: True)
    monkeypatch.setattr(second_daemon, "refuse_second_daemon", refuse)

    up._refuse_second(config, config.shards[0])

    assert refusals == []
