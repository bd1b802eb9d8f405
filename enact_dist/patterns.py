"""Name patterns of entities: what they cover and whether two of them can meet.

``*`` inside a segment stands for any characters but the slash, a segment ``**`` for any number of
whole segments, also none.  A shard matches patterns of its clients while all others wait, so
both questions cost time in proportion to the lengths, whatever the pattern says:

  * Each star runs up to the next place of the text behind it and is never tried further (an atomic
    group): the leftmost place leaves the most for the rest, so a later one cannot help.  The same
    holds for ``**`` and the segments behind it.
  * Overlap fills a table of the segments of both patterns, each pair once.

Whether one pattern contains another is the same question as whether it matches the other's text: a
star of the inner one is a character that only a star can match, and its ``**`` a segment that only
``**`` can match (`contained`).  The answer may be no for one that does contain the other, such as
``*/**`` for ``**/a``; it is never wrongly yes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from itertools import groupby
from typing import Final

LENGTH_MAX: Final = 200
"""Longest pattern, as long as the longest name."""
STARS_MAX: Final = 8
"""Most stars in one segment of a pattern."""
DEEP_MAX: Final = 4
"""Most segments ``**`` in one pattern."""

PATTERNS_MAX: Final = 256
"""Most patterns with stars in one lock, view or listing."""

_DEEP: Final = "\0"
"""Stands for ``**`` in the text of a pattern: no name and no other pattern has this character."""
_SEGMENT = re.compile(r"(?:\*\*|(?!.*\*\*)[A-Za-z0-9_*][A-Za-z0-9_.\-*]*)\Z")
_compiled: dict[str, re.Pattern[str]] = {}
_COMPILED_MAX: Final = 4096


def checked_pattern(pattern: object) -> str:
    """Return `pattern` if it may name a set of entities, else raise with what is wrong.

    Raises:
        ValueError: Not a string, empty, too long, with more than `STARS_MAX` stars in a segment or
            `DEEP_MAX` segments ``**``, or with a character that no entity name can have.
    """
    if not isinstance(pattern, str) or not pattern:
        raise ValueError(f"a pattern of entities is a non-empty string, not {pattern!r}")
    if len(pattern) > LENGTH_MAX:
        raise ValueError(f"pattern {pattern[:40]!r}… is longer than {LENGTH_MAX}")
    segments = pattern.split("/")
    for segment in segments:
        if not _SEGMENT.match(segment):
            raise ValueError(
                f"{pattern!r} is no pattern of entities: segment {segment!r} must be"
                " letters, digits, '_', '.', '-', '*', or '**' alone"
            )
        if segment.count("*") > STARS_MAX:
            raise ValueError(
                f"pattern {pattern!r} has {segment.count('*')} stars in segment {segment!r};"
                f" at most {STARS_MAX}"
            )
    if segments.count("**") > DEEP_MAX:
        raise ValueError(
            f"pattern {pattern!r} has {segments.count('**')} segments '**'; at most {DEEP_MAX}"
        )
    return pattern


def checked_patterns(patterns: Iterable[str]) -> None:
    """Raise if a pattern is invalid, or if there are too many to match at once.

    A name without a star matches only itself and does not count.

    Raises:
        ValueError: As `checked_pattern`, or more than `PATTERNS_MAX` of them have a star.
    """
    several = frozenset(patterns)
    starred = sum("*" in pattern for pattern in several)
    if starred > PATTERNS_MAX:
        raise ValueError(
            f"{starred} patterns of entities at once; at most {PATTERNS_MAX} are allowed; use fewer"
            " or split the request"
        )
    for pattern in several:
        checked_pattern(pattern)


class Patterns:
    """Several patterns together: the names that any of them covers.  No patterns cover all names.

    Attributes:
        starred: Those with stars, which are tried one by one; the others are names in a set.
    """

    __slots__ = ("_names", "starred")

    def __init__(self, patterns: Iterable[str]) -> None:
        several = frozenset(patterns)
        self.starred = tuple(pattern for pattern in several if "*" in pattern)
        self._names = several.difference(self.starred)

    def cover(self, name: str) -> bool:
        """Say whether one of them covers the entity name `name`."""
        if name in self._names or not (self._names or self.starred):
            return True
        return any(pattern_matches(pattern, name) for pattern in self.starred)


def pattern_matches(pattern: str, name: str) -> bool:
    """Say whether the entity pattern `pattern` covers the entity name `name`."""
    found = _compiled.get(pattern)
    if found is None:
        if len(_compiled) >= _COMPILED_MAX:
            _compiled.clear()
        found = _compiled[pattern] = re.compile(_source(pattern))
    return found.match(f"{name}/") is not None


def patterns_overlap(one: str, other: str) -> bool:
    """Say whether two entity patterns could cover one name, its length left aside."""
    ours, theirs = one.split("/"), other.split("/")
    # `after[j]`: whether the rest of ours can match the rest of theirs from j on.
    after = [all(segment == "**" for segment in theirs[j:]) for j in range(len(theirs) + 1)]
    for segment in reversed(ours):
        here = [False] * (len(theirs) + 1)
        here[-1] = segment == "**" and after[-1]
        for j in reversed(range(len(theirs))):
            if "**" in (segment, theirs[j]):
                # Either one ends here, or it takes one more segment of the other.
                here[j] = after[j] or here[j + 1]
            else:
                here[j] = after[j + 1] and _segments_overlap(segment, theirs[j])
        after = here
    return after[0]


def container(pattern: str) -> Callable[[str], object]:
    """Return a function of what `contained` returns; it returns None for what is not contained.

    A pattern is contained if `pattern` covers all names that it covers; never wrongly so.
    """
    return re.compile(_source(pattern)).match


def contained(pattern: str) -> str:
    """Return a pattern, or a name, as the text that the pattern around it has to match."""
    if "**" not in pattern:
        return f"{pattern}/"
    segments = [_DEEP if segment == "**" else segment for segment in pattern.split("/")]
    return f"{'/'.join(segments)}/"


def _segments_overlap(one: str, other: str) -> bool:
    """Compare the texts before the first star and after the last: between them all can stand."""
    if "*" not in one:
        return pattern_matches(other, one) if "*" in other else one == other
    if "*" not in other:
        return pattern_matches(one, other)
    heads = (one.split("*")[0], other.split("*")[0])
    tails = (one.split("*")[-1], other.split("*")[-1])
    shortest_head, shortest_tail = min(map(len, heads)), min(map(len, tails))
    same_head = heads[0][:shortest_head] == heads[1][:shortest_head]
    same_tail = not shortest_tail or tails[0][-shortest_tail:] == tails[1][-shortest_tail:]
    return same_head and same_tail


def _source(pattern: str) -> str:
    """Return the expression for names that end with a slash, as each of their segments then does.

    Runs of segments are separated by ``**``: the first one matches at the start of the name, the
    last one at its end, each other one at the next place where it fits.
    """
    groups = [
        (deep, "".join(map(_segment_source, segments)))
        for deep, segments in groupby(pattern.split("/"), "**".__eq__)
    ]
    source, deep_before = "", False
    for index, (deep, run) in enumerate(groups):
        if deep:
            deep_before = True
        elif not deep_before:
            source += run
        elif index == len(groups) - 1:
            source += rf"(?:[^/]+/)*{run}"
        else:
            source += rf"(?>(?:[^/]+/)*?{run})"
    return source + (r"(?:[^/]+/)*\Z" if groups[-1][0] else r"\Z")


def _segment_source(segment: str) -> str:
    if "*" not in segment:
        return re.escape(segment) + "/"
    head, *between, tail = map(re.escape, segment.split("*"))
    source = head + "".join(rf"(?>[^/\0]*?{text})" for text in between if text)
    return rf"{source}(?>[^/\0]*{tail})/"
