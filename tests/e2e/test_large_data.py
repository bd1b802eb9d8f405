"""Large data between hosts without common memory: the same program, the same results."""

import time
from pathlib import Path

import pytest

from enact_dist.errors import LinkError
from enact_dist.verify.chaos.network.hosts import open_hosts

pytestmark = [pytest.mark.slow, pytest.mark.carrier("auto")]
"""One program is on the host of a shard, the other far away: each takes what there is."""
PROGRAM = str(Path(__file__).with_name("large_data_program.py"))
TTL_S = 20.0
CUT_S = 11.0
"""Longer than the lease of a link (TTL_S / 2); the lock outlives it and some seconds more."""


@pytest.fixture
def hosts():
    """Two hosts with a shard each, the second with a client's program, and one far from both."""
    try:
        opened = open_hosts(("s0", "s1", "far"), required=True)
    except LinkError as error:
        pytest.skip(str(error))
    yield opened
    opened.close()


@pytest.fixture
def run(hosts, tmp_path, make_process):
    """Start a program on one of the hosts, `run(host, *arguments)`; the shards run already."""
    cell = tmp_path / "cell.toml"
    shards = "".join(
        f'[shards.{name}]\nlisten = "{hosts.endpoint(name)}"\n' for name in ("s0", "s1")
    )
    pins = "".join(
        f'[[pins]]\nentities = "{side}/**"\nshard = "{shard}"\n'
        for side, shard in (("left", "s0"), ("right", "s1"))
    )
    cell.write_text(
        f'name = "far"\nworlds = ["online"]\nsession_ttl_s = {TTL_S}\n'
        f'data_folder = "{tmp_path}/data"\n{shards}{pins}'
    )

    def start(host, *arguments):
        return make_process(*arguments, before=hosts.before(host))

    for name in ("s0", "s1"):
        start(name, "-m", "enact_dist.cli.main", "shard", "run", name, "--cell", cell).expect(
            "ready:"
        )
    return lambda host, *arguments: start(host, PROGRAM, cell, *arguments)


def told(process):
    """Return what a program said of its data, and how its calls travelled."""
    way = process.expect("done:", timeout_s=400.0)
    assert process.finish() == 0, process.story()
    return [line for line in process.seen if ": " in line and "done" not in line], way


def test_program_far_from_its_shards_finds_what_one_beside_them_finds(run):
    """With the shard's memory in common and without, over both shards: not a bit differs."""
    near, near_way = told(run("s0"))
    far, far_way = told(run("far"))

    assert len(near) == 11
    assert far[:-1] == near[:-1]  # a busy machine may repeat slices of the far one
    assert near[-1] == "repeated: 0"
    assert "socket" in near_way
    assert far_way == "zenoh zenoh"


def test_program_that_is_cut_off_in_mid_transfer_goes_on_when_the_network_is_back(run, hosts):
    """Links end in the middle of a publication and of a fetch; the lock lives, nothing is lost."""
    calm, _ = told(run("far"))
    program = run("far", "pause")
    for kind in ("Stage", "Fetch"):
        assert program.expect("midst:", timeout_s=180.0) == kind
        hosts.cut("s0", "far")
        hosts.cut("far", "s0")
        program.tell("")
        time.sleep(CUT_S)  # the cut itself, not something to be waited for
        hosts.heal("s0", "far")
        hosts.heal("far", "s0")
    cut, _ = told(program)

    assert [line for line in cut if line[:5] not in ("midst", "repea")] == [
        line for line in calm if not line.startswith("repea")
    ]
    assert int(cut[-1].removeprefix("repeated:")) > 0
