"""The compose file with two hosts of a database and two daemons of each shard, by its one switch.

Daemons and hosts of the database fail while the cell trains and two clients count; no count is
wrong, and the verdicts are those of a run on one machine that had no fault.
"""

import json
import re

import pytest

pytest.importorskip("open3d", exc_type=ImportError)

from stack import PACKAGES, Stack, judged, until

pytestmark = pytest.mark.containers

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
        except CommitUnknownError as error:
            mine["unknown"] += 1
            mine["errors"].append(str(error))
        except EnactError as error:
            mine["errors"].append(str(error))
        else:
            mine["read"].append(value)
            mine["done_s"].append(time.time())
            time.sleep(0.02)
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
Path("/tmp/counted").write_text(json.dumps(found))
"""


@pytest.fixture(scope="module")
def stack(engine, images, alone, tmp_path_factory):
    """The project, up, in training, still without its conveyor; two clients count in it."""
    with Stack(engine, "survive", tmp_path_factory.mktemp("survive"), COMPOSE_FILE=SWITCH) as stack:
        stack.compose("up", "--detach", "--scale", "conveyor=0")
        words = ("python", "-c", COUNTING, json.dumps(SLOTS))
        engine.docker("exec", "--detach", stack.name("feedback"), *words)
        for shard in SLOTS:
            goes_on(stack, shard)
        yield stack


def goes_on(stack, shard):
    """Return once the client of a shard has counted further than when this was called."""
    words = ("world", "get", "training", f"{SLOTS[shard]}/count", "--json", "--timeout", "60")

    def count():
        done = stack.engine.docker("exec", stack.name("feedback"), "enact", *words, check=False)
        return 0 if done.returncode else json.loads(done.stdout)

    before = until(count, lambda: stack.enact(*words, check=False))
    until(lambda: count() > before, lambda: f"{shard} counts on from {before}")


def findings(stack):
    """Return what `enact doctor` says on each subject, inside a container that runs."""
    inside = next(
        one
        for one in ("shard-left", "shard-left-b")
        if stack.state(one)["Status"] == "running"
    )
    return {one["subject"]: one["text"] for one in stack.json("doctor", inside=inside)}


def pair(stack, shard):
    """Return the services that serve a shard and stand by for it, once there are both."""

    def found():
        text = findings(stack).get(f"store of {shard}", "")
        return re.findall(r"served by (\S+) \d+; (\S+) \d+ stands by", text)

    ((serving, standby),) = until(found, lambda: findings(stack))
    return serving, standby


def primary(stack):
    """Return the hosts of the database: the one that takes writes, and the one that copies."""
    for host in DATABASE:
        done = stack.engine.docker(
            *("exec", stack.name(host), "patronictl", "--config-file", "/etc/patroni/config.yml"),
            *("list", "--format", "json"),
            check=False,
        )
        if done.returncode == 0:
            leaders = [
                one["Member"]
                for one in json.loads(done.stdout)
                if one["Role"] == "Leader" and one["State"] == "running"
            ]
            if leaders:
                return leaders[0], next(one for one in DATABASE if one != leaders[0])
    return None


def two_copies(stack):
    """Return once each commit stands on two hosts."""
    until(
        lambda: findings(stack)["copies of the store"].startswith("2"),
        lambda: findings(stack),
    )


def test_two_daemons_of_each_shard_and_two_copies_are_there(stack):
    """As an operator sees it; and what an actor cannot reach."""
    two_copies(stack)
    for shard in SLOTS:
        assert set(pair(stack, shard)) == {f"shard-{shard}", f"shard-{shard}-b"}
    asked = "import socket; socket.create_connection(('{}', 5432), 5)"
    assert stack.python("shard-left", asked.format("db-a")) == ""
    refused = stack.docker(
        "exec", "feedback", "python", "-c", asked.format("db-a"), check=False
    )
    assert "Error" in refused


def test_the_standby_takes_over_from_a_killed_daemon(stack):
    """Its container is killed; it comes back as the standby."""
    serving, standby = pair(stack, "left")
    before = stack.docker("logs", standby).count("ready: ")

    stack.docker("kill", serving)
    stack.log_until(standby, "ready: ", times=before + 1)
    goes_on(stack, "left")

    stack.docker("start", serving)
    assert pair(stack, "left") == (standby, serving)


def test_a_shard_moves_to_the_other_host(stack):
    """By one command of the operator."""
    serving, standby = pair(stack, "right")

    said = stack.enact(
        *("shard", "move", "right", "--to", standby, "--timeout", "60"), inside="shard-left"
    )

    assert standby in said
    goes_on(stack, "right")
    assert pair(stack, "right") == (standby, serving)


def test_the_manager_replaces_a_killed_primary(stack):
    """With its container, the host is gone; it comes back as the second copy."""
    leader, copy = primary(stack)

    stack.docker("kill", leader)
    until(lambda: primary(stack) == (copy, leader), lambda: stack.docker("logs", copy)[-3000:])
    for shard in SLOTS:
        goes_on(stack, shard)
    assert findings(stack)["copies of the store"].startswith("one")

    stack.docker("start", leader)
    two_copies(stack)


def test_the_cell_goes_on_with_one_copy(stack):
    """The second copy is stopped in good order."""
    leader, copy = primary(stack)

    stack.docker("stop", copy)
    for shard in SLOTS:
        goes_on(stack, shard)

    assert primary(stack) == (leader, copy)


def test_each_acknowledged_count_counts_once(stack):
    """And no other but those whose outcome the client does not know."""
    stack.docker("exec", "feedback", "touch", "/tmp/end")
    text = until(
        lambda: stack.docker("exec", "feedback", "cat", "/tmp/counted", check=False).strip()
        if stack.docker("exec", "feedback", "ls", "/tmp").count("counted")
        else "",
        lambda: "the clients have ended",
    )
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
