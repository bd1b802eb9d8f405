"""The compose file with two hosts of a database and two daemons of each shard, by its one switch.

Daemons and hosts of the database fail while the cell trains and two clients count; no count is
wrong, and the verdicts are those of a run on one machine that had no fault.
"""

import json
import re

import pytest

pytest.importorskip("open3d", exc_type=ImportError)

from stack import PACKAGES, Stack, judged, until

pytestmark = [pytest.mark.containers, pytest.mark.sampled(1, of="profiles in containers")]

SWITCH = "deploy/compose.yaml:deploy/compose.survive.yaml"
DATABASE = ("db-a", "db-b")
SLOTS = {"left": "view/probe", "right": "place/probe"}
"""Entities of the shards that no actor of the cell knows."""

COUNTING = """
import json, sys, threading, time
from pathlib import Path
from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.errors import CommitUnknownError, EnactError

def count(shard, entity):
    write, end = Write(world, Entity(entity), count_of), Path("/tmp/end")
    found[shard] = mine = {"read": [], "done_s": [], "unknown": 0, "errors": []}
    world.init(Entity(entity), count_of, 0)
    while not end.exists():
        try:
            with Lock(write, wait_s=120.0) as lock:
                value = lock[write]
                lock[write] = value + 1
        except EnactError as error:
            mine["unknown"] += isinstance(error, CommitUnknownError)
            mine["errors"].append(str(error))
        else:
            mine["read"].append(value)
            mine["done_s"].append(time.time())
            Path("/tmp", shard).write_text(str(value))
            time.sleep(0.02)  # the load
    with Lock(write, wait_s=120.0) as lock:
        mine["last"] = lock[write]

found, count_of = {}, Aspect("count", int)
with connect("/cell/cell.toml", actor="counting") as cell:
    world = cell.world("training")
    threads = [threading.Thread(target=count, args=slot) for slot in json.loads(sys.argv[1]).items()]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
Path("/tmp/counted.new").write_text(json.dumps(found))
Path("/tmp/counted.new").rename("/tmp/counted")
"""


@pytest.fixture(scope="module")
def stack(engine, images, alone, tmp_path_factory):
    """The project, up, in training, still without its conveyor; two clients count in it."""
    with Stack(engine, "survive", tmp_path_factory.mktemp("survive"), COMPOSE_FILE=SWITCH) as stack:
        stack.compose("up", "--detach", "--scale", "conveyor=0")
        words = ("python", "-c", COUNTING, json.dumps(SLOTS))
        engine.docker("exec", "--detach", stack.name("feedback"), *words)
        goes_on(stack)
        yield stack


def goes_on(stack):
    """Return once the client of each shard has counted further than when this was called."""

    def counted():
        done = [noted(stack, shard) for shard in SLOTS]
        return all(done) and [int(text) for text in done]

    def further():
        return all(map(int.__gt__, counted(), before))

    before = until(counted, lambda: "the clients count")
    until(further, lambda: f"the clients count on from {before}: {counted()}")


def noted(stack, name):
    """Return what the clients have written into a file of theirs; nothing yet: an empty text."""
    done = stack.engine.docker("exec", stack.name("feedback"), "cat", f"/tmp/{name}", check=False)
    return "" if done.returncode else done.stdout


def findings(stack):
    """Return what `enact doctor` says on each subject, well or not, to one of the shards' hosts."""
    up = (one for one in ("shard-left", "shard-left-b") if stack.state(one)["Running"])
    done = stack.engine.docker(
        "exec", stack.name(next(up)), "enact", "doctor", "--json", check=False
    )
    return {one["subject"]: one["text"] for one in json.loads(done.stdout)}


def pair(stack, shard):
    """Return the services that serve a shard and stand by for it, once there are both."""

    def found():
        text = findings(stack).get(f"store of {shard}", "")
        return re.findall(r"served by (\S+) \d+; (\S+) \d+ stands by", text)

    ((serving, standby),) = until(found, lambda: findings(stack))
    return serving, standby


def await_copies(stack, said):
    """Return once `enact doctor` counts the copies of each commit so."""

    def copies():
        return findings(stack).get("copies of the store", "")

    until(lambda: copies().startswith(said), copies)


def primary(stack):
    """Return the hosts of the database: the one that takes writes, and the one that copies."""
    asked = ("exec", stack.name(DATABASE[0]), "patronictl", "list", "--format", "json")
    members = json.loads(stack.engine.docker(*asked).stdout)
    (leader,) = (one["Member"] for one in members if one["Role"] == "Leader")
    return sorted(DATABASE, key=lambda host: host != leader)


def test_two_daemons_of_each_shard_and_two_copies_are_there(stack):
    """As an operator sees it; an actor does not reach the database."""
    await_copies(stack, "two")
    for shard in SLOTS:
        assert set(pair(stack, shard)) == {f"shard-{shard}", f"shard-{shard}-b"}
    asked = "import socket; socket.create_connection(('db-a', 5432), 5)"
    assert stack.python("shard-left", asked) == ""
    refused = stack.docker("exec", "feedback", "python", "-c", asked, check=False)
    assert "gaierror" in refused
    listed = stack.enact("shard", "ls", inside="shard-left")
    assert listed.count("stands by") == len(SLOTS)
    assert "copies of the store: two, as db-" in listed


def test_the_standby_takes_over_from_a_killed_daemon(stack):
    """Its container is killed; it comes back as the standby."""
    serving, standby = pair(stack, "left")
    served, stood_by = (
        stack.docker("logs", service).count(word)
        for service, word in ((standby, "ready: "), (serving, "standing by"))
    )
    stack.docker("kill", serving)
    stack.log_until(standby, "ready: ", times=served + 1)
    goes_on(stack)

    stack.docker("start", serving)
    stack.log_until(serving, "standing by", times=stood_by + 1)


def test_a_shard_moves_to_the_other_host(stack):
    """By one command of the operator."""
    serving, standby = pair(stack, "right")

    said = stack.enact(
        *("shard", "move", "right", "--to", standby, "--timeout", "60"), inside="shard-left"
    )

    assert re.search(rf"from {serving} \d+ to {standby} \d+", said)
    goes_on(stack)


def test_the_manager_replaces_a_killed_primary(stack):
    """With its container, the host is gone; it comes back as the second copy."""
    leader, copy = primary(stack)

    stack.docker("kill", leader)
    goes_on(stack)
    assert "promoted self to leader" in stack.docker("logs", copy)
    await_copies(stack, "one")

    stack.docker("start", leader)
    await_copies(stack, f"two, as {leader}")


def test_the_cell_goes_on_with_one_copy(stack):
    """The second copy is stopped in good order."""
    _, copy = primary(stack)

    stack.docker("stop", copy)

    goes_on(stack)
    await_copies(stack, "one")


def test_each_acknowledged_count_counts_once(stack):
    """And no other but those whose outcome the client does not know."""
    stack.docker("exec", "feedback", "touch", "/tmp/end")
    text = until(lambda: noted(stack, "counted"), lambda: "the clients have ended")
    for shard, found in json.loads(text).items():
        assert found["read"] == sorted(set(found["read"])), "a value was read twice"
        acknowledged = len(found["read"])
        assert acknowledged <= found["last"] <= acknowledged + found["unknown"], shard


def test_with_all_that_verdicts_are_those_without(stack, alone):
    """The packages come after the faults."""
    stack.compose("up", "--detach", "--no-deps", "--no-recreate", "conveyor")

    assert stack.ended("demo") == 0, stack.docker("logs", "demo")
    assert judged(stack.out) == alone()
    assert stack.docker("logs", "feedback").count("place/") == PACKAGES
