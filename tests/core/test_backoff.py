"""Pauses grow, differ between clients, and end in a longest one."""

import pytest

from enact_dist.core.client.backoff import (
    AWAY_NS_MAX,
    AWAY_NS_MIN,
    IDLE_PARTS,
    USED_PARTS,
    Backoff,
    SignsOfLife,
)

SECOND = 1_000_000_000
TTL_NS = 2 * SECOND


@pytest.mark.parametrize(
    ("drawn", "pauses"), [(0.0, [20, 40, 80, 100, 100]), (0.5, [15, 30, 60, 75, 75])]
)
def test_pauses_double_up_to_the_longest_and_are_shortened_at_random(drawn, pauses):
    """By at most a half, so that many clients do not ask at the same moment."""
    backoff = Backoff(20, 100, lambda: drawn)
    assert [backoff.pause_ns() for _ in pauses] == pauses


@pytest.mark.parametrize(("parts", "used"), [(USED_PARTS, True), (IDLE_PARTS, False)])
def test_shard_in_reach_is_due_each_time_and_one_away_ever_more_rarely(parts, used):
    """In ten minutes without one shard the other gets all signs of life, this one few."""
    signs, asked, now_ns = SignsOfLife(lambda: 0.0), {"near": 0, "far": 0}, 0
    while now_ns < 600 * SECOND:
        if used:
            signs.used(now_ns, TTL_NS)
        for shard in signs.due(asked, lambda shard: shard == "far", now_ns):
            asked[shard] += 1
        pause_ns = signs.pause_ns(asked, lambda shard: shard == "far", TTL_NS, now_ns)
        assert pause_ns == TTL_NS // parts
        now_ns += pause_ns
    assert asked["near"] == 600 * SECOND * parts // TTL_NS
    assert 600 * SECOND / AWAY_NS_MAX - 2 < asked["far"] <= 600 * SECOND / AWAY_NS_MAX + 2


def test_session_whose_shards_are_all_away_sleeps_until_one_is_due():
    """And asks all of them each time again once they are back."""
    signs = SignsOfLife(lambda: 0.0)
    assert signs.due(["s0", "s1"], lambda _: True, 0) == []
    assert signs.pause_ns(["s0", "s1"], lambda _: True, 4, 0) == AWAY_NS_MIN
    assert signs.due(["s0", "s1"], lambda _: True, AWAY_NS_MIN - 1) == []
    assert signs.due(["s0", "s1"], lambda _: True, AWAY_NS_MIN) == ["s0", "s1"]

    assert signs.pause_ns(["s0", "s1"], lambda shard: shard == "s0", 4, 1) == 2
    assert signs.due(["s0", "s1"], lambda _: False, 2) == ["s0", "s1"]
    assert signs.due(["s0"], lambda _: True, 3) == []


def test_shards_that_are_away_are_asked_together():
    """A pause after the last of them went, however many go one after the other."""
    signs, away = SignsOfLife(lambda: 0.0), {"s0"}
    assert signs.due(["s0", "s1"], away.__contains__, 0) == ["s1"]
    away.add("s1")
    assert signs.due(["s0", "s1"], away.__contains__, 1) == []
    assert signs.gone == {"s0", "s1"}
    for now_ns in range(2, AWAY_NS_MIN, SECOND // 2):
        assert signs.due(["s0", "s1"], away.__contains__, now_ns) == []
    assert signs.due(["s0", "s1"], away.__contains__, 1 + AWAY_NS_MIN) == ["s0", "s1"]


def test_session_rests_twice_as_long_from_a_ttl_after_its_last_use():
    """Until then it may have to repair what a lock has left behind."""
    signs = SignsOfLife(lambda: 0.0)
    signs.used(5, TTL_NS)
    for now_ns, parts in ((6, USED_PARTS), (4 + TTL_NS, USED_PARTS), (5 + TTL_NS, IDLE_PARTS)):
        assert signs.pause_ns(["s0"], lambda _: False, TTL_NS, now_ns) == TTL_NS // parts
