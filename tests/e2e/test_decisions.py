"""Shards killed at each step of a commit over shards: all or nothing, told truly, soon free."""

import os

import pytest
from accounts import two_shards
from decision_rounds import BUSY_S, STEP_AT, DecisionRounds

from enact_dist.link.client import locks as link_client

pytestmark = pytest.mark.slow
TTL_S = float(os.environ.get("DECISION_KILLS_TTL_S", "1.0"))


@pytest.mark.parametrize("step", STEP_AT)
def test_commit_is_all_or_nothing_when_shards_die_at(step, make_cell, monkeypatch):
    """Some rounds per step, primary or participant or both die: told is true, locks end in 2 TTLs."""
    monkeypatch.setattr(link_client, "FINISH_S", link_client.FINISH_S)  # undoes what rounds set
    cell = two_shards(make_cell, ttl_s=TTL_S)
    longest_s = DecisionRounds(cell, step, ttl_s=TTL_S, seed=len(step)).play()

    assert longest_s <= 2 * TTL_S + BUSY_S
