"""Real faults of daemons and clients whose shards stand in a database that others own."""

import json
import os

import pytest

from enact_dist.cli.main import main
from enact_dist.verify.chaos.replicated import faults

pytestmark = pytest.mark.slow
SECONDS = float(os.environ.get("ENACT_CHAOS_STORE_SECONDS", "10"))


def test_nothing_is_lost_and_nothing_is_left(server, tmp_path, capsys):
    """No anomaly, takeovers, faults of daemons only, and no row of the run in the database."""
    kept = tmp_path / "kept"
    words = ["--shards", "2", "--actors", "2", "--seconds", str(SECONDS), "--keep", str(kept)]

    status = main(["verify", "--chaos", "--store", server.url, *words, "--json"])

    told = json.loads(capsys.readouterr().out)
    assert (told["anomalies"], status) == ([], 0)
    assert told["faults"]
    assert not set(told["faults"]) & faults.ReplicatedFaults.network_kinds
    assert any("not the run's own" in what for what in told["missing"])
    assert told["commits"]
    assert told["answers"]
    assert told["late_answers"] == 0
    left = "SELECT count(*) FROM enact.shard WHERE cell LIKE 'chaos-%%'"
    assert server.execute(left) == [(0,)]
