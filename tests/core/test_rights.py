"""Decisions of rights: equal to a plain definition, never too generous, and cheap."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from enact_dist.core.rights import rules
from enact_dist.core.rights.rules import UNPROVEN, Rights, Rule, data_path, fork_path
from enact_dist.patterns import contained, container, pattern_matches

LETTERS = st.text("ab*", min_size=1, max_size=4).filter(lambda text: "**" not in text)
SEGMENTS = st.one_of(st.just("**"), LETTERS)
PATTERNS = st.lists(SEGMENTS, min_size=1, max_size=4).map("/".join)
NAMES = st.lists(st.text("ab", min_size=1, max_size=3), min_size=1, max_size=4).map("/".join)
WORLDS = st.sampled_from(("on", "off", "o*", "*"))
ASPECTS = st.sampled_from(("x", "y", "*"))


def plainly_matches(pattern, name):
    """Match by trying every split, as one would define it."""
    if not pattern:
        return not name
    first, *rest = pattern
    if first == "**":
        return any(plainly_matches(rest, name[at:]) for at in range(len(name) + 1))
    shape = ".*".join(map(re.escape, first.split("*")))
    return bool(name) and bool(re.fullmatch(shape, name[0])) and plainly_matches(rest, name[1:])


def plainly_contains(outer, inner):
    """Each segment of the inner pattern lies inside one of the outer, `**` only inside `**`."""
    if not outer:
        return not inner
    first, *rest = outer
    if first == "**":
        return any(plainly_contains(rest, inner[at:]) for at in range(len(inner) + 1))
    if not inner or inner[0] == "**":
        return False
    shape = ".*".join(map(re.escape, first.split("*")))
    return bool(re.fullmatch(shape, inner[0])) and plainly_contains(rest, inner[1:])


def pattern_contains(outer, inner):
    return container(outer)(contained(inner)) is not None


@given(PATTERNS, PATTERNS)
def test_containment_is_its_plain_definition(outer, inner):
    """Segment by segment."""
    plain = plainly_contains(outer.split("/"), inner.split("/"))
    assert pattern_contains(outer, inner) == plain


@given(PATTERNS, PATTERNS, st.lists(NAMES, max_size=20))
def test_containment_is_never_wrongly_yes(outer, inner, names):
    """No name that the request covers lies outside the rule."""
    if pattern_contains(outer, inner):
        deeps = [inner.replace("**", deep) for deep in ("a", "b/a")]
        filled = [deep.replace("*", star) for deep in deeps for star in ("", "b")]
        for name in (*names, *(name for name in filled if "" not in name.split("/"))):
            if pattern_matches(inner, name):
                assert pattern_matches(outer, name), name


@given(PATTERNS, NAMES)
def test_a_name_is_contained_as_it_is_matched(pattern, name):
    """Containment, the fast match and a plain one agree on every name."""
    assert pattern_contains(pattern, name) == pattern_matches(pattern, name)
    assert pattern_matches(pattern, name) == plainly_matches(pattern.split("/"), name.split("/"))


@pytest.mark.parametrize(
    ("outer", "inner", "inside"),
    [
        ("view/*", "view/*", True),
        ("view/*", "view/**", False),
        ("view/**", "view/*/left", True),
        ("**", "**", True),
        ("*", "**", False),
        ("*/**", "**", False),
        ("view/a*", "view/*", False),
        ("view/*", "view/a*b", True),
        ("**/left", "**/left", True),
        ("**/left", "**", False),
        ("a/**/b", "a/**/c/**/b", True),
    ],
)
def test_containment_by_example(outer, inner, inside):
    """The cases that a reader would ask about, in both directions."""
    assert pattern_contains(outer, inner) is inside


# ---------------------------------------------------------------- decisions

WHO = st.sampled_from(("camera", "cam*", "*", "planner", "@vision", "@all"))
GROUPS = {"vision": ("camera", "recon*"), "all": ("*",)}
PATHS = st.tuples(WORLDS, ASPECTS, PATTERNS).map("/".join)
GIVES = st.tuples(st.sampled_from(("read", "change", "init", "delete")), PATHS)
RULES = st.lists(
    st.builds(
        Rule,
        st.lists(WHO, min_size=1, max_size=2).map(tuple),
        st.lists(GIVES, max_size=3).map(tuple),
    ),
    max_size=6,
)
SUBJECTS = ("camera", "reconstruction", "planner", "ada", UNPROVEN)


def plainly_may(all_rules, subject, right, path):
    """The definition: one pattern of one rule for this subject contains the request."""

    def means(who):
        if who.startswith("@"):
            return any(means(name) for name in GROUPS[who[1:]])
        return bool(re.fullmatch(".*".join(map(re.escape, who.split("*"))), subject))

    if subject == "ada":
        return True
    if subject == UNPROVEN:
        return False
    wanted = ("change", "init", "delete") if right == "write" else (right,)
    return any(
        one in wanted and plainly_contains(pattern.split("/"), path.split("/"))
        for rule in all_rules
        if any(map(means, rule.who))
        for one, pattern in rule.gives
    )


@given(RULES, st.lists(st.tuples(st.sampled_from(SUBJECTS), GIVES), max_size=12))
def test_a_decision_is_its_plain_definition(all_rules, requests):
    """Asked twice: a kept decision is the same."""
    rights = Rights(all_rules, groups=GROUPS, operators=["ada"])
    for _ in range(2):
        for subject, (right, path) in requests:
            assert rights.may(subject, right, path) == plainly_may(all_rules, subject, right, path)
            assert rights.may(subject, "write", path) == plainly_may(
                all_rules, subject, "write", path
            )


def test_new_rights_have_no_old_decision_and_old_ones_make_room(monkeypatch):
    """What is asked often stays decided while thirty others pass."""
    before = Rights([Rule(("camera",), (("read", "on/x/a"),))])
    assert before.may("camera", "read", "on/x/a")
    assert not Rights([]).may("camera", "read", "on/x/a")

    monkeypatch.setattr(rules, "DECISIONS_MAX", 8)
    for number in range(30):
        assert not before.may("camera", "read", f"on/x/b{number}")
        assert before.may("camera", "read", "on/x/a")
        assert len(before._decided) <= 8


def test_this_process_may_everything_and_an_unproven_name_nothing():
    """Not even what a rule gives to `*`."""
    rights = Rights([Rule(("*",), (("read", "**"),))])
    assert rights.may("", "break", "**")
    assert rights.may("anybody", "read", "on/x/a")
    assert not rights.may(UNPROVEN, "read", "on/x/a")


def test_whose_rights_a_user_of_the_host_has():
    """The shard's own user may speak under any name; an operator's tools need none."""
    rights = Rights(
        [Rule(("camera",), ())],
        operators=["uid:1000", "uid:7"],
        users={1001: "camera", 10001: "@vision"},
    )
    assert rights.subject_of(1001, "planner", trusted=False) == "camera"
    assert rights.subject_of(10001, "planner", trusted=False) == "@vision"
    assert rights.subject_of(1002, "camera", trusted=False) == ""
    assert rights.subject_of(7, "camera", trusted=False) == "uid:7"
    assert rights.subject_of(1000, "camera", trusted=True) == "camera"
    assert rights.subject_of(1000, "enact lock break", trusted=True) == "uid:1000"
    assert rights.subject_of(0, "joe", trusted=True) == "joe"


@pytest.mark.parametrize(
    ("text", "path"),
    [
        ("online:plan/*/joints", "online/joints/plan/*"),
        ("what_if*:**", "what_if*/*/**"),
        ("online:view/**", "online/*/view/**"),
        ("online:**/cloud", "online/cloud/**"),
    ],
)
def test_data_are_named_by_world_entities_and_aspect(text, path):
    """The aspect stands second, so that patterns of entities come last."""
    assert data_path(text) == path


@pytest.mark.parametrize("text", ["online", "online:joints", ":a/b", "online:a/", "**:a/b", ""])
def test_what_names_no_data_is_refused(text):
    """A part is missing or empty, or the world context is `**`."""
    with pytest.raises(ValueError, match="names no data"):
        data_path(text)


def test_a_fork_names_source_and_world():
    """Exactly one arrow, with a name on both sides."""
    assert fork_path("online -> what_if*") == "online/what_if*"
    for text in ("online", "a -> b -> c", "-> b", "a/b -> c"):
        with pytest.raises(ValueError, match="names no fork"):
            fork_path(text)
