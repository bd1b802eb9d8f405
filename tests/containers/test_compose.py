"""The compose file of the palletizing cell, in an engine, with the faults of a day.

One project for all of it: the conveyor is the last to start, so that the packages come after the
faults, and their verdicts are those of a run on one machine that had none.
"""

import json

import pytest

pytest.importorskip("open3d", exc_type=ImportError)

from stack import PACKAGES, Stack, judged, until

pytestmark = pytest.mark.containers

SHARDS = ("shard-left", "shard-right")
ACTORS = (
    "training-perception",
    "reconstruction",
    "fusion",
    "conveyor",
    "online-perception",
    "deviation",
    "feedback",
)
"""Those that go on for ever; the planning is done at once."""

MARK = "view/probe/mark"
"""A datum of shard-left that no actor of the cell knows."""

BY_REFERENCE = """
import time
import numpy as np
from pathlib import Path
from enact_dist import Aspect, Entity, Lock, Read, Write, connect
with connect("/etc/enact/cell.toml", actor="probe") as cell:
    slot = cell.world("training"), Entity("view/probe"), Aspect("large", np.ndarray)
    {body}
"""
WRITE = """write = Write(*slot)
    with Lock(write) as lock:
        lock[write] = np.full(4 << 20, {value}, np.int32)"""
READ = """read = Read(*slot)
    with Lock(read) as lock:
        largest = int(lock[read].max())
        mapped = "/run/enact/" in Path("/proc/self/maps").read_text()
    for _ in range(400):
        ways = {shard.carrier.split()[0] for shard in cell.shards()}
        if ways == {"socket"}:
            break
        time.sleep(0.25)  # no event reports a way
    print(largest, "mapped" if mapped else "sent", "over", *ways)"""
"""A shard that stood still for half a second has its socket tried again, a few seconds later."""
FAR = READ.replace("range(400)", "range(1)")

COUNTING = """
import time
from enact_dist import Aspect, Durability, Entity, Lock, Write, connect
with connect("/etc/enact/cell.toml", actor="counting") as cell:
    slot = cell.world("training"), Entity("view/probe"), Aspect("count", int, Durability.VOLATILE)
    write = Write(*slot)
    {body}
"""
KEEP = """with cell.world("training").watch(*slot[1:]) as news:
        for number in range(10):
            with Lock(write) as lock:
                lock[write] = number
        while news.next(60.0).version <= 10:
            pass"""
"""Counts until its grant stays, and is idle until another process has counted."""
TAKE = """begun_s = time.monotonic()
    with Lock(write, wait_s=20.0) as lock:
        lock[write], taken_s = 10, time.monotonic()
    print(round(1e3 * (taken_s - begun_s)))"""


@pytest.fixture(scope="module")
def stack(engine, images, alone, tmp_path_factory):
    """The project, up, in training, still without its conveyor."""
    folder = tmp_path_factory.mktemp("compose")
    with Stack(
        engine, "cell", folder, "--file", "deploy/compose.yaml", ENACT_SHARED_SIZE="256m"
    ) as stack:
        stack.compose("up", "--detach", "--scale", "conveyor=0")
        for service in SHARDS:
            stack.log_until(service, "ready: ")
        stack.enact("world", "put", "training", MARK, "42", "--new")
        yield stack


def test_processes_have_no_rights_and_no_place_to_write(stack):
    """From inside: a plain user, a read-only root, no capability, none to be gained."""
    asked = "id -u; touch /usr/x 2>&1; grep -h -e CapEff -e NoNewPrivs /proc/self/status"
    for service in (*SHARDS, "deviation", "feedback", "demo"):
        said = stack.docker("exec", service, "sh", "-c", asked)

        assert said.split()[0] == "10001", service
        assert "Read-only file system" in said, service
        assert said.split()[-3:] == ["0000000000000000", "NoNewPrivs:", "1"], service


@pytest.mark.parametrize("service", SHARDS)
def test_a_shard_is_healthy_by_a_real_query(stack, service):
    """What the engine runs every few seconds asks the shard for its state."""
    health = until(
        lambda: next(iter(healthy(stack, service)), None),
        lambda: f"{service} healthy: {stack.state(service)}",
    )

    assert any("ready (open)" in check["Output"] for check in health["Log"])


def healthy(stack, service):
    """Return the engine's notes on the health of a service that is well."""
    health = stack.state(service)["Health"]
    return [health] if health["Status"] == "healthy" else []


def test_large_data_are_shared_between_containers(stack):
    """What one container commits another one maps; calls take the socket in the same folder."""
    stack.python("feedback", BY_REFERENCE.format(body=WRITE.format(value=1)))

    assert stack.python("fusion", BY_REFERENCE.format(body=READ)) == "1 mapped over socket"


def test_a_grant_stays_in_a_container_and_goes_when_another_one_asks(stack):
    """Shard, keeper and taker see the same marks, though each has process numbers of its own."""

    def revoked():
        return stack.json("shard", "ls")[0]["counters"].get("grants_revoked", 0)

    before, keeper = revoked(), stack.name("feedback")
    stack.engine.docker("exec", "--detach", keeper, "python", "-c", COUNTING.format(body=KEEP))
    kept = until(
        lambda: [one for one in stack.json("lock", "ls") if one["kept"] == "unused"],
        lambda: stack.enact("lock", "ls"),
    )
    taken_ms = int(stack.python("fusion", COUNTING.format(body=TAKE)))

    assert any("view/probe/count" in slot for one in kept for slot in one["slots"])
    assert revoked() > before
    assert taken_ms < 1000, "the keeper's lease, or its hold limit, was waited for"


def test_with_shared_memory_full_data_travel(stack):
    """A file that cannot be made costs speed and nothing else; no process gets SIGBUS."""
    stack.docker("exec", "shard-left", "sh", "-c", "cat /dev/zero >/run/enact/full", check=False)

    stack.python("feedback", BY_REFERENCE.format(body=WRITE.format(value=2)))
    said = stack.python("fusion", BY_REFERENCE.format(body=READ))
    left = stack.json("shard", "ls")[0]

    stack.docker("exec", "shard-left", "rm", "/run/enact/full")
    assert said == "2 sent over socket"
    assert left["name"] == "left"
    assert left["counters"]["payload_fallbacks"] >= 1


def test_a_killed_shard_comes_back_with_its_data(stack):
    """Its policy starts it again; what was committed is there."""
    stack.kill_process("shard-left")
    stack.log_until("shard-left", "ready: ", times=2)

    assert stack.state("shard-left")["RestartCount"] == 1
    assert stack.json("world", "get", "training", MARK) == 42


def test_a_killed_actor_comes_back(stack):
    """A death that nobody has ordered is none."""
    stack.log_until("reconstruction", "ready: ")
    before = stack.state("reconstruction")["RestartCount"]  # not 0 where shards came up late

    stack.kill_process("reconstruction")
    stack.log_until("reconstruction", "ready: ", times=2)

    assert stack.state("reconstruction")["RestartCount"] == before + 1


def test_a_frozen_container_loses_its_lock(stack):
    """Others get it after the TTL of its lease; woken, it is told, and its command ended."""
    held = ("lock", "hold", f"training:{MARK}:write")
    words = ("sh", "-c", "echo held; exec sleep 3600")
    stack.compose("run", "--detach", "--name", stack.name("holder"), "enact", *held, "--", *words)
    stack.log_until("holder", "held")

    stack.pause("holder")
    stack.enact(*held, "--wait", "60", "--", "true")
    stack.docker("unpause", "holder")

    assert stack.ended("holder") == 1
    assert "lease" in stack.docker("logs", "holder")
    stack.docker("rm", "holder")


def test_a_container_cut_off_is_back_when_the_network_is(stack):
    """Without a network nobody joins from there; with it, the actor is as before."""
    network = f"{stack.project}_default"
    stack.engine.docker("network", "disconnect", network, stack.name("fusion"))
    asked = stack.enact("actor", "ls", "--timeout", "1", inside="fusion", check=False)
    stack.engine.docker("network", "connect", network, stack.name("fusion"))

    assert "no shard answers" in asked
    until(lambda: "fusion" in listed(stack, inside="fusion"), lambda: "fusion in enact actor ls")


def listed(stack, *, inside="feedback"):
    """Return the actors of the cell; none where a shard does not answer (yet)."""
    done = stack.engine.docker(
        "exec", stack.name(inside), "enact", "actor", "ls", "--json", check=False
    )
    return set() if done.returncode else {info["actor"] for info in json.loads(done.stdout)}


def test_verdicts_are_those_of_one_machine(stack, alone):
    """After all that not one number is another."""
    stack.compose("up", "--detach", "--no-recreate", "conveyor")

    assert stack.ended("demo") == 0, stack.docker("logs", "demo")
    assert judged(stack.out) == alone()
    assert stack.docker("logs", "feedback").count("place/") == PACKAGES
    for name in ("model_milk_carton.png", "model_meal_tray.png", "tray_1.png"):
        assert (stack.out / name).stat().st_size > 20_000


@pytest.mark.sampled(1, of="file")
def test_started_in_another_order_it_is_as_before(stack):
    """All end by themselves; actors that are first wait for their shards; data are kept."""
    stack.compose("stop", "--timeout", 120)  # the file says 20 s, for machines in their usual state
    codes = {service: stack.state(service)["ExitCode"] for service in (*ACTORS, *SHARDS)}

    for service in (*ACTORS, *reversed(SHARDS)):
        stack.docker("start", service)
    for service in SHARDS:
        stack.log_until(service, "ready: ", times=3 if service == "shard-left" else 2)
    until(lambda: listed(stack) == set(ACTORS), lambda: f"all actors, but {listed(stack)}")

    assert set(codes.values()) == {0}, codes
    assert len(stack.json("world", "get", "online", "user/notices")) == PACKAGES


@pytest.mark.sampled(1, of="file")
def test_on_two_machines_the_verdicts_are_the_same(engine, images, alone, tmp_path_factory):
    """Two projects with nothing in common but the network; the actors are up before the shards."""
    folder = tmp_path_factory.mktemp("multihost")
    files = ("--file", "deploy/compose.yaml", "--file", "deploy/compose.multihost.yaml")

    def host(profile):
        options = (*files, "--profile", profile)
        return Stack(engine, f"{profile}-pc", folder, *options, SHARD_ADDRESS="127.0.0.1")

    with host("shards") as shards, host("perception") as perception:
        perception.compose("up", "--detach")
        shards.compose("up", "--detach")

        assert perception.ended("demo") == 0, perception.docker("logs", "demo")
        shards.python("feedback", BY_REFERENCE.format(body=WRITE.format(value=3)))
        assert shards.python("feedback", BY_REFERENCE.format(body=READ)) == "3 mapped over socket"
        assert perception.python("fusion", BY_REFERENCE.format(body=FAR)) == "3 sent over zenoh"
        assert judged(perception.out) == alone()
