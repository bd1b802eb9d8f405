"""Who does what in the cell: locks, actors, shards, and who wrote the data that pages list.

One thread asks the shards once a second while a page is open, so that a shard that does not answer
delays no page.
"""

from __future__ import annotations

import contextlib
import re
import threading
import time
from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.actor.report import read_reports
from enact_dist.cli.text.output import shown_bytes
from enact_dist.errors import EnactError, ProtocolError
from enact_dist.link.daemon.counters import OF_A_SHARD
from enact_dist.view import markup
from enact_dist.world.trees import shown_s

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from enact_dist.core.protocol.datum import Slot
    from enact_dist.core.protocol.messages import VersionEntry
    from enact_dist.view.catalogue import SlotCatalogue
    from enact_dist.view.source import CellSource
    from enact_dist.world.listings import ActorInfo, LockInfo, ShardInfo

_FIELDS: Final = re.compile(r"\{[^{}]*\}")
EVERY_S: Final = 1.0
WINDOW_S: Final = 10.0
"""Over which time a counter has to move to be shown."""


class CellActivity(NamedTuple):
    """What the page shows of the cell, as HTML.

    Attributes:
        locks: Who holds, waits and keeps.
        actors: Every actor with its rate and its losses.
        shards: Every shard, and its counters that moved.
        held: Who holds a slot and for how long, by the slot's name.
    """

    locks: str = ""
    actors: str = ""
    shards: str = ""
    held: Mapping[str, str] = {}


class Activity:
    """The thread that asks.

    Args:
        source: The cell.
        catalogue: Which version of a listed slot is the newest.

    Attributes:
        now: What was found last.
    """

    def __init__(self, source: CellSource, catalogue: SlotCatalogue) -> None:
        self._source, self._catalogue = source, catalogue
        self.now = CellActivity()
        self._entries: dict[Slot, VersionEntry] = {}
        self._types: dict[str, str] = {}
        self._listed: dict[object, frozenset[Slot]] = {}
        self._counters: deque[tuple[float, dict[str, dict[str, int]]]] = deque()
        self._news = threading.Condition()
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="view activity", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End; twice is harmless."""
        with self._news:
            self._stopped = True
            self._news.notify_all()
        if self._thread.ident is not None:
            self._thread.join()

    def list(self, page: object, slots: Iterable[Slot] | None) -> None:
        """Set which slots a page lists; None: the page has gone."""
        with self._news:
            if slots is None:
                self._listed.pop(page, None)
            else:
                before, self._listed[page] = self._listed.get(page), frozenset(slots)
                if before != self._listed[page]:
                    self._news.notify_all()

    def entry(self, slot: Slot) -> VersionEntry | None:
        """Return size and writer of a listed slot's newest version, as far as they have come."""
        return self._entries.get(slot)

    def type_of(self, aspect: str) -> str:
        """Return the type of an aspect in a few words."""
        return self._types.get(aspect, "")

    def _run(self) -> None:
        while True:
            with self._news:
                self._news.wait_for(lambda: self._stopped or bool(self._listed))
                if self._stopped:
                    return
                listed = self._listed.copy()
            begun_s = time.monotonic()
            with contextlib.suppress(EnactError):
                self._explain(frozenset().union(*listed.values()))
            with contextlib.suppress(EnactError):
                self._ask()
            # Asking takes at most a tenth of the time, however long the shards take.
            pause_s = max(EVERY_S, 9.0 * (time.monotonic() - begun_s))
            with self._news:
                self._news.wait_for(partial(self._is_over, listed), pause_s)

    def _is_over(self, listed: Mapping[object, frozenset[Slot]]) -> bool:
        """Whether a pause is over, because pages list something else."""
        return self._stopped or self._listed != listed

    def _explain(self, slots: Iterable[Slot]) -> None:
        states = {slot: self._catalogue.state(slot) for slot in slots}
        asked = [
            (slot, state.version) for slot, state in states.items() if state and not state.null
        ]
        self._entries = self._source.explained(asked)
        if any(slot.aspect not in self._types for slot, _ in asked):
            aspects = self._source.cell.aspects()
            self._types = {name: type_name(kind) for name, (kind, _) in aspects.items()}

    def _ask(self) -> None:
        cell, now_s = self._source.cell, time.monotonic()
        shards = cell.shards()
        reachable = [shard.name for shard in shards if shard.reachable]
        locks = cell.locks(reachable)
        actors = cell.actors() if len(reachable) == len(shards) else ()
        self._counters.append((now_s, {shard.name: shard.counters for shard in shards}))
        while self._counters[0][0] < now_s - WINDOW_S:
            self._counters.popleft()
        self.now = CellActivity(
            lock_table(locks),
            actor_table(actors, time.time(), all_answer=len(reachable) == len(shards)),
            shard_table(shards) + counter_table(self._counters),
            {
                slot.partition(" (")[0]: lock_mark(lock)  # without how it is locked
                for lock in locks
                if lock.granted and lock.kept != "unused"
                for slot in lock.slots
            },
        )


# ---------------------------------------------------------------- tables


def type_name(fingerprint: str) -> str:
    """Return a type without the fields of its dataclasses."""
    before = ""
    while before != fingerprint:
        before, fingerprint = fingerprint, _FIELDS.sub("", fingerprint)
    return fingerprint


def lock_mark(lock: LockInfo) -> str:
    """Return who holds a slot, how and since when."""
    return f"{lock.state} by {lock.actor or '(unnamed)'} for {shown_s(lock.age_s)}"


def lock_table(locks: Sequence[LockInfo]) -> str:
    """Return who holds what and who waits for whom."""
    rows = [
        (
            lock.number,
            f"{lock.actor}@{lock.host}",
            lock.state,
            lock.modes,
            shown_s(lock.age_s),
            ", ".join(lock.slots[:3]) + (", …" if lock.slots[3:] else ""),
            ", ".join(map(str, lock.waits_for)),
        )
        for lock in locks
    ]
    columns = ("lock", "who", "state", "mode", "age", "data", "waits for")
    return markup.table(columns, rows, empty="no lock is held or awaited")


def actor_table(infos: Sequence[ActorInfo], now_s: float, *, all_answer: bool) -> str:
    """Return how the actors do.

    Args:
        infos: Their sessions.
        now_s: The time, seconds since 1970.
        all_answer: Whether every shard answers; otherwise the list could not be made.
    """
    rows = [row for info in infos for row in _actor_rows(info, now_s)]
    columns = ("actor", "state", "rate", "missed", "update", "lock wait p99", "last", "last error")
    empty = "no actor is connected" if all_answer else "a shard does not answer"
    return markup.table(columns, rows, empty=empty)


def _actor_rows(info: ActorInfo, now_s: float) -> Iterator[tuple[object, ...]]:
    try:
        reports = read_reports(info.report)
    except ProtocolError:
        reports = ()  # a session that reports something of its own
    for report in reports:
        ago_s = max(0.0, now_s - report.last_update_unix_s)
        yield (
            report.name,
            "silent" if info.silent else report.state,
            f"{report.rate_hz:.1f}/s",
            report.missed,
            shown_s(report.last_update_s),
            f"{report.lock_wait_p99_ms:.1f} ms",
            f"{shown_s(ago_s)} ago" if report.last_update_unix_s else "never",
            report.last_error or "-",
        )
    if not reports:
        yield (info.actor, "silent" if info.silent else "connected", *["-"] * 6)


def shard_table(shards: Sequence[ShardInfo]) -> str:
    """Return how the shards do."""
    rows = [
        (
            shard.name,
            ("open" if shard.open else "grants no lock") if shard.reachable else "UNREACHABLE",
            shown_s(shard.uptime_s),
            shard.slots,
            shown_bytes(shard.size_bytes),
            shard.sessions,
            shard.locks,
            shard.problem or "-",
        )
        for shard in shards
    ]
    columns = ("shard", "state", "up", "slots", "data", "sessions", "locks", "problem")
    return markup.table(columns, rows, empty="no shards")


def counter_table(known: Sequence[tuple[float, Mapping[str, Mapping[str, int]]]]) -> str:
    """Return the counters that moved between the first and the last look.

    Args:
        known: Time in seconds, and the counters by shard.
    """
    (first_s, first), (last_s, last) = known[0], known[-1]
    rows = []
    for shard, counters in last.items():
        for name, value in counters.items():
            figure, moved = OF_A_SHARD.get(name), value - first.get(shard, {}).get(name, value)
            if moved and (figure is None or figure.kind == "counter"):
                meaning = f"{figure.meaning}; {figure.remedy}" if figure else ""
                rows.append((shard, name, f"{moved:+d}", meaning.removesuffix("; ")))
    span = f"in the last {shown_s(last_s - first_s)}"
    return markup.table(("shard", "counter", span, "meaning"), rows, empty="no counter moved")
