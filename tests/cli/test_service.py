"""`enact shard run` and `actor run` as services: sd_notify, JSON logs and the drain."""

import contextlib
import json
import signal
import socket
import subprocess
import threading

import pytest

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.cli.main import main
from enact_dist.errors import EnactError, LockTimeoutError
from enact_dist.link.client import locks as link_client
from enact_dist.operate import supervise

COUNT = Aspect("count", int)
ACTOR = """\
import threading
from enact_dist import Actor, Aspect, Entity, World, Write

class Beat(Actor):
    online = World("online")
    count = Write(online, Entity("beat"), Aspect("beats", int))
    every_s = 3600.0

    def update(self, lock):
        raise ValueError("told in one line")

class Hang(Beat):
    def update(self, lock):
        print("hangs", flush=True)
        threading.Event().wait()
"""


@pytest.fixture
def manager(tmp_path):
    """The socket of a service manager."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as heard:
        heard.bind(str(tmp_path / "notify"))
        heard.settimeout(20.0)
        yield heard


@pytest.fixture
def watched(manager):
    """The environment of a service with a watchdog of 0.3 s."""
    return {"NOTIFY_SOCKET": manager.getsockname(), "WATCHDOG_USEC": "300000"}


def hear(manager, mark):
    """Return what the manager is told, up to a message with `mark`."""
    heard = []
    while not any(mark in line for line in heard):
        heard += manager.recv(4096).decode().splitlines()
    return heard


def test_shard_tells_its_service_manager_how_it_is(write_cell, spawn, manager, watched):
    """Ready once it serves, then signs of life, then that it ends."""
    shard = spawn("shard", "run", "left", "--cell", write_cell(), env=watched)

    start = hear(manager, "WATCHDOG=1")
    shard.send_signal(signal.SIGTERM)
    end = hear(manager, "STOPPING=1")

    assert "READY=1" in start + end
    assert f"MAINPID={shard.pid}" in start + end
    assert "STATUS=open" in start + end
    assert shard.wait(60) == 0


def test_actor_pings_while_it_waits(tmp_path, cell_file, spawn, manager, watched):
    """A source's pause of an hour is no hang."""
    (tmp_path / "my_actors.py").write_text(ACTOR, encoding="utf-8")
    spawn("actor", "run", "my_actors:Beat", "--cell", cell_file, env=watched)
    assert "READY=1" in hear(manager, "READY=1")
    for _ in range(3):
        hear(manager, "WATCHDOG=1")


def test_actor_whose_update_hangs_is_silent(tmp_path, cell_file, spawn, manager, watched, until):
    """Then the service manager ends it and starts it anew."""
    (tmp_path / "my_actors.py").write_text(ACTOR, encoding="utf-8")
    until(spawn("actor", "run", "my_actors:Hang", "--cell", cell_file, env=watched), "hangs")
    manager.settimeout(1.0)

    with pytest.raises(TimeoutError):
        for _ in range(30):  # what was sent before it hung
            manager.recv(4096)


PINNED = '[[pins]]\nentities = "**"\nshard = "left"\n'


def test_drain_lets_holders_finish_and_grants_nothing_new(write_cell, spawn, until, enact):
    """The holder's commit counts, the shard leaves right after it, and nobody else gets a lock."""
    file = write_cell(PINNED)
    shard = spawn("shard", "run", "left", "--cell", file, "--drain", "60", "--log", "json")
    until(shard, "ready: shard")
    with connect(file, actor="holder") as cell:
        piece = Write(cell.world("online"), Entity("piece"), COUNT)
        other = Write(cell.world("online"), Entity("other"), COUNT)
        with Lock(piece) as lock:
            shard.send_signal(signal.SIGTERM)
            until(shard, '"shard.stop"')
            checked = enact("shard", "check", "left", "--cell", file)
            alive = enact("shard", "check", "left", "--cell", file, "--alive")
            in_vain = threading.Thread(target=refused, args=(other,))
            in_vain.start()
            in_vain.join()
            lock[piece] = 7
        assert lock.position is not None
        status = shard.wait(60)

    assert (checked.status, alive.status, status) == (1, 0, 0)
    assert "drains" in checked.out


def refused(write):
    """Ask for a lock that is free; nobody may be given one any more."""
    with pytest.raises(LockTimeoutError), Lock(write, wait_s=0.3):
        pass


def test_second_signal_ends_the_drain_and_the_holder_is_named(
    write_cell, spawn, until, monkeypatch
):
    """Whoever cannot wait says it twice; the log says who paid, in a line for programs."""
    monkeypatch.setattr(link_client, "FINISH_S", 1.0)
    file = write_cell(PINNED)
    shard = spawn("shard", "run", "left", "--cell", file, "--drain", "60", "--log", "json")
    until(shard, "ready: shard")
    with connect(file, actor="slow") as cell, pytest.raises(EnactError):
        piece = Write(cell.world("online"), Entity("piece"), COUNT)
        with Lock(piece, wait_s=5.0) as lock:
            shard.send_signal(signal.SIGTERM)
            until(shard, '"shard.stop"')
            while shard.poll() is None:  # those of the first second belong to the first one
                shard.send_signal(signal.SIGTERM)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    shard.wait(0.2)
            lines = [json.loads(line) for line in shard.stdout]
            lock[piece] = 7

    (line,) = [line for line in lines if line["event"] == "shard.drain_over"]
    assert shard.wait(60) == 0
    assert set(line) == {"time", "level", "logger", "event", "text", "cell", "process"}
    assert (line["level"], line["cell"], line["process"]) == ("WARNING", "clitest", "shard left")
    assert "slow@" in line["text"]
    assert "online:piece/count" in line["text"]


def test_up_drains_a_shard_as_its_table_says(write_cell, spawn, until):
    """The log names the holder and each place where a longer drain can be said."""
    file = write_cell(PINNED)
    file.write_text(file.read_text().replace("[shards.right]", "drain_s = 0\n[shards.right]"))
    up = spawn("up", file, "--no-actors")
    for _ in range(2):
        until(up, "ready: shard")
    with connect(file, actor="slow") as cell, pytest.raises(EnactError):
        piece = Write(cell.world("online"), Entity("piece"), COUNT)
        with Lock(piece, wait_s=5.0) as lock:
            up.send_signal(signal.SIGTERM)
            said = "".join(until(up, "down"))
            lock[piece] = 7

    assert "still held when the drain of 0 s ended: slow@" in said
    assert "--drain, ENACT_SHARD_<NAME>_DRAIN_S, or drain_s in [shards.left]" in said


def test_drain_of_the_command_wins_over_that_of_the_file(write_cell, spawn, until):
    """A unit or a compose file can say its own, as it says how long it waits."""
    file = write_cell(PINNED)
    file.write_text(file.read_text().replace("[shards.right]", "drain_s = 0\n[shards.right]"))
    shard = spawn("shard", "run", "left", "--cell", file, "--drain", "60", "--log", "json")
    until(shard, "ready: shard")
    with connect(file, actor="holder") as cell:
        piece = Write(cell.world("online"), Entity("piece"), COUNT)
        with Lock(piece) as lock:
            shard.send_signal(signal.SIGTERM)
            until(shard, '"shard.stop"')
            lock[piece] = 7
        assert lock.position is not None
    assert "shard.drain_over" not in shard.stdout.read()


def test_up_waits_longer_for_a_shard_than_that_drains(write_cell, enact, monkeypatch):
    """Else it would kill a shard whose holders still have their time."""
    found = {}

    class Supervisor:
        def __init__(self, tasks, _say):
            found.update({task.name: task.end_s for task in tasks})

        def run(self, _stop, **_):
            return 0

    monkeypatch.setattr(supervise, "Supervisor", Supervisor)
    monkeypatch.setenv("ENACT_SHARD_RIGHT_DRAIN_S", "30")
    file = write_cell()
    file.write_text(file.read_text().replace("[shards.right]", "drain_s = 60\n[shards.right]"))

    assert enact("up", file, "--no-actors").status == 0
    assert found["left"] > 60.0
    assert found["right"] > 30.0


def test_log_of_an_actor_is_json_with_its_traceback(tmp_path, cell_file, spawn):
    """A program that collects logs gets one object per error, not twenty lines."""
    (tmp_path / "my_actors.py").write_text(ACTOR.replace("3600.0", "0.01"), encoding="utf-8")
    actor = spawn("actor", "run", "my_actors:Beat", "--cell", cell_file, "--log", "json",
                  "--name", "heart", stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)  # fmt: skip
    with actor.stderr as lines:
        line = json.loads(next(lines))

    assert (line["level"], line["logger"], line["cell"]) == ("ERROR", "enact.actor", "clitest")
    assert line["process"] == "actor heart"
    assert line["error"].splitlines()[-1] == "ValueError: told in one line"


def test_all_that_a_shard_and_an_actor_say_is_json(tmp_path, write_cell, spawn, until):
    """From the start to the drain, on both outputs; what tells of them says it in fields, too."""
    (tmp_path / "my_actors.py").write_text(ACTOR, encoding="utf-8")
    file = write_cell(PINNED)
    shard = spawn("shard", "run", "left", "--cell", file, "--log", "json")
    said = until(shard, "ready: shard left of cell clitest")
    actor = spawn("actor", "run", "my_actors:Beat", "--cell", file, "--log", "json")
    told = until(actor, "told in one line")
    for process, lines in ((actor, told), (shard, said)):
        process.send_signal(signal.SIGTERM)
        lines += list(process.stdout)

    of_shard, of_actor = ([json.loads(line) for line in lines] for lines in (said, told))
    (served,) = [line for line in of_shard if line["event"] == "shard.ready"]
    (ended,) = [line for line in of_actor if line["event"] == "actor.end"]
    assert "shard.stop" in {line["event"] for line in of_shard}
    assert served["text"].endswith(f"epoch {served['epoch']}, data in {served['folder']}")
    assert len(served["endpoints"]) == 1
    assert of_actor[0]["event"] == "actor.ready"
    assert {line["process"] for line in of_actor} == {"actor Beat"}
    assert (ended["state"], ended["updates"]) == ("stopped", 0)
    assert ended["failures"] > 0


def test_actor_that_cannot_start_says_so_in_json(tmp_path, write_cell, spawn):
    """What a service manager starts again and again writes one object each time."""
    (tmp_path / "my_actors.py").write_text(ACTOR, encoding="utf-8")
    words = ("my_actors:Beat", "--cell", write_cell(), "--timeout", "0.1", "--name", "heart")
    actor = spawn("actor", "run", *words, "--log", "json")

    (line,) = [json.loads(line) for line in actor.stdout]
    assert actor.wait(60) == 3
    assert (line["event"], line["level"]) == ("actor.refused", "CRITICAL")
    assert line["process"] == "actor heart"


def test_up_makes_json_of_every_line(write_cell, spawn, until):
    """Also of the lines that its children print for people; each says which process it is from."""
    up = spawn("up", write_cell(), "--no-actors", "--log", "json")
    lines = until(up, "ready: shard") + until(up, "ready: shard")  # either may be the first
    up.send_signal(signal.SIGTERM)
    lines += list(up.stdout)

    found = [json.loads(line) for line in lines]
    assert {"up", "shard left", "shard right"} == {line["process"] for line in found}
    assert {line["cell"] for line in found} == {"clitest"}
    assert {"shard.ready", "shard.stop"} <= {line["event"] for line in found}


def test_metrics_are_served_where_the_file_or_the_command_says(write_cell, spawn, until, enact):
    """`metrics` of cell.toml is the default, `--metrics` wins; a port alone is of the loopback."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    file = write_cell()
    file.write_text(file.read_text().replace("[shards.right]", 'metrics = "1"\n[shards.right]'))
    shard = spawn("shard", "run", "left", "--cell", file, "--metrics", str(port))
    until(shard, "ready: shard")

    with socket.create_connection(("127.0.0.1", port)) as line:
        line.sendall(b"GET /metrics HTTP/1.0\r\n\r\n")
        text = line.makefile().read()

    assert 'enact_ready{cell="clitest",shard="left"} 1' in text.splitlines()


def test_metrics_at_no_address_are_a_usage_error(enact, write_cell, monkeypatch):
    """On the command line, in the file and in the environment, each named as what it is."""
    file = write_cell()
    monkeypatch.setenv("ENACT_SHARD_LEFT_METRICS", "anywhere")
    in_environment = enact("shard", "run", "left", "--cell", file)
    monkeypatch.delenv("ENACT_SHARD_LEFT_METRICS")
    file.write_text(file.read_text().replace("[shards.right]", 'metrics = ":0"\n[shards.right]'))
    in_file = enact("shard", "run", "left", "--cell", file)

    assert (in_environment.status, in_file.status) == (2, 2)
    assert "ENACT_SHARD_LEFT_METRICS: 'anywhere' is no address" in in_environment.err
    assert "line 9: ':0' is no address for metrics" in in_file.err


@pytest.mark.parametrize("option", ["--listen", "--advertise", "--metrics"])
def test_option_that_is_wrong_is_named_and_no_variable(option, write_cell, capsys):
    """Nobody has set ENACT_SHARD_LEFT_…, so nobody is sent to look for it."""
    with pytest.raises(SystemExit) as ended:
        main(["shard", "run", "left", "--cell", str(write_cell()), option, "nonsense"])
    said = capsys.readouterr().err

    assert ended.value.code == 2
    assert f"argument {option}: 'nonsense' is no " in said
    assert "ENACT_" not in said
