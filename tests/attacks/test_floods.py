"""One client floods a shard: another's updates stay exact, and the flood is refused by name.

Each run takes a sample; `enact verify --floods` runs all, beside 3,000 updates over each carrier.
What each of them did to a shard without bounds, `enact_dist.verify.floods.attacks` says.
"""

import pytest

from enact_dist.verify.floods.attacks import ATTACKS, Attack
from enact_dist.verify.floods.run import Figures, judge, judge_attacker, measure

UPDATES = 300
LEFT_OUT = ("nothing", "socket sessions")
"""The honest client has done so many before 256 connections are open: the one at which it ends."""
P99_MS_MAX = 2000.0
"""Far above the 10 ms of an idle machine, and far below what each of these floods did before."""


def flood(name):
    (attack,) = (attack for attack in ATTACKS if attack.name == name)
    return attack


def seen(**found):
    good = {"done": 5, "found": 5, "p50_ms": 1.0, "p99_ms": 2.0, "longest_ms": 3.0}
    return {**good, "newcomers_s": [], "failures": {}, **found}


@pytest.mark.slow
@pytest.mark.sampled(5)
@pytest.mark.parametrize("carrier", ["socket", "zenoh"])
@pytest.mark.parametrize("name", [one.name for one in ATTACKS if one.name not in LEFT_OUT])
def test_updates_stay_exact_beside_a_flood_that_is_refused(name, carrier):
    """Each update counts once, nobody's lock is lost, and the shard starts on its folder again."""
    figures = measure(flood(name), carrier=carrier, updates=UPDATES)

    assert figures.problems == []
    assert figures.updates == UPDATES
    assert figures.p99_ms < P99_MS_MAX


@pytest.mark.parametrize(
    ("found", "problem"),
    [
        ({"done": 4, "found": 4}, "4 of 5 updates were committed, the number counts 4"),
        ({"found": 6}, "5 of 5 updates were committed, the number counts 6"),
        ({"failures": {"LeaseLostError": 2}}, "honest client: 2 x LeaseLostError"),
    ],
)
def test_judge_names_what_the_honest_client_lost(found, problem):
    """An update that is missing, one too many, or an error: none of them passes."""
    figures = Figures("sessions", "socket")

    judge(figures, seen(**found), 5)

    assert figures.problems == [problem]
    assert not figures.met


def test_judge_passes_a_client_that_lost_nothing_in_its_time():
    """All updates, once each, within the goal; a slower one misses the goal without a problem."""
    good, slow = Figures("sessions", "socket"), Figures("sessions", "socket")

    judge(good, seen(), 5)
    judge(slow, seen(p99_ms=11.0), 5)

    assert (good.problems, good.met) == ([], True)
    assert (slow.problems, slow.met) == ([], False)


def test_judge_wants_a_refusal_by_name_and_nothing_overheard():
    """An attacker that is served, or that hears others, has found a hole."""
    served, refused = Figures("sessions", "socket"), Figures("sessions", "socket")
    served.tally, served.heard = {"Welcome": 9000}, {"requests": 3}
    refused.tally = {"Welcome": 200, "overload": 8800}

    for figures in (served, refused):
        judge_attacker(Attack("sessions", print, frozenset(("overload",))), figures)

    assert served.problems == [
        "the attacker heard {'requests': 3}",
        "the attacker was not refused as overload: {'Welcome': 9000}",
    ]
    assert refused.problems == []
