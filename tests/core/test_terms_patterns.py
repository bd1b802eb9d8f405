"""Entity patterns: what they match and whether two of them may meet, against a plain reference."""

from __future__ import annotations

from itertools import product
from time import process_time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from enact_dist.patterns import (
    PATTERNS_MAX,
    Patterns,
    checked_patterns,
    pattern_matches,
    patterns_overlap,
)
from enact_dist.terms import Entities, Entity

NAME_SEGMENT = st.text("ab", min_size=1, max_size=3)
NAME = st.lists(NAME_SEGMENT, min_size=1, max_size=3).map("/".join)
PATTERN_SEGMENT = st.one_of(st.just("**"), st.text("ab*", min_size=1, max_size=3)).filter(
    lambda segment: segment == "**" or "**" not in segment
)
PATTERN = st.lists(PATTERN_SEGMENT, min_size=1, max_size=3).map("/".join)
ALL_NAMES = [
    "/".join(segments)
    for depth in (1, 2, 3)
    for segments in product(
        [s for n in (1, 2) for s in map("".join, product("ab", repeat=n))], repeat=depth
    )
]


def plainly_matches(pattern: list[str], name: list[str]) -> bool:
    """The definition: `**` stands for any number of segments, `*` for any letters in one."""
    if not pattern:
        return not name
    if pattern[0] == "**":
        return any(plainly_matches(pattern[1:], name[count:]) for count in range(len(name) + 1))
    return (
        bool(name) and letters_match(pattern[0], name[0]) and plainly_matches(pattern[1:], name[1:])
    )


def letters_match(pattern: str, name: str) -> bool:
    if not pattern:
        return not name
    if pattern[0] == "*":
        return any(letters_match(pattern[1:], name[count:]) for count in range(len(name) + 1))
    return bool(name) and pattern[0] == name[0] and letters_match(pattern[1:], name[1:])


@settings(max_examples=500, deadline=None)
@given(PATTERN, NAME)
def test_pattern_matches_what_its_definition_says(pattern, name):
    """The compiled expression decides as the definition does, letter by letter."""
    assert pattern_matches(pattern, name) == plainly_matches(pattern.split("/"), name.split("/"))


@settings(max_examples=200, deadline=None)
@given(PATTERN, PATTERN)
def test_overlap_is_never_wrongly_denied(one, other):
    """If some name is covered by both patterns, they overlap."""
    if any(pattern_matches(one, name) and pattern_matches(other, name) for name in ALL_NAMES):
        assert patterns_overlap(one, other)


DEEPER_NAMES = [
    "/".join(segments)
    for depth in (1, 2, 3, 4, 5, 6)
    for segments in product(("a", "b", "ab"), repeat=depth)
]
SHORT_PATTERN = st.lists(
    st.sampled_from(("**", "*", "a", "b", "a*", "*b")), min_size=1, max_size=3
).map("/".join)


@settings(max_examples=300, deadline=None)
@given(SHORT_PATTERN, SHORT_PATTERN)
def test_overlap_is_the_existence_of_a_common_name(one, other):
    """Both ways: a name of six segments suffices for patterns of three, if there is one at all."""
    common = [name for name in DEEPER_NAMES if pattern_matches(one, name)]
    assert patterns_overlap(one, other) == any(pattern_matches(other, name) for name in common)


@given(PATTERN, PATTERN)
def test_overlap_is_mutual(one, other):
    """It does not matter which pattern is named first."""
    assert patterns_overlap(one, other) == patterns_overlap(other, one)


@given(PATTERN, NAME)
def test_name_overlaps_with_the_patterns_that_match_it(pattern, name):
    """A pattern without a star is a name."""
    assert patterns_overlap(pattern, name) == pattern_matches(pattern, name)


@pytest.mark.parametrize(
    ("one", "other"),
    [("a/*", "b/*"), ("a/*", "a"), ("a*", "b*"), ("*a", "*b"), ("a/*/b", "a/c"), ("a", "b")],
)
def test_patterns_that_cannot_meet_do_not_overlap(one, other):
    """The answer is no where the texts around the stars contradict each other."""
    assert not patterns_overlap(one, other)


@pytest.mark.parametrize(
    ("pattern", "covered", "not_covered"),
    [
        ("tray/*", ["tray/1", "tray/package"], ["tray", "tray/1/view", "bench"]),
        ("tray/**", ["tray", "tray/1", "tray/1/view"], ["trays", "bench"]),
        ("**", ["a", "a/b/c"], []),
        ("**/view", ["view", "a/view", "a/b/view"], ["a/views"]),
        ("view/v*_left", ["view/v1_left"], ["view/v1_right", "view/x_left"]),
        ("a.c", ["a.c"], ["abc"]),
    ],
)
def test_pattern_covers_what_people_expect(pattern, covered, not_covered):
    """Examples from the documentation."""
    for name in covered:
        assert Entities(pattern).matches(Entity(name)), name
    for name in not_covered:
        assert not Entities(pattern).matches(Entity(name)), name


@pytest.mark.parametrize(
    "name", ["", "/", "a//b", "a/", "/a", "-a", ".a", "a b", "a*", "ä", "x" * 201]
)
def test_wrong_entity_name_is_refused(name):
    """Names that no key of the wire could carry are refused where they are made."""
    with pytest.raises(ValueError, match=r"name"):
        Entity(name)


HARD_TO_MATCH = [
    ("*a" * 30, "a" * 190 + "b"),
    ("*" + "a*" * 90, "a" * 199),
    ("/".join(["**/a"] * 8), "/".join(["a"] * 99 + ["b"])),
    ("/".join(["**/*a*b"] * 8 + ["c"]), "/".join(["aab"] * 49 + ["b"])),
    ("**/" + "*a" * 8 + "/**/" + "*a" * 8, "/".join(["a" * 20 + "b"] * 9)),
]


@pytest.mark.parametrize(("pattern", "name"), HARD_TO_MATCH)
def test_many_stars_cost_little(pattern, name):
    """Where the expression tried each place again, one match of these took longer than a life."""
    begin_s = process_time()
    pattern_matches(pattern, name)
    assert process_time() - begin_s < 1


def test_many_deep_segments_overlap_in_little_time():
    """Each pair of segments is looked at once; tried in all ways, these took hours."""
    begin_s = process_time()
    assert not patterns_overlap("**/a/" * 25 + "b", "**/a/" * 25 + "c")
    assert patterns_overlap("**/a/" * 25 + "**/b", "**/c/" * 25 + "**/b")
    assert process_time() - begin_s < 1


@pytest.mark.parametrize(
    ("pattern", "says"),
    [
        ("a/" + "*x" * 9, "9 stars"),
        ("*" + "a*" * 8 + "/b", "9 stars"),
        ("/".join(["**"] * 5), "5 segments"),
        ("/".join(["**/a"] * 5), "5 segments"),
    ],
)
def test_pattern_with_too_many_stars_is_refused(pattern, says):
    """The limits of a segment and of a whole pattern, with the pattern named."""
    with pytest.raises(ValueError, match=rf"pattern .*{says}.*at most"):
        Entities(pattern)


def test_pattern_with_the_most_stars_is_allowed():
    """Eight in each segment, and four times any number of segments."""
    pattern = "/".join(["**", "*x" * 8] * 4)
    assert Entities(pattern).matches(Entity("/".join(["x" * 8, "y"] + ["x" * 9] * 3)))


@pytest.mark.parametrize("pattern", ["", "a//b", "a/**b", "a b", "x" * 201])
def test_wrong_pattern_is_refused(pattern):
    """A pattern that could match nothing is refused where it is made."""
    with pytest.raises(ValueError, match=r"pattern"):
        Entities(pattern)


@settings(max_examples=200, deadline=None)
@given(st.lists(PATTERN, max_size=4), NAME)
def test_several_patterns_cover_what_one_of_them_covers(patterns, name):
    """Names among them are looked up, patterns tried; none at all cover everything."""
    covered = not patterns or any(pattern_matches(pattern, name) for pattern in patterns)

    assert Patterns(patterns).cover(name) == covered


def test_more_patterns_than_can_be_matched_at_once_are_refused():
    """Names and repeated patterns do not count: they cost a look-up."""
    names = [f"arm/{index}" for index in range(4000)]
    most = [f"arm/{index}/*" for index in range(PATTERNS_MAX)]
    checked_patterns(names + 3 * most)

    with pytest.raises(ValueError, match="257 patterns of entities at once; at most 256"):
        checked_patterns([*most, "**"])
