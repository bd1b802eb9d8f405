"""`enact world watch`: shows the changes of a world context as they arrive, with data or rates."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from enact_dist.access.watch import Change, Watch
from enact_dist.cli.target import open_cell
from enact_dist.cli.text.output import print_json_line, print_table, shown_bytes
from enact_dist.cli.text.rates import Rates, Sample, Tally
from enact_dist.cli.verbs import DONE
from enact_dist.config.table import suggestion
from enact_dist.core.protocol.datum import Slot
from enact_dist.errors import LinkError, ProtocolError, ShardUnreachableError
from enact_dist.link.signals import StopSignals
from enact_dist.wire.payload import decode_untyped
from enact_dist.world.cell import session_behind
from enact_dist.world.trees import shown_s
from enact_dist.world.version_data import Retained, Wanted, explained, found_of

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterable, Iterator

    from enact_dist.access.session import Session
    from enact_dist.world.cell import Cell
    from enact_dist.world.context import WorldContext

WATCH_SLICE_S: Final = 0.2
"""How soon a watch notices a signal."""
TOGETHER_MAX: Final = 256
"""So many changes that have come are shown together: their data and sizes are asked for at once."""

LINES_IN_ONE_MAX: Final = 8
ONE_LINE_MAX: Final = 80
"""A datum of so few lines and characters stands behind its change, any other one below it."""


def watch_world(options: argparse.Namespace) -> int:
    """Print changes as they arrive, until a signal or one of the limits ends the watch."""
    with StopSignals() as stop, open_cell(options) as cell:
        world = cell.world(options.world)
        aspects = tuple(dict.fromkeys(options.aspect or ()))
        _tell_unknown(aspects, cell)
        shown = _Statistics(world, options) if options.stats else _Lines(world, options)
        client = world.session.client
        with Watch(client, (world.name,), (options.pattern,), aspects) as watch:
            begun_s = time.monotonic()
            if isinstance(shown, _Statistics):
                shown.begin(_here(watch))
            for changes in _coming(watch, options, stop):
                shown.show(changes)
            shown.end(time.monotonic() - begun_s)
    return DONE


def _tell_unknown(wanted: Iterable[str], cell: Cell) -> None:
    """Name the aspects that no shard knows yet: their first datum may never arrive."""
    known = session_behind(cell).registered()
    for name in wanted:
        if name not in known:
            close = suggestion(name, known)
            print(
                f"enact: no shard knows an aspect {name!r} yet{close}; waiting for its first datum",
                file=sys.stderr,
                flush=True,
            )


def _here(watch: Watch) -> Iterator[Change]:
    while (change := watch.next_here()) is not None:
        yield change


def _coming(watch: Watch, options: argparse.Namespace, stop: StopSignals) -> Iterator[list[Change]]:
    """Yield the changes that have come, none at times, until a signal or until it is enough."""
    left = options.count if options.count is not None else math.inf
    ends_s = time.monotonic() + (options.seconds or math.inf)
    while left and not stop.event.is_set():
        wait_s = ends_s - time.monotonic()
        if wait_s <= 0.0:
            return
        first = watch.next(min(WATCH_SLICE_S, wait_s))
        changes = [first] if first is not None else []
        while changes and len(changes) < min(left, TOGETHER_MAX):
            change = watch.next_here()
            if change is None:
                break
            changes.append(change)
        left -= len(changes)
        yield changes


@dataclass(slots=True)
class _Seen:
    """What there was in all."""

    changes: int = 0
    missed: int = 0
    slots: set[Slot] = field(default_factory=set)

    def add(self, changes: Iterable[Change]) -> None:
        for change in changes:
            self.changes += 1
            self.missed += change.gap
            self.slots.add(_slot(change))

    def line(self, seconds: float) -> str:
        missed = f", {self.missed} versions not seen" if self.missed else ""
        data = f" of {len(self.slots)} data" if self.changes else ""
        return f"watched {shown_s(seconds)}: {self.changes} changes{data}{missed}"


def _slot(change: Change) -> Slot:
    return Slot(change.world, change.entity.name, change.aspect)


def _wanted(changes: Iterable[Change]) -> dict[Wanted, Change]:
    """Return the versions that have a datum, with their changes."""
    return {
        Wanted(change.position.stamp_ns, _slot(change), change.version, change.position.shard): (
            change
        )
        for change in changes
        if not change.null
    }


# ---------------------------------------------------------------- changes, data


class _Lines:
    """One line per change, and its datum where that is asked for."""

    def __init__(self, world: WorldContext, options: argparse.Namespace) -> None:
        self._session = world.session
        self._as_json, self._with_data = options.json, options.data
        self._seen = _Seen()

    def show(self, changes: list[Change]) -> None:
        if not changes:
            return
        self._seen.add(changes)
        found = _found(self._session, changes) if self._with_data else {}
        wanted = {id(change): each for each, change in _wanted(changes).items()}
        for change in changes:
            datum = found.get(wanted[id(change)]) if id(change) in wanted else None
            if self._as_json:
                print_json_line(_facts(change) | self._datum_facts(change, datum))
            else:
                self._print(change, datum)

    def _datum_facts(self, change: Change, datum: object) -> dict[str, object]:
        from enact_dist.cli.text.showing import plain

        if not self._with_data:
            return {}
        if isinstance(datum, _Absent):
            return {"datum": None, "datum_missing": datum.reason}
        return {"datum": None if change.null else plain(datum)}

    def _print(self, change: Change, datum: object) -> None:
        from enact_dist.cli.text.showing import lines, one_line

        head = _line(change)
        if not self._with_data or change.null:
            print(head, flush=True)
        elif isinstance(datum, _Absent):
            print(f"{head}  ({datum.reason})", flush=True)
        else:
            below = [line for each in lines(datum) for line in each.splitlines() or [""]]
            alone = one_line(datum) if len(below) <= LINES_IN_ONE_MAX else ""
            if len(below) > 1 and (not alone or "\n" in alone or len(alone) > ONE_LINE_MAX):
                print(head, *below, sep="\n    ", flush=True)
            else:
                print(f"{head}  {alone}", flush=True)

    def end(self, seconds: float) -> None:
        if not self._as_json:
            print(self._seen.line(seconds), file=sys.stderr, flush=True)


@dataclass(frozen=True, slots=True)
class _Absent:
    """The reason for the missing datum."""

    reason: str


def _found(session: Session, changes: Iterable[Change]) -> dict[Wanted, object]:
    """Return the data of changes, or why one is absent."""
    wanted = _wanted(changes)
    try:
        found = found_of(session, list(wanted))
    except ShardUnreachableError as error:
        return dict.fromkeys(wanted, _Absent(str(error)))
    return {each: _datum(found.get(each)) for each in wanted}


def _datum(found: Retained | None) -> object:
    if found is None or found.datum is None:
        return _Absent("replaced and no longer retained before it could be fetched")
    try:
        return decode_untyped(found.datum)
    except ProtocolError as error:
        return _Absent(str(error))


def _facts(change: Change) -> dict[str, object]:
    return {
        "world": change.world,
        "entity": change.entity.name,
        "aspect": change.aspect,
        "version": change.version,
        "stamp_ns": change.position.stamp_ns,
        "captured_ns": change.captured_ns,
        "shard": change.position.shard,
        "gap": change.gap,
        "null": change.null,
    }


def _line(change: Change) -> str:
    stamp_s, nanoseconds = divmod(change.position.stamp_ns, 1_000_000_000)
    clock = time.strftime("%H:%M:%S", time.localtime(stamp_s))
    null = "  NULL" if change.null else ""
    gap = f"  ({change.gap} versions not seen)" if change.gap else ""
    return (
        f"{clock}.{nanoseconds // 1_000_000:03d}  {change.world}:{change.entity}/{change.aspect}"
        f"  v{change.version}{null}{gap}"
    )


# ---------------------------------------------------------------- statistics


class _Statistics:
    """Rates, periods, delays, sizes and bandwidths, now and then and at the end."""

    def __init__(self, world: WorldContext, options: argparse.Namespace) -> None:
        self._world, self._session = world.name, world.session
        self._as_json, self._every_s = options.json, options.every
        self._rates = Rates()
        self._seen = _Seen()
        self._sizes: dict[Slot, int] = {}
        self._begun_s = time.monotonic()
        self._due_s = self._begun_s + self._every_s

    def begin(self, changes: Iterable[Change]) -> None:
        """Take the initial data, which are no change."""
        self._rates.there(_slot(change) for change in changes if not change.null)

    def show(self, changes: list[Change]) -> None:
        if changes:
            self._seen.add(changes)
            self._add(changes)
        now_s = time.monotonic()
        if now_s >= self._due_s:
            self._due_s = now_s + self._every_s
            self._print(self._rates.recent(now_s), now_s - self._begun_s, end=False)

    def _add(self, changes: list[Change]) -> None:
        wanted = _wanted(changes)
        try:
            entries = explained(self._session, list(wanted))
        except LinkError:  # the size of the version before stands in for those
            entries = {}
        now_s = time.monotonic()
        sizes = {id(wanted[each]): entry.state.size for each, entry in entries.items()}
        for change in changes:
            if not change.position.stamp_ns:
                continue  # a volatile slot that ended with its shard: nothing was committed
            slot = _slot(change)
            size = 0 if change.null else sizes.get(id(change), self._sizes.get(slot, 0))
            self._sizes[slot] = size or self._sizes.get(slot, 0)
            sample = Sample(change.position.stamp_ns, change.gap, size, change.captured_ns)
            self._rates.add(slot, sample, now_s)

    def end(self, seconds: float) -> None:
        self._print(self._rates.whole(), seconds, end=True)

    def _print(self, tallies: dict[Slot, Tally], seconds: float, *, end: bool) -> None:
        if self._as_json:
            rows = [_rate_facts(slot, tally) for slot, tally in tallies.items()]
            facts = {"world": self._world, "seconds": round(seconds, 3), "end": end, "data": rows}
            print_json_line(facts)
            return
        over = self._seen.line(seconds) if end else f"after {shown_s(seconds)}"
        print(over)
        print_table(_COLUMNS, [_rate_row(*row) for row in tallies.items()], empty="no datum so far")
        print(flush=True)


_COLUMNS: Final = (
    "datum", "rate", "period", "jitter", "delay", "size", "bandwidth", "changes", "not seen", "last"
)  # fmt: skip


def _rate_row(slot: Slot, tally: Tally) -> tuple[str, ...]:
    rate_hz, bandwidth = tally.rate_hz, tally.bandwidth_bytes_s
    jitter_s, delay_s = tally.period_std_s, tally.delay_s
    has_period = tally.period_max_s > 0.0
    ago = f"{shown_s(max(0.0, time.time() - tally.last_ns / 1e9))} ago"
    return (
        f"{slot.entity}/{slot.aspect}",
        f"{rate_hz:.3g} Hz" if rate_hz is not None else "-",
        f"{shown_s(tally.period_min_s)} to {shown_s(tally.period_max_s)}" if has_period else "-",
        shown_s(jitter_s) if jitter_s is not None else "-",
        shown_s(delay_s) if delay_s is not None else "-",
        shown_bytes(tally.size_bytes) if tally.size_bytes else "-",
        f"{shown_bytes(bandwidth)}/s" if bandwidth else "-",
        str(tally.changes),
        str(tally.missed) if tally.missed else "-",
        ago if tally.changes else "-",
    )


def _rate_facts(slot: Slot, tally: Tally) -> dict[str, Any]:
    has_period = tally.period_max_s > 0.0
    return {
        "entity": slot.entity,
        "aspect": slot.aspect,
        "changes": tally.changes,
        "missed": tally.missed,
        "rate_hz": tally.rate_hz,
        "period_min_s": tally.period_min_s if has_period else None,
        "period_max_s": tally.period_max_s if has_period else None,
        "jitter_s": tally.period_std_s,
        "delay_s": tally.delay_s,
        "size_bytes": tally.size_bytes,
        "bandwidth_bytes_s": tally.bandwidth_bytes_s,
        "last_ns": tally.last_ns,
    }
