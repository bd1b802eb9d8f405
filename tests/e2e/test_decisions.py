"""Shards killed at each step of a commit over shards: all or nothing, told truly, soon free."""

import os

import pytest
from accounts import two_shards
from decision_rounds import STEP_AT, DecisionRounds, figures_to

from enact_dist.link.client import locks as link_client

pytestmark = pytest.mark.slow
ROUNDS = int(os.environ.get("ENACT_DECISION_KILLS", "4"))
BUSY_S = 25.0
"""What a machine that does other things may add; locks that nobody frees stay for ever."""
TTL_S = float(os.environ.get("DECISION_KILLS_TTL_S", "1.0"))


@pytest.mark.parametrize("step", STEP_AT)
def test_commit_is_all_or_nothing_when_shards_die_at(step, make_cell, monkeypatch):
    """Some rounds per step, primary or participant or both die: told is true, locks end in 2 TTLs."""
    monkeypatch.setattr(link_client, "FINISH_S", link_client.FINISH_S)  # undoes what rounds set
    cell = two_shards(make_cell, ttl_s=TTL_S)
    rounds = DecisionRounds(cell, step, ttl_s=TTL_S, seed=len(step))
    try:
        for number in range(ROUNDS):
            rounds.run(number)
    finally:
        rounds.close()
        figures_to(rounds.tally.line(step, TTL_S) if rounds.tally.rounds else f"{step}: no round")

    assert max(rounds.tally.free_s) <= 2 * TTL_S + BUSY_S, rounds.tally.free_s
