"""`enact up` in a cell with a store: its shards stand by, and start again, without an error."""

import os
import signal
from pathlib import Path

import pytest
from replicated_cell import SHARD, ReplicatedCell

from enact_dist.config.environment import without_overrides
from enact_dist.link.log import READY, STANDS_BY
from enact_dist.verify.daemons import LineProcess

pytestmark = pytest.mark.slow
SAYS = f"{SHARD}  | "


@pytest.fixture
def cell(server, tmp_path, shard_name):
    cell = ReplicatedCell(tmp_path, server.url, os.environ, name=f"up{shard_name}")
    yield cell
    cell.end()


def test_a_shard_stands_by_is_started_again_and_takes_over(cell, tmp_path):
    """Whatever it is that ended, `up` reports no error of the shard and takes no other's."""
    other = cell.start(1)
    log = tmp_path / "up.log"
    up = LineProcess(
        "enact_dist.cli.main", ["up", str(cell.file)], log,
        environment=without_overrides(os.environ),
    )  # fmt: skip
    cell.daemons.append(up)
    up.expect("enact | up: cell")
    up.expect(SAYS + STANDS_BY)
    os.kill(_shard_of(up), signal.SIGKILL)
    up.expect(SAYS + "ended by SIGKILL; started again")
    up.expect(SAYS + STANDS_BY)
    other.kill()
    up.expect(SAYS + READY)
    os.kill(_shard_of(up), signal.SIGKILL)  # its own lease still runs
    up.expect(SAYS + "ended by SIGKILL; started again")
    up.expect(SAYS + READY)
    up.signal(signal.SIGTERM)
    up.wait_ended()
    assert up.status == 0


def _shard_of(up):
    children = Path(f"/proc/{up.pid}/task/{up.pid}/children").read_text().split()
    assert len(children) == 1
    return int(children[0])
