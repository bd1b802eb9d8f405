"""What a line of a log of objects is."""

import json
import logging
import socket
import sys

from enact_dist.link import log
from enact_dist.link.log import JsonLines, Log, TextLines


def test_object_of_the_log_has_our_fields_whatever_a_program_adds():
    """An actor's own records go the same way, with attributes of any name and type."""
    lines = JsonLines(cell="line", process="actor planning")
    mine = {
        "fields": ["x"],
        "text": "other",
        "process": "shard left",
        "event": 3,
        "enact": object(),
    }
    record = logging.makeLogRecord({**mine, "name": "mine", "msg": "found %d", "args": (2,)})

    found = json.loads(lines.format(record))

    assert (found["text"], found["process"], found["event"]) == ("found 2", "actor planning", "3")
    assert json.loads(lines.line("shard.ready", "ready: s", epoch=7))["epoch"] == 7


def test_line_that_cannot_be_made_is_told_and_ends_no_log(monkeypatch):
    """Neither one whose text fails nor one whose fields do; both are counted at the end."""
    near, far = socket.socketpair()
    mine = logging.getLogger("enact.mine")
    monkeypatch.setattr(logging.getLogger("enact"), "propagate", False)
    with near, far, near.makefile() as lines:
        monkeypatch.setattr(log, "STDERR", far.fileno())
        near.settimeout(10.0)
        with Log(JsonLines(process="actor mine")):
            mine.info("found %d", "none")
            mine.warning("found", extra={"enact_fields": {"what": object()}})
            mine.info("and on")
            found = [json.loads(lines.readline()) for _ in range(3)]
        found.append(json.loads(lines.readline()))

    assert [one["level"] for one in found] == ["INFO", "WARNING", "INFO", "WARNING"]
    texts = [one["text"].partition(" is lost because it ")[2] or one["text"] for one in found]
    assert texts[:2] == [f"cannot be formatted: {kind}" for kind in ("TypeError", "TypeError")]
    assert texts[2:] == ["and on", "2 lines of this log were lost"]
    assert found[0]["process"] == found[1]["process"] == "actor mine"


def test_lines_of_the_database_driver_are_lines_of_the_log(monkeypatch):
    """Warnings that no handler takes are written without time, level and source."""
    near, far = socket.socketpair()
    driver = logging.getLogger("psycopg")
    with near, far, near.makefile() as lines:
        monkeypatch.setattr(log, "STDERR", far.fileno())
        near.settimeout(10.0)
        with Log(JsonLines(cell="line", process="shard left")):
            driver.warning("query cancellation failed: %s", "the server is gone")
            found = json.loads(lines.readline())

    assert (found["logger"], found["level"]) == ("psycopg", "WARNING")
    assert found["text"] == "query cancellation failed: the server is gone"
    assert found["process"] == "shard left"
    assert not driver.handlers


FORGED = "a\n2026-01-01 00:00:00,000 CRITICAL enact.shard \x1b[2Jstops \u202e"


def test_message_of_the_text_log_is_one_line():
    """A client that is called like a line of the log forges none; a traceback keeps its lines."""
    try:
        raise ValueError(FORGED)
    except ValueError:
        record = logging.LogRecord("enact", 20, "f", 1, "%s came", (FORGED,), sys.exc_info())

    first, *trace = TextLines().format(record).split("\n")

    assert r"a\n2026-01-01" in first
    assert first.endswith(r"stops \u202e came")
    assert trace[0].startswith("Traceback")
    assert not any(mark in line for line in (first, *trace) for mark in "\x1b\u202e")


def test_object_of_the_log_holds_no_mark_that_acts():
    """JSON escapes control characters by itself, marks of direction it does not."""
    record = logging.LogRecord("enact", 20, "f", 1, FORGED, (), None)

    line = JsonLines().format(record)

    assert not any(mark in line for mark in "\n\x1b\u202e")
    assert json.loads(line)["text"] == FORGED
