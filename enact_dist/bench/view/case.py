"""Bench `view`: what `enact view` shows of a cell, and what an update and the cell pay for it.

One process writes eight VGA images with masks, a hull and two robots at 10 Hz; another is woken by
each hull and reads the images, as an actor would.  Rounds without and with an open page alternate.
The page is read by a process that takes everything and draws nothing, so that the figures are those
of the view; at the end a headless Chromium, where there is one, draws it in software on the same
processors, once as viser adapts the resolution and once at half of it.  The parts of an update are
the threads of the view by their names.
"""

from __future__ import annotations

import json
import math
import statistics
import time
from collections import Counter
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Final

from enact_dist.bench.place import Place, fresh_place
from enact_dist.bench.rows import Case, at_most, sample_of, value_row
from enact_dist.bench.usage import private_bytes, threads_ns
from enact_dist.bench.view.worker import CHROMIUM, SHOWS
from enact_dist.errors import MisuseError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from enact_dist.bench.run import Run
    from enact_dist.verify.daemons import LineProcess

NAME: Final = "view"
WORKER: Final = "enact_dist.bench.view.worker"
TIMES: Final = 20
"""The rounds together run this many times as long as a line of another bench: 60 s by default."""
ROUNDS: Final = 3
SETTLE_S: Final = 2.0
"""A page that opens is sent everything at once; that is no update."""
SHOWN_S: Final = 120.0
WARM_UP_S: Final = 20.0
"""For so long an open page takes memory for the first time."""
HZ_MIN: Final = 8.0
UPDATE_MS_MAX: Final = 10.0
FIRST_S_MAX: Final = 3.0
TIMES_P99_MAX: Final = 1.1
IDLE_PERCENT_MAX: Final = 0.5
GROWTH_MB_MAX: Final = 5.0
RESOLUTIONS: Final = {"": "", "/?fixedDpr=0.5": ", half the resolution"}
"""What the address of a page in Chromium ends with, and the name of its row."""
PARTS: Final = {
    "view feed": "fetch and decode",
    "view page": "convert, encode, compose",
    "view server": "pack and send",
    "view activity": "locks, actors and shards",
}
OTHERS: Final = "threads of the connection"


@dataclass(slots=True)
class _Found:
    """What all rounds found.

    Attributes:
        spans: Begin and end of each round without and with a page, `perf_counter_ns`.
        spent: Processor time of the threads of the view, nanoseconds, without and with a page.
        updates: (time, bytes) of each update, of all rounds with a page.
        memory: (seconds for which a page was open, bytes), private to the view.
    """

    spans: dict[bool, list[tuple[int, int]]] = field(default_factory=lambda: {False: [], True: []})
    spent: dict[bool, Counter[str]] = field(
        default_factory=lambda: {False: Counter(), True: Counter()}
    )
    updates: list[tuple[int, int]] = field(default_factory=list)
    memory: list[tuple[float, int]] = field(default_factory=list)

    def seconds(self, *, shown: bool) -> float:
        """How long the rounds of a side took together."""
        return sum(end - begin for begin, end in self.spans[shown]) / 1e9

    def within(self, times: Sequence[Sequence[int]], *, shown: bool) -> list[list[int]]:
        """Return the second number of those whose first lies in a round of a side, by round."""
        return [
            [one[1] for one in times if begin <= one[0] < end] for begin, end in self.spans[shown]
        ]


def run_view(run: Run) -> None:
    """Measure the view of one scene.

    Raises:
        MisuseError: viser is not installed.
    """
    if find_spec("viser") is None:
        raise MisuseError(
            "bench view needs viser, which is not installed; install its extra: pip install -e"
            " '.[view]' in the clone of enact-dist"
        )
    with _scene(run, "writer", "follower", "page") as (place, file, (writer, follower, page)):
        firsts_s = [_first_picture_s(run, place, file, page) for _ in range(ROUNDS)]
        found = _rounds(run, place, file, page)
        commits, sets = _did(writer), _did(follower)
    _add_updates(run, found)
    _add_cell(run, found, commits, "commit of the cell")
    _add_cell(run, found, sets, "tick to eight images read")
    _add_first(run, firsts_s)
    _add_memory(run, found)
    _add_browser(run)


@contextmanager
def _scene(run: Run, *roles: str) -> Iterator[tuple[Place, Path, list[LineProcess]]]:
    """Give a cell with processes in these roles, and its file with what the data look like."""
    with fresh_place(run.place.carrier) as (place, _):
        place.world(place.carrier)
        file = place.folder / "view.toml"
        file.write_text((place.folder / "cell.toml").read_text() + SHOWS)
        asked: list[tuple[str, dict[str, Any]]] = [(role, {}) for role in roles]
        with place.workers(asked, carrier=place.carrier, module=WORKER) as workers:
            yield place, file, workers


def _did(process: LineProcess) -> Any:
    """Let a process end its round; return what it says of it."""
    process.tell("")
    return json.loads(process.expect("did:"))


def _first_picture_s(run: Run, place: Place, file: Path, page: LineProcess) -> float:
    """Start the view, open its page at once, and return how long the first update took."""
    run.told("view: first picture")
    begun_ns = time.perf_counter_ns()
    with place.command("view", str(file), "--port", "0") as view:
        page.tell(view.expect("bench:"))
        shown_ns = int(page.expect("shown:", timeout_s=SHOWN_S))
        _did(page)
    return (shown_ns - begun_ns) / 1e9


def _rounds(run: Run, place: Place, file: Path, page: LineProcess) -> _Found:
    found, length_s = _Found(), TIMES * run.seconds_s / (2 * ROUNDS)
    open_s = 0.0
    with place.command("view", str(file), "--port", "0") as view:
        url = view.expect("bench:")
        for number in range(2 * ROUNDS):
            shown = number % 2 == 1
            run.told(f"view: {'with' if shown else 'without'} a page, {length_s:g} s")
            if shown:
                page.tell(url)
                page.expect("shown:", timeout_s=SHOWN_S)
                time.sleep(SETTLE_S)
                open_s += SETTLE_S
            before, begun_ns = threads_ns(view.pid), time.perf_counter_ns()
            while (passed_s := (time.perf_counter_ns() - begun_ns) / 1e9) < length_s:
                if shown:
                    found.memory.append((open_s + passed_s, private_bytes(view.pid)))
                time.sleep(min(1.0, length_s - passed_s))
            found.spent[shown] += threads_ns(view.pid) - before
            found.spans[shown].append((begun_ns, time.perf_counter_ns()))
            if shown:
                open_s += length_s
                found.updates += _did(page)
    return found


# ---------------------------------------------------------------- rows


def _add_updates(run: Run, found: _Found) -> None:
    sizes = [size for sizes in found.within(found.updates, shown=True) for size in sizes]
    count, shown_s = len(sizes), found.seconds(shown=True)
    hz = count / shown_s
    note = f"{sum(sizes) / shown_s / 1e6:.2f} MB/s"
    goal = f"≥ {HZ_MIN:g} Hz"
    title = "updates sent to a page"
    run.add_row(
        value_row(NAME, title, round(hz, 2), "Hz", count, goal, met=hz >= HZ_MIN, note=note)
    )
    parts = _parts(found.spent[True])
    whole_ms = sum(parts.values()) / max(count, 1) * 1e3
    goal, met = f"≤ {UPDATE_MS_MAX:g} ms", bool(count) and whole_ms <= UPDATE_MS_MAX
    title = "processor time of an update"
    run.add_row(value_row(NAME, title, round(whole_ms, 2), "ms", count, goal, met=met))
    for part, seconds in parts.items():
        part_ms = round(seconds / max(count, 1) * 1e3, 2)
        run.add_row(value_row(NAME, f"of it: {part}", part_ms, "ms", count))
    idle_s = found.seconds(shown=False)
    percent = found.spent[False].total() / 1e7 / idle_s
    goal, met = f"≤ {IDLE_PERCENT_MAX:g} % of a core", percent <= IDLE_PERCENT_MAX
    title = "processor time without a page"
    run.add_row(value_row(NAME, title, round(percent, 2), "%", round(idle_s), goal, met=met))


def _parts(spent: Mapping[str, int]) -> dict[str, float]:
    """Return the seconds of each part of the view's work, from those of its threads."""
    parts = {part: spent.get(thread, 0) / 1e9 for thread, part in PARTS.items()}
    parts[OTHERS] = sum(spent.values()) / 1e9 - sum(parts.values())
    return parts


def _add_cell(run: Run, found: _Found, times: Sequence[Sequence[int]], what: str) -> None:
    """Add times of the cell, (when it was due, how long it took) in ns, without and with a page."""
    sides = {
        shown: [one for one in found.within(times, shown=shown) if one] for shown in (False, True)
    }
    if not all(sides.values()):
        run.add_row(value_row(NAME, what, None, "µs", 0, note="none ended in a round: too short"))
        return
    without = sample_of([time_ns / 1e3 for one in sides[False] for time_ns in one])
    text = f"p99 ≤ {TIMES_P99_MAX:g} x without a page"
    goal = at_most(math.inf, text, p99_us=TIMES_P99_MAX * without.p99_us)
    alone = Case(NAME, f"{what}, no page", lambda _seconds_s: ())
    beside = (alone.key, "no page")
    watched = Case(NAME, f"{what}, a page open", alone.measure, None, goal, beside=beside)
    for case, rounds in zip((alone, watched), sides.values(), strict=True):
        for one in rounds:
            run.add(case, [time_ns / 1e3 for time_ns in one])


def _add_first(run: Run, firsts_s: Sequence[float]) -> None:
    first_s, note = statistics.median(firsts_s), ", ".join(f"{one:.2f}" for one in firsts_s)
    goal, met = f"≤ {FIRST_S_MAX:g} s", first_s <= FIRST_S_MAX
    title = "first picture after the command"
    count = len(firsts_s)
    run.add_row(value_row(NAME, title, round(first_s, 2), "s", count, goal, met=met, note=note))


def _add_memory(run: Run, found: _Found) -> None:
    warm = [(at_s, used) for at_s, used in found.memory if at_s >= WARM_UP_S]
    last_s, last = found.memory[-1]
    run.add_row(
        value_row(
            NAME, f"memory after {last_s:.0f} s with a page", round(last / 1e6, 1), "MB",
            len(found.memory),
        )
    )  # fmt: skip
    grown_mb = (last - warm[0][1]) / 1e6 if len(warm) > 1 else None
    run.add_row(
        value_row(
            NAME,
            f"growth of memory after {WARM_UP_S:g} s",
            round(grown_mb or 0.0, 2) + 0.0,
            "MB",
            len(warm),
            f"none (≤ {GROWTH_MB_MAX:g} MB)",
            met=None if grown_mb is None else grown_mb <= GROWTH_MB_MAX,
            note="" if grown_mb is not None else "too short to tell",
        )
    )


def _add_browser(run: Run) -> None:
    title = "updates shown in Chromium, drawn in software"
    if find_spec("playwright") is None or not CHROMIUM.exists():
        note = f"playwright or {CHROMIUM} is missing"
        run.add_row(value_row(NAME, title, None, "Hz", 0, note=note))
        return
    length_s = TIMES * run.seconds_s / (2 * ROUNDS) / len(RESOLUTIONS)
    with (
        _scene(run, "writer", "browser") as (place, file, (_, browser)),
        place.command("view", str(file), "--port", "0") as view,
    ):
        url = view.expect("bench:").strip()
        for query, name in RESOLUTIONS.items():
            run.told(f"view: in Chromium{name}, {length_s:g} s")
            begun_ns = time.perf_counter_ns()
            browser.tell(url + query)
            opened_s = (int(browser.expect("shown:", timeout_s=SHOWN_S)) - begun_ns) / 1e9
            time.sleep(SETTLE_S)
            browser.tell("")
            time.sleep(length_s + 1.0)
            did = _did(browser)
            hz = min(statistics.fmean(did["updates"] or [0.0]), did["frames_s"])
            note, count = f"{did['frames_s']:.1f} frames/s", round(hz * length_s)
            goal, met = f"≥ {HZ_MIN:g} Hz", hz >= HZ_MIN
            shown = title + name
            run.add_row(value_row(NAME, shown, round(hz, 2), "Hz", count, goal, met=met, note=note))
            first = "first text in Chromium after its page was opened"
            run.add_row(value_row(NAME, first + name, round(opened_s, 2), "s", 1))
