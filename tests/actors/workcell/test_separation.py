"""Speed and separation: exact values, both directions agree, and T_r is what was measured."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from actors.geometry.separation import LATEST_S, Reaction, Separation

quantities = st.builds(
    Separation,
    reaction_s=st.floats(0.0, 1.0),
    human_m_s=st.floats(0.0, 3.0),
    braking_m_s2=st.floats(0.5, 20.0),
    intrusion_m=st.floats(0.0, 0.5),
    uncertainty_m=st.floats(0.0, 0.5),
)
speeds = st.floats(0.0, 5.0)


def test_distance_is_that_of_the_specification():
    """S(1 m/s) is the sum of its parts, worked out by hand; S(0) is what stays at rest."""
    separation = Separation(0.25, 1.6, 6.0, 0.10, 0.05)

    human_m, robot_m, braking_m = 1.6 * (0.25 + 1.0 / 6.0), 0.25, 1.0 / 12.0
    assert separation.protective_m(1.0) == pytest.approx(human_m + robot_m + braking_m + 0.15)
    assert separation.protective_m(0.0) == pytest.approx(0.55)


def test_robot_rests_below_the_distance_of_rest():
    """At and below S(0) the speed is 0, above it is not; nobody there is no limit."""
    separation = Separation(0.25, 1.6, 6.0, 0.10, 0.05)

    assert separation.speed_max_m_s(-0.2) == separation.speed_max_m_s(0.54) == 0.0
    assert separation.speed_max_m_s(0.56) > 0.0
    assert separation.speed_max_m_s(1.15) == pytest.approx(1.0, abs=0.01)
    assert separation.speed_max_m_s(math.inf) == math.inf
    assert separation.speed_max_m_s(-math.inf) == 0.0


@given(quantities, speeds)
def test_speed_of_a_distance_is_the_distance_of_the_speed(separation, speed_m_s):
    """v_max(S(v)) = v."""
    there = separation.speed_max_m_s(separation.protective_m(speed_m_s))

    assert there == pytest.approx(speed_m_s, rel=1e-6, abs=1e-7)


@given(quantities, st.floats(-1.0, 20.0), st.floats(0.0, 2.0))
def test_more_distance_never_means_less_speed(separation, distance_m, more_m):
    """v_max is monotone, and what it allows keeps the distance."""
    slow, fast = (separation.speed_max_m_s(d) for d in (distance_m, distance_m + more_m))

    assert 0.0 <= slow <= fast
    assert slow == 0.0 or separation.protective_m(slow) <= distance_m + 1e-9


@given(quantities, st.floats(0.1, 10.0))
def test_unit_of_length_does_not_matter(separation, unit):
    """The same cell in other units of length gives the same distance and speed in those units."""
    other = Separation(
        separation.reaction_s,
        separation.human_m_s * unit,
        separation.braking_m_s2 * unit,
        separation.intrusion_m * unit,
        separation.uncertainty_m * unit,
    )

    assert other.protective_m(unit) == pytest.approx(unit * separation.protective_m(1.0))
    assert other.speed_max_m_s(2.0 * unit) == pytest.approx(unit * separation.speed_max_m_s(2.0))


@given(quantities, st.floats(0.0, 4.0), st.floats(0.0, 3.0), st.integers(1, 40))
def test_person_never_reaches_a_robot_that_stops_in_time(separation, speed, walk_share, steps):
    """Integrated step by step: at rest, at least C + Z are left of S(v)."""
    distance_m, left_s = separation.protective_m(speed), separation.reaction_s
    human_m_s = separation.human_m_s * min(1.0, walk_share)
    step_s = (separation.reaction_s + speed / separation.braking_m_s2) / steps
    for _ in range(steps):
        braking_s = max(0.0, step_s - max(0.0, left_s))
        slower = max(0.0, speed - separation.braking_m_s2 * braking_s)
        distance_m -= human_m_s * step_s + speed * (step_s - braking_s)
        distance_m -= (speed + slower) / 2.0 * braking_s
        speed, left_s = slower, left_s - step_s

    assert speed == pytest.approx(0.0, abs=1e-6)
    assert distance_m >= separation.intrusion_m + separation.uncertainty_m - 1e-6


@pytest.mark.parametrize(
    ("quantity", "value"),
    [
        ("reaction_s", -0.1),
        ("human_m_s", math.nan),
        ("braking_m_s2", 0.0),
        ("intrusion_m", math.inf),
    ],
)
def test_impossible_quantity_is_refused_by_name(quantity, value):
    """The error names the quantity and shows the value."""
    with pytest.raises(ValueError, match=quantity):
        Separation(**{quantity: value})


def test_speed_and_distance_that_are_none_are_refused():
    """A negative speed or a distance that is no number never becomes a limit."""
    with pytest.raises(ValueError, match=r"-0\.1"):
        Separation().protective_m(-0.1)
    with pytest.raises(ValueError, match="nan"):
        Separation().protective_m(math.nan)
    with pytest.raises(ValueError, match="not a number"):
        Separation().speed_max_m_s(math.nan)


def test_reaction_is_measured():
    """The longest known age, one period, the margin and the robot's own time."""
    reaction = Reaction(period_s=0.1, robot_s=0.03, margin_s=0.02, kept=20)
    assert reaction.reaction_s == pytest.approx(LATEST_S + 0.03)

    for image in (*range(19), 18):  # the step of the last one was done twice
        reaction.seen(image, 0.050)
    assert reaction.valid_s == LATEST_S
    reaction.seen(19, 0.070)

    assert reaction.valid_s == pytest.approx(0.070 + 0.1 + 0.02)
    assert reaction.reaction_s == pytest.approx(reaction.valid_s + 0.03)
    for image in range(20, 40):
        reaction.seen(image, 0.040)
    assert reaction.valid_s == pytest.approx(0.040 + 0.1 + 0.02)


def test_reaction_is_never_longer_than_a_command_is_valid():
    """Late images do not stretch T_r: the robot refuses what is older."""
    reaction = Reaction(period_s=0.1, robot_s=0.03)

    for image in range(30):
        reaction.seen(image, 0.4)

    assert reaction.valid_s == LATEST_S
