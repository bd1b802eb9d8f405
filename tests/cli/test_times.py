"""Moments on a command line: written in five ways, printed in one that can be read again."""

import time
from argparse import ArgumentTypeError
from datetime import UTC, datetime

import pytest

from enact_dist.access.arguments import stamp_of
from enact_dist.cli.main import build_parser
from enact_dist.cli.text.times import moment, shown_position
from enact_dist.core.protocol.datum import Position

NOON_NS = 1_763_726_400_000_000_000
ROUNDED_S = 0.001


@pytest.mark.parametrize(
    ("text", "stamp_ns"),
    [
        ("2025-11-21T12:00:00Z", NOON_NS),
        ("2025-11-21 13:00:00.5+01:00", NOON_NS + 500_000_000),
        ("1763726400", NOON_NS),
        ("1763726400.25", NOON_NS + 250_000_000),
        (str(NOON_NS + 1), NOON_NS + 1),
        (f"{NOON_NS + 1}@left", NOON_NS + 1),
    ],
)
def test_moment_is_read_in_each_way_it_is_written(text, stamp_ns):
    """A date, seconds, a stamp, a position."""
    assert stamp_of(moment(text)) == stamp_ns


@pytest.mark.parametrize(
    ("text", "ago_s"), [("-30s", 30.0), ("-500ms", 0.5), ("-2.5min", 150.0), ("-1h", 3600.0)]
)
def test_moment_may_be_so_long_ago(text, ago_s):
    """By this host's clock."""
    began_s = time.time()
    found_s = moment(text)
    assert began_s - ROUNDED_S < found_s + ago_s < time.time() + ROUNDED_S


def test_time_without_a_zone_is_that_of_this_host():
    """As the tables print it."""
    here = datetime.fromtimestamp(NOON_NS / 1e9, UTC).astimezone().replace(tzinfo=None)

    assert stamp_of(moment(here.isoformat())) == NOON_NS


@pytest.mark.parametrize("text", ["yesterday", "-30", "-3x", "12:00", "@left", ""])
def test_what_is_no_moment_is_refused(text):
    """With the ways it can be written."""
    if text == "-30":
        assert moment(text) == -30.0  # seconds since 1970, refused where it is used
        return
    with pytest.raises(ArgumentTypeError, match=r"is no moment; give a moment: -30s"):
        moment(text)


def test_printed_position_is_read_back():
    """From a table to the next command."""
    position = Position(NOON_NS + 7, "left")

    assert moment(shown_position(position)) == position


def test_moment_ago_is_no_option():
    """Neither as an argument nor behind an option."""
    began_s = time.time()
    arguments = build_parser().parse_args(["world", "fork", "online", "new", "--at", "-30s"])
    past = build_parser().parse_args(["world", "at", "online", "-5min", "get", "a/b"])

    assert began_s - ROUNDED_S < arguments.at + 30.0 < time.time() + ROUNDED_S
    assert began_s - ROUNDED_S < past.moment + 300.0 < time.time() + ROUNDED_S


@pytest.mark.parametrize(
    "line",
    [
        "world at online -3x",
        "world at online -3x tree",
        "world at online --json -3x get a/b",
        "world fork online new --at -3x",
        "world diff online online --at1 -3x",
        "replay run.mcap --from -3x",
    ],
)
def test_what_is_no_moment_ago_is_told_where_it_stands(line, capsys):
    """A dash and a digit begin a value: the word is not missing, and not the next one."""
    with pytest.raises(SystemExit) as ended:
        build_parser().parse_args(line.split())

    assert ended.value.code == 2
    assert ": '-3x' is no moment; give a moment: -30s" in capsys.readouterr().err


@pytest.mark.parametrize("value", ["-30s", "-1e-3", "-.5", "-3"])
def test_value_that_begins_with_a_dash_and_a_digit_is_taken_as_it_is(value):
    """Of other verbs, too: nothing is put before it."""
    arguments = build_parser().parse_args(["world", "put", "online", "a/b", value])

    assert arguments.value == value


@pytest.mark.parametrize("text", ["-99999d", "-999999999999999999999999d"])
def test_moment_before_1970_is_refused_as_it_was_written(text):
    """By the text, and not by the seconds that come out of it."""
    with pytest.raises(ArgumentTypeError, match=rf"^'{text}' lies before 1970"):
        moment(text)
