"""The log of a process: lines for people, or one JSON object per line with stable fields.

=======  ==========================================================================================
field    of a line of `--log json`
=======  ==========================================================================================
time     seconds since 1970, a number
level    "DEBUG", "INFO", "WARNING", "ERROR" or "CRITICAL"
logger   the part that logs: "enact.shard", "enact.store", "enact.link", "enact.actor", …, or
         "psycopg", the driver of a cell's database
event    what happened, in names that programs may rely on ("lock.taken", "shard.stop"); empty
         if the line is only for people
text     the line for people
cell     name of the cell; empty if not known yet
process  "shard NAME" or "actor NAME"; "process NAME" if several actors share a process and the
         line belongs to none of them
error    a traceback; only where there is one
=======  ==========================================================================================

`shard.ready` has further fields: `endpoints`, `epoch` and `folder` (null: data in memory only).
`actor.end` has `state`, `updates`, `failures` and `refused`.  These two and `actor.ready` go to
standard output, everything else to standard error.
"""

from __future__ import annotations

import json
import logging
import os
import queue
import sys
import threading
from collections.abc import Collection
from contextlib import suppress
from copy import copy
from logging.handlers import QueueHandler
from typing import Any, Final

from enact_dist.wire.texts import shown, shown_json

TEXT: Final = "%(asctime)s %(levelname)s %(name)s %(message)s"
READY: Final = "ready:"
"""First word of the line by which a shard or an actor reports that it is ready."""
STANDS_BY: Final = "standing by"
"""First words of the line by which a shard reports that another daemon serves it."""
STDERR: Final = 2
_FIELDS: Final = "enact_fields"
"""Attribute of a record that holds further fields; all other extra attributes are ignored."""
LAST_S: Final = 0.3
"""How long an ending process waits for its last lines to be written."""
LINES_MAX: Final = 10_000
"""Log lines queued for a slow reader; more lines are dropped so that nothing blocks."""

_log = logging.getLogger("enact.shard")


class TextLines(logging.Formatter):
    """Formats lines for people, with control characters escaped.

    One line is one event, whatever names clients choose; tracebacks keep their line breaks.

    Args:
        actors: Names of the actors that share this process; a line begins with the name of its
            thread's actor.
    """

    def __init__(self, actors: Collection[str] = ()) -> None:
        super().__init__(TEXT)
        self._actors = actors

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - of `logging`
        """Return the line without its traceback."""
        actor = actor_of(record, self._actors)
        return shown(f"[{actor}] " * bool(actor) + super().formatMessage(record))

    def formatException(self, ei: Any) -> str:  # noqa: N802 - of `logging`
        """Return the traceback."""
        return shown(super().formatException(ei), lines=True)


class JsonLines(logging.Formatter):
    """Makes one JSON object of each line; see the module.

    Attributes:
        cell: Name of the cell.
        process: Default source of the lines.
        actors: Names of the actors that share this process; lines of an actor's thread name it as
            the source.
    """

    def __init__(self, *, cell: str = "", process: str = "", actors: Collection[str] = ()) -> None:
        super().__init__()
        self.cell, self.process, self.actors = cell, process, actors

    def format(self, record: logging.LogRecord) -> str:
        """Return the line without its line break."""
        actor = actor_of(record, self.actors)
        line = {
            "time": round(record.created, 6),
            "level": record.levelname,
            "logger": record.name,
            "event": str(getattr(record, "event", "")),
            "text": record.getMessage(),
            "cell": self.cell,
            "process": f"actor {actor}" if actor else self.process,
        }
        if record.exc_info:
            line["error"] = self.formatException(record.exc_info)
        text = json.dumps({**getattr(record, _FIELDS, {}), **line}, ensure_ascii=False)
        return shown_json(text)

    def line(self, event: str, text: str, *, level: int = logging.INFO, **fields: object) -> str:
        """Return the line of an event that no logger emits."""
        named = {"name": f"enact.{event.partition('.')[0]}", "msg": text, "event": event}
        levels = {"levelno": level, "levelname": logging.getLevelName(level)}
        return self.format(logging.makeLogRecord({**named, **levels, _FIELDS: fields}))


def actor_of(record: logging.LogRecord, actors: Collection[str]) -> str:
    """Return the actor whose thread made a record; empty: none.

    An actor's thread has the actor's name; its helper thread is called "NAME lookout".
    """
    name = (record.threadName or "").partition(" ")[0]
    return name if name in actors else ""


def say(formatter: logging.Formatter, event: str, text: str, **fields: object) -> None:
    """Print a line that other programs wait for: text, or an object with it and `fields`.

    One write prints it all, since other processes may share the pipe.
    """
    if isinstance(formatter, JsonLines):
        text = formatter.line(event, text, level=logging.INFO, **fields)
    else:
        text = shown(text)  # it may end with the text of a user's error
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def last_words(formatter: logging.Formatter, text: str) -> None:
    """Write a grave line past the log's queue, for a process that exits in the next moment."""
    levels = {"levelno": logging.CRITICAL, "levelname": "CRITICAL"}
    line = formatter.format(logging.makeLogRecord({"name": "enact.shard", "msg": text, **levels}))
    with suppress(OSError):  # what its reader cannot take now is lost
        os.set_blocking(STDERR, False)
        os.write(STDERR, f"{line}\n".encode("utf-8", "backslashreplace"))


def says_ready(line: str) -> bool:
    """Whether this line, text or object, reports that a shard or an actor is ready.

    A shard that stands by counts: another daemon serves.
    """
    return in_words(line).startswith((READY, STANDS_BY))


def in_words(line: str) -> str:
    """Return the text of an object that reports that a shard or an actor is ready, or stands by.

    Any other line is returned unchanged.
    """
    if not line.startswith("{") or ('.ready"' not in line and '.standby"' not in line):
        return line
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):
        return line
    ready = found.get("event") in ("shard.ready", "shard.standby", "actor.ready")
    return str(found.get("text", "")) if ready else line


class Log:
    """Sends the log of a daemon to stderr from a separate thread while its block runs.

    A reader that stops reading must neither block the shard nor keep it from ending.  Lines beyond
    `LINES_MAX` are dropped and counted, and the last ones get at most `LAST_S`.  A line that cannot
    be formatted is counted too, and replaced by a note.
    """

    def __init__(self, formatter: logging.Formatter) -> None:
        self._format = formatter.format
        self._lines: queue.Queue[logging.LogRecord | None] = queue.Queue(LINES_MAX)
        self._handler = _BoundedHandler(self._lines)
        self._thread = threading.Thread(target=self._write, name="enact-log", daemon=True)
        self._logger = logging.getLogger("enact")
        self._driver = logging.getLogger("psycopg")  # its warnings are no other's to format

    def __enter__(self) -> None:
        self._level = self._logger.level
        self._logger.setLevel(logging.INFO)
        for logger in (self._logger, self._driver):
            logger.addHandler(self._handler)
        self._thread.start()

    def _write(self) -> None:
        # Straight to the descriptor: a full pipe would block a line while Python's streams and
        # handlers hold their locks, and the interpreter could not exit.
        while (record := self._lines.get()) is not None:
            left = f"{self._formatted(record)}\n".encode("utf-8", "backslashreplace")
            try:
                while left:
                    left = left[os.write(STDERR, left) :]
            except OSError:  # its reader is gone, or its disk is full
                self._handler.lost += 1

    def _formatted(self, record: logging.LogRecord) -> str:
        try:
            return self._format(record)
        except Exception as error:  # noqa: BLE001 - whatever it holds, the next line is written
            self._handler.lost += 1
            bare = {"name": record.name, "msg": _unmade(record, error)}
            levels = {"levelno": record.levelno, "levelname": record.levelname}
            return self._format(logging.makeLogRecord({**bare, **levels}))

    def __exit__(self, *_: object) -> None:
        if self._handler.lost:
            _log.warning("%d lines of this log were lost", self._handler.lost)
        for logger in (self._logger, self._driver):
            logger.removeHandler(self._handler)
        self._logger.setLevel(self._level)
        with suppress(queue.Full):
            self._lines.put_nowait(None)
        self._thread.join(LAST_S)


class _BoundedHandler(QueueHandler):
    """Queues log records; counts those that do not fit."""

    lost = 0

    def prepare(self, record: logging.LogRecord) -> logging.LogRecord:
        """Format the text here, before its arguments can change; keep the other fields."""
        record = copy(record)
        try:
            record.msg = record.getMessage()
        except Exception as error:  # noqa: BLE001 - logging would print it, which may wait
            self.lost += 1
            record.msg = _unmade(record, error)
        record.args = None
        return record

    def enqueue(self, record: logging.LogRecord) -> None:
        try:
            self.queue.put_nowait(record)
        except queue.Full:
            self.lost += 1


def _unmade(record: logging.LogRecord, error: Exception) -> str:
    where = f"{record.module}:{record.lineno}"
    return f"a line of {where} is lost because it cannot be formatted: {type(error).__name__}"
