"""Claims about the scenarios as data: a seed says everything, the seeds differ, errors name names."""

import pytest

from actors.workcell.scenarios import SCENARIOS, scenario_of
from enact_dist.errors import ConfigError


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_seed_says_everything(name: str) -> None:
    """The same scenario and seed twice are equal."""
    assert scenario_of(name, 7) == scenario_of(name, 7)


@pytest.mark.parametrize("name", [name for name in SCENARIOS if name != "S1"])
def test_seeds_differ_and_stay_near_the_way(name: str) -> None:
    """Waypoints move by 20 cm at most, speeds stay at 1.6 m/s or less."""
    one, other = (scenario_of(name, seed) for seed in (1, 2))
    assert one.walks != other.walks
    for walk, again in zip(one.walks, other.walks, strict=True):
        for (x, y), (u, v) in zip(walk.way_m, again.way_m, strict=True):
            assert abs(x - u) <= 0.2
            assert abs(y - v) <= 0.2
        assert walk.speed_m_s <= 1.6  # what ISO/TS 15066 assumes of people


def test_faults_come_within_the_run() -> None:
    """Each fault of a scenario of twelve seconds ends within it."""
    for name in SCENARIOS:
        scenario = scenario_of(name, 1, seconds=12.0)
        assert all(0.0 < fault.at_s + fault.seconds < 12.0 for fault in scenario.faults)


def test_an_unknown_scenario_is_refused_with_the_known_ones() -> None:
    """A run of no seconds is refused as well."""
    with pytest.raises(ConfigError, match=r"no scenario 'S13'; there are visit, S1, .*S12"):
        scenario_of("S13", 1)
    with pytest.raises(ConfigError, match="lasts 0 s"):
        scenario_of("S1", 1, seconds=0)
