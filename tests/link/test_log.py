"""What a line of a log of objects is."""

import json
import logging

from enact_dist.link.log import JsonLines


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
