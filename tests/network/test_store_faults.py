"""A cell in a database of two servers, all on hosts of their own, under faults of every part.

Which faults come, and when, is drawn by the run's seed; each run has one of each part at least.
"""

import json
import os

import pytest

from enact_dist.cli.main import main
from enact_dist.errors import LinkError
from enact_dist.verify.chaos.network.hosts import open_hosts
from enact_dist.verify.chaos.replicated import database_faults
from enact_dist.verify.chaos.replicated.nodes import programs

pytestmark = pytest.mark.network
SECONDS = float(os.environ.get("ENACT_CHAOS_STORE_SECONDS", "20"))
RUNS = 3
"""So many runs may be made until all has happened; a slow machine does less in its time."""


@pytest.fixture(scope="module")
def _nodes():
    """Skip where there are no namespaces or no PostgreSQL, with the system's own words."""
    try:
        programs()
        open_hosts(("one",), required=True).close()
    except LinkError as error:
        pytest.skip(str(error))


@pytest.mark.usefixtures("_nodes")
def test_nothing_is_lost_doubled_or_answered_late(tmp_path, capsys):
    """No anomaly under faults of daemons, clients, networks and servers of the database."""
    words = ["--store", "nodes", "--shards", "2", "--actors", "4", "--seconds", str(SECONDS)]
    for attempt in range(RUNS):
        kept = str(tmp_path / str(attempt))
        status = main(["verify", "--chaos", *words, "--keep", kept, "--json"])
        told = json.loads(capsys.readouterr().out)
        assert (told["anomalies"], status) == ([], 0)
        assert told["late_answers"] == 0
        assert not told["missing"]
        if told["takeovers"] and told["commits"] and set(told["faults"]) & {*database_faults.DECK}:
            break
    assert told["takeovers"]
    assert told["commits"]
    assert set(told["faults"]) & {*database_faults.DECK}
