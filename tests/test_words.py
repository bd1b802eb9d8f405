"""Prose as a test: no phrase of a foreign register and no American spelling in code and documents."""

import re
import tokenize
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
BANNED = {
    r"nobody|somebody": "name them: 'no client', 'another process', 'an operator'",
    r"whoever": "'a client that …', 'any process that …'",
    r"who (?:asks again|waits for(?! whom))": "'a repeated request', 'a request that waits for …'",
    r"(?:is|are|was|were|be|been|being) told": "'the client learns', 'the shard reports'",
    r"says nothing|without a word": "'prints nothing', 'does not answer', 'silently'",
    r"in the same words": "'with the same values', 'a repeated request'",
    r"let(?:s|ting)? go of": "'release', 'free', 'unpin'",
    r"is in the way of": "'blocks'",
    r"of which there (?:is|are)": "begin a new sentence",
    r"what is beyond": "'anything beyond'",
    r"asks nobody": "'without contacting a shard'",
    r"in the midst": "'in the middle of', 'during'",
    r"lest": "'so that … not'",
    r"on whichever": "'on any'",
    r"takes? up again": "'continues'",
}
"""Phrases that a native technical writer would not use, and what to write in their place."""
ONLY_IN_PROGRAMS = {
    r"says (?:how|where|whether|which|who)": "'shows', 'names'",
    r"with nothing beside (?:it|them)": "'on an idle machine'",
    r"all that (?:is|was|happens)": "'everything that …'",
    r"is asked (?:again )?about": "'the client asks for …'",
    r"of (?:before|then)": "'earlier', 'of that time'",
    r"one sees|said to be|as (?:it stands|they stand)": "name the subject",
    r"goes? on holding|comes? of it|came of it": "'keeps holding', 'results'",
    r"in want of|for want of": "'because … is missing'",
}
"""Phrases that no page has any more, and that programs still have."""
AMERICAN = {
    r"behaviors?": "behaviour",
    r"(?:favor|honor|neighbor)(?:s|ed|ing)?": "favour, honour, neighbour",
    r"(?:centi|milli|micro|kilo)meters?": "millimetre",
    r"(?:re)?centered": "centre",
    r"(?:recogn|organ|optim|minim|maxim|normal|synchron|summar)iz(?:e|es|ed|ing|ation)": "with s",
    r"analyz(?:e|es|ed|ing)": "analyse",
    r"(?:travel|label|model|cancel|signal)(?:ed|ing)": "with ll",
}
"""American forms; the repository writes British English."""
LEFT: dict[str, int] = {}
"""How many are left in each part.  This list can only shrink: the test compares exactly."""
_WRONG = re.compile(rf"\b(?:{'|'.join((*BANNED, *AMERICAN))})\b", re.IGNORECASE)
_WRONG_IN_PAGES = re.compile(
    rf"{_WRONG.pattern}|\b(?:{'|'.join(ONLY_IN_PROGRAMS)})\b", re.IGNORECASE
)
_CODE = re.compile(r"^```.*?^```|`[^`\n]*`", re.MULTILINE | re.DOTALL)


def prose_of(file):
    """Yield line numbers and texts: of a page all but code, of a program comments and strings."""
    if file.suffix == ".md":
        text = _CODE.sub(lambda code: "\n" * code[0].count("\n"), file.read_text("utf-8"))
        yield 1, text
        return
    with file.open("rb") as source:
        for token in tokenize.tokenize(source.readline):
            if token.type in (tokenize.STRING, tokenize.COMMENT):
                yield token.start[0], token.string


def wrong_in(file):
    """Return what is wrong in a file: line and phrase.  A phrase may go over the end of a line."""
    wrong = _WRONG_IN_PAGES if file.suffix == ".md" else _WRONG
    return [
        (line + text.count("\n", 0, found.start()), found[0])
        for line, text in prose_of(file)
        for found in wrong.finditer(re.sub(r"\s", " ", text))
    ]


def part_of(file):
    """Return under which name of `LEFT` a file counts: its folder, two levels deep; or the page."""
    path = file.relative_to(ROOT)
    return str(path) if file.suffix == ".md" else "/".join(path.parts[:-1][:2])


def test_prose_is_plain_english():
    """What is wrong stands in the message of the failure, with file and line."""
    files = [ROOT / "README.md"]
    for folder in ("enact_dist", "actors", "deploy"):
        files += [*(ROOT / folder).rglob("*.py"), *(ROOT / folder).rglob("*.md")]
    found = {file: wrong_in(file) for file in sorted(files)}
    counts = Counter()
    for file, wrong in found.items():
        counts[part_of(file)] += len(wrong)
    more = [part for part, count in counts.items() if count > LEFT.get(part, 0)]
    new = [
        f"{file.relative_to(ROOT)}:{line}: {phrase!r}"
        for file, wrong in found.items()
        if part_of(file) in more
        for line, phrase in wrong
    ]
    assert new == [], "write plain English; see BANNED and AMERICAN for what to write"
    assert {part: count for part, count in counts.items() if count} == LEFT


def test_a_phrase_is_found_over_the_end_of_a_line(tmp_path):
    """In a docstring as in a page; code between backquotes is left alone."""
    program, page = tmp_path / "a.py", tmp_path / "a.md"
    program.write_text('x = 1\n"""The client is\ntold."""\n', "utf-8")
    page.write_text("One.\n\nThe client is\ntold `nobody`.\n```\nwhoever\n```\n", "utf-8")

    assert wrong_in(program) == [(2, "is told")]
    assert wrong_in(page) == [(3, "is told")]
