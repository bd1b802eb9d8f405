"""The figures of `enact verify --recovery`: what is printed and what counts as missed."""

import json

import pytest

from enact_dist.cli.main import main
from enact_dist.verify import recovery
from enact_dist.verify.recovery import RecoveryFigure


def figure(*times_s, goal_s=0.5):
    return RecoveryFigure("shard restarted, all clients alive", times_s, goal_s)


def test_goal_is_judged_by_the_longest_of_less_than_a_hundred_times():
    """One time over the goal among few is a miss, one of two hundred is not."""
    assert figure(0.1, 0.2, 0.5).met
    assert not figure(0.1, 0.2, 0.51).met
    assert figure(*[0.1] * 199, 3.0).met
    assert not figure(*[0.1] * 197, 3.0, 3.0, 3.0).met


def test_median_and_longest_are_of_the_times():
    """Shares are times that were measured, none is made up between two."""
    times_s = (0.1, 0.2, 0.3, 0.4, 0.9)

    assert [figure(*times_s).share_s(share) for share in (0.5, 0.99, 1.0)] == [0.3, 0.9, 0.9]


@pytest.mark.parametrize(("slowest_s", "status", "said"), [(0.4, 0, "yes"), (0.6, 1, "NO")])
def test_recovery_prints_figures_and_fails_if_a_goal_is_missed(
    monkeypatch, capsys, slowest_s, status, said
):
    """A table for people, every single time for programs, and a status for scripts."""
    asked = []

    def measure(rounds, *, say):
        asked.append(rounds)
        return [figure(0.3, slowest_s)]

    monkeypatch.setattr(recovery, "measure", measure)

    assert main(["verify", "--recovery", "--rounds", "2"]) == status
    assert capsys.readouterr().out.splitlines()[1].split()[-1] == said
    assert main(["verify", "--recovery", "--json"]) == status
    (found,) = json.loads(capsys.readouterr().out)
    assert found["times_s"] == [0.3, slowest_s]
    assert (found["max_s"], found["met"]) == (slowest_s, status == 0)
    assert asked == [2, 5]
