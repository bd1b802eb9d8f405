"""`enact shard move`: the daemon that serves gives its shard to the standby that was named."""

import json
import os
import re
import threading
import time

import pytest
from replicated_cell import SHARD, Counting, ReplicatedCell
from shard_stores import address_of

from enact_dist.cli.main import main
from enact_dist.link.log import READY, STANDS_BY
from enact_dist.link.postgres.connection import myself
from enact_dist.link.postgres.standby import wait_free

pytestmark = pytest.mark.slow
HOST = myself().partition(" ")[0]


@pytest.fixture
def cell(server, tmp_path, shard_name):
    cell = ReplicatedCell(tmp_path, server.url, os.environ, name=f"move{shard_name}")
    yield cell
    cell.end()


def test_a_shard_moves_to_the_standby_that_is_named_and_back(cell, capsys):
    """No client sees an error, no process ends, and the two change their parts each time."""
    daemons = [cell.start(0), cell.start(1, says=STANDS_BY)]
    counting = Counting(cell.file, 0)
    counting.await_after(0.0)
    pauses_s = []
    for to, of in ((1, 0), (0, 1)):
        standby = f"{HOST} {daemons[to].pid}"
        words = ["shard", "move", SHARD, "--to", standby, "--cell", str(cell.file), "--json"]
        assert main(words) == 0
        said = json.loads(capsys.readouterr().out)
        assert (said["from"], said["to"]) == (f"{HOST} {daemons[of].pid}", standby)
        assert said["pause_s"] < 2.0
        daemons[to].expect(READY)
        daemons[of].expect(STANDS_BY)
        counting.await_after(time.monotonic())
        pauses_s.append(said["pause_s"])
    print(f"pauses of {pauses_s} s")
    counting.end()
    assert not counting.errors
    assert [daemon.status for daemon in daemons] == [None, None]


def test_a_shard_that_was_given_to_one_standby_is_no_others_before_its_lease_is_over(
    server, stores
):
    """The standby that is meant has it at once; any other one may take it if that one is gone."""
    for to, least_s, most_s in ((myself(), 0.0, 2.0), ("elsewhere 1", 3.0, 20.0)):
        address = address_of(server.url, lease_s=3.0)
        store, _, medium = stores.open(address)
        asked = threading.Event()
        medium.on_move(lambda _, asked=asked: asked.set())
        server.execute(
            "UPDATE enact.shard SET holder = holder || ' > ' || %s WHERE name = %s",
            (to, address.shard),
        )
        assert asked.wait(10)
        given_s = time.monotonic()
        store.close()
        found = wait_free(address, stopped=threading.Event(), patient=True, note=print)
        assert least_s < time.monotonic() - given_s < most_s
        assert bool(found.seen.holder) == (to != myself())


@pytest.mark.parametrize(
    ("to", "said"),
    [("elsewhere", "no daemon stands by for shard left on elsewhere"), (HOST, "already")],
)
def test_a_move_without_a_standby_is_refused(cell, capsys, to, said):
    """With who serves it, and what to do; the shard stays where it is."""
    daemon = cell.start(0)
    assert main(["shard", "move", SHARD, "--to", to, "--cell", str(cell.file)]) != 0
    found = capsys.readouterr().err
    assert said in found
    assert re.search(rf"process {HOST} {daemon.pid} serves it", found)
