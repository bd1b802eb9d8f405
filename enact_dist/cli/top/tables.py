"""The tables of `enact top`: which columns each has, and its rows sorted and filtered."""

from __future__ import annotations

import time
from dataclasses import dataclass
from operator import attrgetter, itemgetter
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from enact_dist.cli.lock import LOCK_COLUMNS, lock_rows
from enact_dist.cli.text.output import shown_bytes
from enact_dist.world.trees import shown_s

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from enact_dist.operate.cell_rows import ActorRates, CellRates, DatumRates, ShardRates


class TopColumn(NamedTuple):
    """One column.

    Attributes:
        text: What it shows of a row.
        value: What a row is sorted by; None comes last.
        falls: Whether large values come first.
    """

    name: str
    text: Callable[[Any], str]
    value: Callable[[Any], Any]
    falls: bool = True


@dataclass(frozen=True, slots=True)
class TopTable:
    """One table.

    Attributes:
        key: The key that shows it alone.
        title: What it holds.
        rows: Its rows in what two looks have shown.
        first: The column that it is sorted by, at first.
        empty: What stands in place of no rows.
        of_slots: What of it is as of the newest look at slots, which are looked at less often.
    """

    key: str
    title: str
    columns: tuple[TopColumn, ...]
    rows: Callable[[CellRates], Sequence[Any]]
    first: int
    empty: str
    of_slots: str = ""

    def as_of(self, rates: CellRates) -> str:
        """Return as of when slots are shown, as part of a title; empty: as of now."""
        if not self.of_slots or rates.data_unix_s in (0.0, rates.unix_s):
            return ""
        clock = time.strftime("%H:%M:%S", time.localtime(rates.data_unix_s))
        return f", {self.of_slots} as of {clock}"

    def lines(
        self,
        rates: CellRates,
        most: int,
        *,
        column: int | None = None,
        turned: bool = False,
        only: str = "",
    ) -> tuple[list[tuple[str, ...]], int]:
        """Return the texts of the first rows, and how many rows there are.

        Args:
            rates: What two looks have shown.
            most: At most so many texts are made.
            column: Which column they are sorted by; None: `first`.
            turned: Whether to sort them in the other direction.
            only: Only rows with this text in one of their columns, whatever its case.
        """
        by = self.columns[self.first if column is None else column]
        rows = self.rows(rates)
        known = [row for row in rows if by.value(row) is not None]
        unknown = [row for row in rows if by.value(row) is None]
        known.sort(key=by.value, reverse=by.falls != turned)
        wanted, chosen = only.casefold(), [*known, *unknown]
        if not wanted:
            return [self._texts(row) for row in chosen[:most]], len(chosen)
        lines = [
            line
            for line in map(self._texts, chosen)
            if any(wanted in text.casefold() for text in line)
        ]
        return lines[:most], len(lines)

    def _texts(self, row: Any) -> tuple[str, ...]:
        return tuple(column.text(row) for column in self.columns)


def _per_s(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.0f}/s" if value >= 100.0 else f"{value:.3g}/s"


def _bytes_s(value: float | None) -> str:
    return "-" if value is None else f"{shown_bytes(value)}/s"


def _ms(value: float) -> str:
    return f"{value:.1f} ms" if value else "-"


def _ago(value: float | None) -> str:
    return "-" if value is None else f"{shown_s(value)} ago"


def _name(name: str, attribute: str) -> TopColumn:
    value = attrgetter(attribute)
    return TopColumn(name, lambda row: str(value(row)), value, falls=False)


def _figure(name: str, attribute: str, text: Callable[[Any], str] = str) -> TopColumn:
    value = attrgetter(attribute)
    return TopColumn(name, lambda row: text(value(row)), value)


# ---------------------------------------------------------------- shards, counters


def _shard_state(shard: ShardRates) -> str:
    return f"AWAY for {shown_s(shard.away_s)}" if shard.away_s else shard.state


def _shared(shard: ShardRates) -> str:
    if not shard.shared_bytes_max:
        return "-"
    part = 100.0 * shard.shared_bytes / shard.shared_bytes_max
    limit = shown_bytes(shard.shared_bytes_max)
    return f"{shown_bytes(shard.shared_bytes)} of {limit} ({part:.0f} %)"


def _leases(shard: ShardRates) -> str:
    return ", ".join(f"{name} {count}" for name, count in shard.leases.items() if count) or "-"


_SHARDS: Final = TopTable(
    "s",
    "shards",
    (
        _name("shard", "name"),
        TopColumn("state", _shard_state, _shard_state, falls=False),
        _figure("up", "uptime_s", shown_s),
        _figure("commits", "commits_hz", _per_s),
        _figure("written", "written_bytes_s", _bytes_s),
        _figure("locks", "locks_hz", _per_s),
        _figure("waits", "lock_waits_hz", _per_s),
        _figure("wait p50", "lock_wait_p50_ms", _ms),
        _figure("wait p99", "lock_wait_p99_ms", _ms),
        _figure("held", "locks_held"),
        _figure("waiting", "locks_waiting"),
        TopColumn("shared memory", _shared, attrgetter("shared_bytes")),
        _figure("sessions", "sessions"),
        TopColumn("leases left", _leases, attrgetter("sessions")),
        _figure("slots", "slots"),
    ),
    lambda rates: rates.shards,
    0,
    "no shards",
)

_COUNTERS: Final = TopTable(
    "c",
    "counters that moved",
    (
        _name("shard", "shard"),
        _name("counter", "name"),
        _figure("now", "hz", _per_s),
        _figure("since begin", "moved"),
        _figure("total", "total"),
        TopColumn("what to do", lambda row: row.remedy or "-", lambda row: row.remedy or None,
               falls=False),
        _name("meaning", "meaning"),
    ),
    lambda rates: rates.counters,
    5,
    "no counter has moved",
)  # fmt: skip

# ---------------------------------------------------------------- actors


def _state(actor: ActorRates) -> str:
    return f"{actor.state}, restarts: {actor.restarts}" if actor.restarts else actor.state


_ACTORS: Final = TopTable(
    "a",
    "actors",
    (
        _name("actor", "name"),
        TopColumn("state", _state, _state, falls=False),
        _figure("runs", "runs_hz", _per_s),
        _figure("update p50", "update_p50_ms", _ms),
        _figure("update p99", "update_p99_ms", _ms),
        _figure("wait p99", "lock_wait_p99_ms", _ms),
        _figure("wrote", "wrote_age_s", _ago),
        _figure("missed", "missed"),
        _figure("incomplete", "incomplete"),
        _figure("failures", "failures"),
        _figure("refused", "refused"),
        _figure("restarts", "restarts"),
        _figure("lease left", "lease_left_s", lambda left_s: shown_s(max(0.0, left_s))),
        _name("host", "host"),
        _figure("pid", "pid"),
        TopColumn("last error", lambda row: row.last_error or "-",
                  lambda row: row.last_error or None, falls=False),
    ),
    lambda rates: rates.actors,
    0,
    "no actor is connected",
    "wrote",
)  # fmt: skip

# ---------------------------------------------------------------- locks


_LOCK_VALUES: Final = {
    "lock": "number", "age": "age_s", "lease left": "lease_left_s", "hold left": "hold_left_s"
}  # fmt: skip


def _lock_column(index: int, name: str) -> TopColumn:
    text = itemgetter(index)
    if name in _LOCK_VALUES:
        value = attrgetter(_LOCK_VALUES[name])
        return TopColumn(name, lambda row: text(row[1]), lambda row: value(row[0]))
    return TopColumn(name, lambda row: text(row[1]), lambda row: text(row[1]), falls=False)


_LOCKS: Final = TopTable(
    "l",
    "locks held, waited for and kept",
    tuple(_lock_column(*each) for each in enumerate(LOCK_COLUMNS)),
    lambda rates: list(zip(rates.locks, lock_rows(rates.locks), strict=True)),
    LOCK_COLUMNS.index("age"),
    "no lock is held or awaited",
)

# ---------------------------------------------------------------- data


def _datum(row: DatumRates) -> str:
    return f"{row.world}:{row.entity}/{row.aspect}"


def _storing(row: DatumRates) -> str:
    return f"{row.shard}, AWAY" if row.away else row.shard


_DATA: Final = TopTable(
    "d",
    "data",
    (
        TopColumn("datum", _datum, _datum, falls=False),
        _figure("rate", "hz", _per_s),
        _figure("bandwidth", "bytes_s", _bytes_s),
        _figure("size", "size_bytes", lambda size: shown_bytes(size) if size else "-"),
        TopColumn("version", lambda row: f"v{row.version}", attrgetter("version")),
        TopColumn("age", lambda row: f"NULL ({row.null_reason})" if row.null_reason
               else shown_s(row.age_s), attrgetter("age_s"), falls=False),
        TopColumn("shard", _storing, _storing, falls=False),
    ),
    lambda rates: rates.data,
    1,
    "no data",
    "all",
)  # fmt: skip

TABLES: Final = (_SHARDS, _ACTORS, _LOCKS, _DATA, _COUNTERS)
"""All tables, in the order in which they stand on the screen."""


def headline(rates: CellRates) -> str:
    """Return the cell in one line."""
    known = [shard for shard in rates.shards if not shard.away_s]
    commits = [one.commits_hz for one in known if one.commits_hz is not None]
    waiting = sum(one.locks_waiting for one in known)
    parts = [
        f"{len(known)} of {len(rates.shards)} shards",
        f"{_per_s(sum(commits) if commits else None)} commits",
        f"{len(rates.actors)} actors",
        f"{len(rates.locks) - waiting} locks held, {waiting} waiting",
        f"{len(rates.data)} data",
    ]
    if rates.away:
        parts.append(f"AWAY: {', '.join(one.name for one in rates.away)}")
    return ", ".join(parts)
