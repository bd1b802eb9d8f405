"""What a line of a log of objects is."""

import json
import logging
import socket

from enact_dist.link import log
from enact_dist.link.log import JsonLines, Log


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
    texts = [one["text"].partition(" is lost, ")[2] or one["text"] for one in found]
    assert texts[:2] == [f"it cannot be made: {kind}" for kind in ("TypeError", "TypeError")]
    assert texts[2:] == ["and on", "2 lines of this log were lost"]
    assert found[0]["process"] == found[1]["process"] == "actor mine"
