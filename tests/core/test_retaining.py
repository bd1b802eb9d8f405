"""How much history an aspect asks for, what is taken for it, and what holds where several ask."""

import pytest

from enact_dist.core.protocol.messages import AspectEntry
from enact_dist.core.protocol.parts import NO_LIMIT
from enact_dist.core.state.retention import (
    DEFAULT,
    Limits,
    covers,
    limits_of,
    stated_limits,
    with_larger,
)
from enact_dist.terms import Aspect, Retention


def entry(*figures):
    return AspectEntry("mesh", "", "", *figures)


def test_nothing_said_is_the_default():
    """16 versions, 600 s, 16 MiB: bounded, though nobody has thought of it."""
    assert limits_of(entry()) == DEFAULT == Limits(16, 600_000_000_000, 16 << 20)


def test_unsaid_figure_has_no_limit_where_another_is_said():
    """Whoever asks for five versions means five, however old and large."""
    assert limits_of(entry(5)) == Limits(5, NO_LIMIT, NO_LIMIT)
    assert limits_of(entry(0, 7)) == Limits(NO_LIMIT, 7, NO_LIMIT)


def test_retention_of_an_aspect_becomes_figures_of_its_entry():
    """A number of versions and its `Retention` say the same; a small age is not none."""
    assert stated_limits(Retention(5, 1.5, 100)) == Limits(5, 1_500_000_000, 100)
    assert stated_limits(Retention(age_s=0.001)) == Limits(0, 1_000_000, 0)
    assert stated_limits(None) == Limits(0, 0, 0)


@pytest.mark.parametrize(
    ("one", "other", "both"),
    [
        (entry(), entry(5), entry(5)),
        (entry(5), entry(), entry(5)),
        (entry(1), entry(), entry(1)),
        (entry(5), entry(3), entry(5)),
        (entry(5, 10), entry(3, 20), entry(5, 20)),
        (entry(5, 10), entry(8), entry(8)),
        (entry(5), entry(0, 10), entry(NO_LIMIT)),
    ],
)
def test_largest_of_several_counts_figure_by_figure(one, other, both):
    """The default is no word of anybody's, and no limit is the largest."""
    assert with_larger(one, other) == both
    assert covers(both, one)
    assert covers(both, other)


def test_what_is_known_covers_no_larger_wish():
    """A client asks its shard only for what it does not have."""
    assert not covers(entry(), entry(5))
    assert not covers(entry(5, 10), entry(5))
    assert not covers(entry(5), entry(6))
    assert covers(entry(5), entry())


@pytest.mark.parametrize(
    "wrong",
    [
        Retention,
        lambda: Retention(versions=0),
        lambda: Retention(versions=True),
        lambda: Retention(age_s=float("nan")),
        lambda: Retention(age_s=0.0),
        lambda: Retention(size_bytes=1.5),
        lambda: Aspect("mesh", int, retention=0),
        lambda: Aspect("mesh", int, retention="five"),
    ],
)
def test_retention_that_cannot_be_kept_to_is_refused(wrong):
    """At once, where it is written."""
    with pytest.raises(ValueError, match=r"[rR]etention"):
        wrong()


def test_comparator_does_not_make_another_aspect():
    """Two modules may compare one aspect in two ways; it stays one aspect."""

    def loose(left, right):
        return abs(left - right) > 1

    assert Aspect("mesh", int, compare=loose) == Aspect("mesh", int)
    assert hash(Aspect("mesh", int, compare=loose)) == hash(Aspect("mesh", int))
