"""Real faults of daemons and clients whose shards stand in a database that others own."""

import json
import os
from pathlib import Path

import pytest

from enact_dist.cli.main import main
from enact_dist.verify.chaos import evidence, runner
from enact_dist.verify.chaos.figures import judge
from enact_dist.verify.chaos.replicated import faults

pytestmark = [pytest.mark.slow, pytest.mark.sampled(1, of="file")]
ATTEMPTS = 6
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


def test_answers_after_a_lease_are_caught(server, tmp_path, monkeypatch):
    """Daemons whose lease never ends, stopped until another one serves: what they answer is seen.

    One that learns of its successor first ends without an answer; then the same happens again.
    """
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
    deck = {faults.WAKE_OLD: 1}
    for attempt in range(ATTEMPTS):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        settings = runner.ChaosSettings(
            SECONDS, attempt, 1, 4, daemon_module="ungated_daemon", deck=deck, store=server.url
        )
        runner.run(settings, folder, progress=lambda *_: None)
        verdict = judge(evidence.load(folder))
        if verdict.late_answers:
            break

    assert verdict.takeovers
    assert verdict.late_answers
    assert "an old daemon answered after its lease" in {a.rule for a in verdict.anomalies}
