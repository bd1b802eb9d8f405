"""The report of a running actor: counters, rates, lock waits, its last error.

`ActorStatistics` is a snapshot; `ActorRecord` collects (PURE: time arrives as an argument);
`encode_reports` and `read_reports` carry the snapshots of all actors of one process through
the session's keep-alive to `enact actor ls`.

Memory is fixed when the actor starts: rates come from the newest `STAMPS_MAX` updates, lock waits
from the newest `WAITS_MAX`.

`Repeated` (PURE, too) keeps an actor's log readable.  A dead camera leaves every set incomplete,
and a broken update fails at each trigger; logged one by one, such events would hide everything
else.  So the first is logged at once and the others as a count.  No event is lost: the remaining
counts are logged at the end.
"""

from __future__ import annotations

import dataclasses
import re
import reprlib
import threading
import traceback
from array import array
from bisect import bisect_left
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Final
from weakref import WeakKeyDictionary

import msgpack

from enact_dist.core.protocol.messages import REPORT_BYTES_MAX
from enact_dist.errors import CommitUnknownError, ProtocolError
from enact_dist.world.cell import session_behind

if TYPE_CHECKING:
    from collections.abc import Hashable, Mapping

    from enact_dist.world.cell import Cell

PAUSE_NS_MIN: Final = 5_000_000_000
PAUSE_NS_MAX: Final = 300_000_000_000
"""Pause between two lines of one kind; doubles while such events keep coming."""
KINDS_MAX: Final = 64
"""Kinds that are counted separately at one time."""

_DIGITS: Final = re.compile(r"[0-9]+")


@dataclass(slots=True)
class _Kind:
    due_ns: int
    pause_ns: int = PAUSE_NS_MIN
    untold: int = 0
    newest: str = ""


class Repeated:
    """Decides when to log repeated events, kind by kind.  One thread at a time."""

    __slots__ = ("_kinds",)

    def __init__(self) -> None:
        self._kinds: dict[Hashable, _Kind] = {}

    def tell(self, kind: Hashable, text: str, now_ns: int) -> int | None:
        """Return the count to report: 0 for the first, None for not now."""
        known = self._kinds.get(kind)
        if known is None and len(self._kinds) >= KINDS_MAX:
            for name, one in list(self._kinds.items()):
                if not one.untold and now_ns >= one.due_ns + one.pause_ns:
                    del self._kinds[name]
            if len(self._kinds) >= KINDS_MAX:
                kind = None
                known = self._kinds.get(kind)
        if known is None:
            self._kinds[kind] = _Kind(now_ns + PAUSE_NS_MIN)
            return 0
        known.untold += 1
        known.newest = text
        if now_ns < known.due_ns:
            return None
        count, known.untold = known.untold, 0
        known.pause_ns = min(2 * known.pause_ns, PAUSE_NS_MAX) if count > 1 else PAUSE_NS_MIN
        known.due_ns = now_ns + known.pause_ns
        return count

    def left(self) -> list[tuple[int, str]]:
        """Return the unreported counts, each with the newest text of its kind; only once."""
        found = [(kind.untold, kind.newest) for kind in self._kinds.values() if kind.untold]
        for kind in self._kinds.values():
            kind.untold = 0
        return found


def kind_of(error: BaseException) -> Hashable:
    """Return what equal errors have in common: class, text without numbers, place."""
    places = [(frame.f_code, line) for frame, line in traceback.walk_tb(error.__traceback__)]
    return type(error), _DIGITS.sub("0", str(error)), tuple(places)


REPORT_VERSION: Final = 1
RATE_WINDOW_NS: Final = 5_000_000_000
"""Rates are over the last 5 s: long enough for 1 Hz sources, short enough to see a stall."""
STAMPS_MAX: Final = 512
WAITS_MAX: Final = 512
BRIEF_LENGTH_MAX: Final = 80
"""Longest text of an actor in the report of a process with many."""
ARGS_MAX: Final = 32
"""Parameters in a report."""
ERROR_LENGTH_MAX: Final = 500
"""Longest error text in a report; the whole one is in the actor's log."""
WRITES_MAX: Final = 64
"""Declared writes in a report."""


@dataclass(frozen=True, slots=True)
class ActorStatistics:
    """What an actor has done so far.

    Attributes:
        state: "starting", "running", "stuck" (its update runs on after its lock was lost), "done"
            (a once-actor that finished) or "stopped".
        updates: Updates that committed.
        skipped: States of trigger data that no update saw because a newer one came first.
        failures: Updates that ended with an exception of their own.
        refused: Attempts that ended outside the actor's code: lock not granted in time, lease
            lost, shard away, viewed datum changed.  Each is tried again later.
        unknown: Commits that were never answered and may stand (`CommitUnknownError`).
        missed: Ticks of a source that never ran, or whose update was refused.
        last_error: Newest error as "Class: text", or the empty string.
        rate_hz: Updates per second, over the last 5 s.
        last_update_s: How long the newest update took, without the wait for its lock.
        update_p50_ms: Median of the same over the newest 512 updates.
        update_p99_ms: 99th percentile of the same.
        last_update_unix_s: When it ended, seconds since 1970 by the actor's clock; 0 if none.
        lock_wait_p50_ms: Median wait for the lock over the newest 512 attempts.
        lock_wait_p99_ms: 99th percentile of the same.
        incomplete: Sets of data with one capture stamp (`Together`) that never ran, because some
            of them never came, or left retention before.
        last_incomplete: The newest of these: its stamp and what was missing.
        late: Data that arrived after their set had been closed.
        unstamped: Data that fit no set because their writer gave no stamp.
        writes: What it declares to write, as ``world:entities/aspect``; at most `WRITES_MAX`.
        unstamped_from: Which data these are.
        partial: Sets that ran without some of their data, as `Together(…, least=…)` allows.
        last_partial: The newest of them: its stamp and what was missing.
        updating_s: How long the update that runs has taken so far; 0 between updates.
        interrupted: Versions that an actor with `once` found taken by a process that is gone.
        last_interrupted: The newest of these.
        lock_lost: Whether that update has lost its lock, so that it can commit nothing.
        args: The values of its parameters, each as ``name=value``.
        words_in: The world context in which its process receives commands; empty: it does not.
        word: The token of the newest command, and the answer to it.
    """

    name: str = ""
    state: str = "starting"
    updates: int = 0
    skipped: int = 0
    failures: int = 0
    refused: int = 0
    unknown: int = 0
    missed: int = 0
    last_error: str = ""
    rate_hz: float = 0.0
    last_update_s: float = 0.0
    last_update_unix_s: float = 0.0
    lock_wait_p50_ms: float = 0.0
    lock_wait_p99_ms: float = 0.0
    incomplete: int = 0
    last_incomplete: str = ""
    late: int = 0
    unstamped: int = 0
    writes: tuple[str, ...] = ()
    unstamped_from: str = ""
    partial: int = 0
    last_partial: str = ""
    updating_s: float = 0.0
    lock_lost: bool = False
    interrupted: int = 0
    last_interrupted: str = ""
    args: tuple[str, ...] = ()
    words_in: str = ""
    word: str = ""
    update_p50_ms: float = 0.0
    update_p99_ms: float = 0.0


_NAMES: Final = [field.name for field in dataclasses.fields(ActorStatistics)]
_BLANK: Final = dataclasses.asdict(ActorStatistics())


class _Newest:
    """The newest `count_max` integers of many."""

    __slots__ = ("_count", "_ring")

    def __init__(self, count_max: int) -> None:
        self._ring = array("q", bytes(8 * count_max))
        self._count = 0

    def add(self, number: int) -> None:
        """Keep a number, in place of the oldest one if there are too many."""
        self._ring[self._count % len(self._ring)] = number
        self._count += 1

    @property
    def full(self) -> bool:
        """Whether there may have been more than are kept."""
        return self._count >= len(self._ring)

    def ascending(self) -> list[int]:
        """Return what is kept, smallest first."""
        return sorted(self._ring[: self._count])


class RateMeter:
    """Events per second over the last `RATE_WINDOW_NS`."""

    __slots__ = ("_stamps_ns", "_start_ns")

    def __init__(self, *, start_ns: int) -> None:
        self._start_ns = start_ns
        self._stamps_ns = _Newest(STAMPS_MAX)

    def count(self, now_ns: int) -> None:
        """Count one event."""
        self._stamps_ns.add(now_ns)

    def rate_hz(self, now_ns: int) -> float:
        """Return the rate as of `now_ns`; over the time since the start while that is shorter."""
        since_ns = max(self._start_ns, now_ns - RATE_WINDOW_NS)
        stamps_ns = self._stamps_ns.ascending()
        if self._stamps_ns.full:
            # A full ring reaches back less than the window: older events are unknown, not absent.
            since_ns = max(since_ns, stamps_ns[0])
        recent = len(stamps_ns) - bisect_left(stamps_ns, since_ns)
        span_s = max(now_ns - since_ns, 1_000_000) / 1e9
        return recent / span_s


class ActorRecord:
    """Collects what `ActorStatistics` shows.  One thread writes it, any may take a snapshot.

    Attributes:
        state: As of `ActorStatistics`.
        skipped: As of `ActorStatistics`.
    """

    def __init__(self, name: str, *, now_ns: int) -> None:
        self._name = name
        self.state = "starting"
        self.skipped = 0
        self._counts: dict[str, Any] = dict.fromkeys(
            ("updates", "failures", "refused", "unknown", "missed"), 0
        )
        self._last_error = ""
        self._last_update_ns = self._last_update_unix_ns = 0
        self._rate = RateMeter(start_ns=now_ns)
        self._waits_ns = _Newest(WAITS_MAX)
        self._updates_ns = _Newest(WAITS_MAX)

    def waited(self, wait_ns: int) -> None:
        """Record how long a lock took to be granted or refused."""
        self._waits_ns.add(wait_ns)

    def updated(self, *, took_ns: int, now_ns: int, wall_ns: int) -> None:
        """Record an update that committed."""
        self._counts["updates"] += 1
        self._last_update_ns = took_ns
        self._updates_ns.add(took_ns)
        self._last_update_unix_ns = wall_ns
        self._rate.count(now_ns)

    def failed(self, error: BaseException) -> None:
        """Record an update that ended with an exception of its own."""
        self._counts["failures"] += 1
        self._keep(error)

    def refused(self, error: BaseException) -> None:
        """Record an attempt that ended outside the actor's code."""
        self._counts["refused"] += 1
        self._counts["unknown"] += isinstance(error, CommitUnknownError)
        self._keep(error)

    def missed(self, ticks: int) -> None:
        """Record ticks of a source that did not run, or whose update was refused."""
        self._counts["missed"] += ticks

    def snapshot(self, now_ns: int) -> ActorStatistics:
        """Return what was recorded so far."""
        waits_ns, updates_ns = self._waits_ns.ascending(), self._updates_ns.ascending()
        return ActorStatistics(
            name=self._name,
            state=self.state,
            skipped=self.skipped,
            **self._counts,
            last_error=self._last_error,
            rate_hz=round(self._rate.rate_hz(now_ns), 3),
            last_update_s=self._last_update_ns / 1e9,
            last_update_unix_s=self._last_update_unix_ns / 1e9,
            lock_wait_p50_ms=percentile(waits_ns, 0.50) / 1e6,
            lock_wait_p99_ms=percentile(waits_ns, 0.99) / 1e6,
            update_p50_ms=percentile(updates_ns, 0.50) / 1e6,
            update_p99_ms=percentile(updates_ns, 0.99) / 1e6,
        )

    def _keep(self, error: BaseException) -> None:
        self._last_error = f"{type(error).__name__}: {error}"[:ERROR_LENGTH_MAX]


class ReportBoard:
    """The newest reports of all actors that share a cell's session, by actor name."""

    _boards: ClassVar[WeakKeyDictionary[Cell, ReportBoard]] = WeakKeyDictionary()
    _making: ClassVar[threading.Lock] = threading.Lock()

    def __init__(self) -> None:
        self._posted: dict[str, ActorStatistics] = {}
        self._guard = threading.Lock()

    @classmethod
    def of(cls, cell: Cell) -> ReportBoard:
        """Return the board of a cell."""
        with cls._making:
            return cls._boards.setdefault(cell, cls())

    def post(self, cell: Cell, statistics: ActorStatistics) -> None:
        """Replace the report of one actor, and report all."""
        with self._guard:
            self._posted[statistics.name] = statistics
            client = session_behind(cell).client
            client.set_report(encode_reports(list(self._posted.values())))


def percentile(ascending: list[int], part: float) -> int:
    """Return the smallest entry that at least `part` of all entries do not exceed; 0 of none."""
    if not ascending:
        return 0
    rank = -(-len(ascending) * round(part * 1000) // 1000)
    return ascending[max(0, rank - 1)]


def encode_reports(reports: list[ActorStatistics]) -> bytes:
    """Return the reports of all actors of one session as msgpack, short enough to be listed.

    If whole reports do not fit, declared writes are left out first; then errors are shortened and
    blank fields dropped; then only names and states stay; finally the remaining actors are counted.
    """
    rows = [{name: getattr(report, name) for name in _NAMES} for report in reports]
    encoded = _packed(rows)
    if len(encoded) > REPORT_BYTES_MAX:
        rows = [{name: row[name] for name in row if name != "writes"} for row in rows]
        encoded = _packed(rows)
    for shorten in (_brief, _named):
        if len(encoded) > REPORT_BYTES_MAX:
            rows = [shorten(row) for row in rows]
            encoded = _packed(rows)
    shown = len(rows)
    while len(encoded) > REPORT_BYTES_MAX:
        shown = shown * 9 // 10
        encoded = _packed(rows[:shown], left_out=len(rows) - shown)
    return encoded


def _packed(rows: list[dict[str, Any]], **more: int) -> bytes:
    encoded: bytes = msgpack.packb({"version": REPORT_VERSION, "actors": rows, **more})
    return encoded


def _brief(row: dict[str, Any]) -> dict[str, Any]:
    return {
        name: value[:BRIEF_LENGTH_MAX] if isinstance(value, str) and name != "name" else value
        for name, value in row.items()
        if value != _BLANK[name]
    }


def _named(row: dict[str, Any]) -> dict[str, Any]:
    return {name: row[name] for name in ("name", "state") if name in row}


def read_reports(report: Mapping[str, object]) -> tuple[ActorStatistics, ...]:
    """Return the reports in an unpacked one, such as `ActorInfo.report`; nothing of an empty one.

    Unknown fields are ignored, so an older `enact actor ls` still shows a newer actor.

    Raises:
        ProtocolError: This is no actor report.
    """
    if report == {}:
        return ()
    rows: Any
    blank = _BLANK
    try:
        rows = report["actors"]
        return tuple(
            ActorStatistics(
                **{name: type(blank[name])(found) for name, found in row.items() if name in blank}
            )
            for row in rows
        )
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        raise ProtocolError(f"{reprlib.repr(report)} is no actor report: {error}") from error
