"""Pauses grow, differ between clients, and end in a longest one."""

import pytest

from enact_dist.core.backoff import AWAY_NS_MAX, AWAY_NS_MIN, Backoff, SignsOfLife

SECOND = 1_000_000_000


@pytest.mark.parametrize(
    ("drawn", "pauses"), [(0.0, [20, 40, 80, 100, 100]), (0.5, [15, 30, 60, 75, 75])]
)
def test_pauses_double_up_to_the_longest_and_are_shortened_at_random(drawn, pauses):
    """By at most a half, so that many clients do not ask at the same moment."""
    backoff = Backoff(20, 100, lambda: drawn)
    assert [backoff.pause_ns() for _ in pauses] == pauses


def test_shard_in_reach_is_due_each_time_and_one_away_ever_more_rarely():
    """In ten minutes without one shard the other gets all signs of life, this one few."""
    signs, asked, now_ns = SignsOfLife(lambda: 0.0), {"near": 0, "far": 0}, 0
    usual_ns = SECOND // 2
    while now_ns < 600 * SECOND:
        for shard in signs.due(asked, lambda shard: shard == "far", now_ns):
            asked[shard] += 1
        pause_ns = signs.pause_ns(asked, lambda shard: shard == "far", usual_ns, now_ns)
        assert pause_ns == usual_ns
        now_ns += pause_ns
    assert asked["near"] == 1200
    assert 600 * SECOND / AWAY_NS_MAX < asked["far"] <= 600 * SECOND / AWAY_NS_MAX + 4


def test_session_whose_shards_are_all_away_sleeps_until_one_is_due():
    """And asks all of them each time again once they are back."""
    signs = SignsOfLife(lambda: 0.0)
    assert signs.due(["s0", "s1"], lambda _: True, 0) == ["s0", "s1"]
    assert signs.pause_ns(["s0", "s1"], lambda _: True, 5, 0) == AWAY_NS_MIN
    assert signs.due(["s0", "s1"], lambda _: True, AWAY_NS_MIN - 1) == []

    assert signs.pause_ns(["s0", "s1"], lambda shard: shard == "s0", 5, 1) == 5
    assert signs.due(["s0", "s1"], lambda _: False, 2) == ["s0", "s1"]
    assert signs.due(["s0"], lambda _: True, 3) == ["s0"]
