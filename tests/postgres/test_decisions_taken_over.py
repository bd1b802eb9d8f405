"""Shards killed at each step of a commit over shards, with a standby of each: all or nothing."""

import contextlib
import sys
import time

import pytest
from postgres_nodes import await_sync
from standing_cell import TRAPPED, StandingCell

sys.path.append(str(TRAPPED))

from accounts import PINS
from decision_rounds import BUSY_S, STEP_AT, DecisionRounds

from enact_dist.link.client import locks as link_client

pytestmark = [pytest.mark.slow, pytest.mark.sampled(2)]
TAKEOVER_S = 3.0
TTL_S = 1.0


class TakenOver(DecisionRounds):
    """Rounds in which no daemon is started again: the standby of a victim serves."""

    def _start(self, names):
        for name in names:
            self.cell.start(name)

    def _kill(self, victims, armed):
        self._killed_s = time.monotonic()
        with contextlib.suppress(BrokenPipeError):  # it stood still for longer than its lease
            super()._kill(victims, armed)

    def _back(self, victims):
        return self._killed_s

    def _judge(self, told, value, victims, *, long_away):
        gone = {name for name in self.cell.ports if not self.cell.serves(name)}
        super()._judge(told, value, tuple(sorted({*victims, *gone})), long_away=long_away)
        for name in gone:
            self.cell.back(name)

    def _stories(self):
        return "\n".join(map(self.cell.story, self.cell.ports))


@pytest.fixture
def cell(pair, tmp_path, shard_name):
    await_sync(pair[0])
    cell = StandingCell(
        tmp_path, pair[0], name=f"over{shard_name}", shards=("s0", "s1"), pins=PINS, ttl_s=TTL_S
    )
    yield cell
    cell.end()


@pytest.mark.parametrize("step", STEP_AT)
def test_a_commit_is_all_or_nothing_when_standbys_take_over_at(step, cell, monkeypatch):
    """Primary or participant or both die; the client learns the truth, and locks are free soon."""
    monkeypatch.setattr(link_client, "FINISH_S", link_client.FINISH_S)  # undoes what rounds set
    longest_s = TakenOver(cell, step, ttl_s=TTL_S, seed=len(step)).play()

    assert longest_s <= TAKEOVER_S + TTL_S + BUSY_S
