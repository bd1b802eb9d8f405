"""Bench `history`: what it costs that replaced data stay, and what it takes to look at them.

Updates with and without history are measured in turn.  So are those beside eight cameras, which
write their images in blocks with history and without; that cell has a small cap of shared memory,
so that history fills it within seconds and its oldest data go all the time.
"""

from __future__ import annotations

import contextlib
import json
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from enact_dist.access.lock import Lock
from enact_dist.bench.cases.updates import WAIT_S, floor_of, update
from enact_dist.bench.place import EMBEDDED, WORLD, Place, environment, fresh_place
from enact_dist.bench.rows import Case, Goal, Key, times, value_row
from enact_dist.bench.timing import repeating, timed
from enact_dist.bench.usage import Usage, growth_row
from enact_dist.errors import UnknownWorldError
from enact_dist.retention import Retention
from enact_dist.terms import Aspect, Durability, Entity, View, Write
from enact_dist.world.forks import drop_world

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from enact_dist.bench.run import Run
    from enact_dist.core.protocol.datum import Position
    from enact_dist.world.context import WorldContext

    Measure = Callable[[float], Sequence[float]]

NAME: Final = "history"
MANY: Final = 1_000
KEPT: Final[dict[str, int | None]] = {
    "without history": 1,
    "with history": None,
    f"with {MANY:,} versions": MANY,
}
"""How many versions stay; None: the default."""
ITS_COST: Final = "≤ 1.1 x without"
FORKED: Final = 100
"""Slots of a context that is forked."""
FORKED_BYTES: Final = {"1 kB": 1_000, "0.9 MB": 921_600}

CAMERAS: Final = 8
PERIOD_NS: Final = 100_000_000
IMAGE_BYTES: Final = 480 * 640 * 3
TIMES: Final = 20
"""Cameras run this many times as long as a line of another bench: 60 s by default."""
BLOCK_TICKS: Final = 20
HEAD_START_NS: Final = 1_500_000_000
PAUSE_S: Final = 0.005
CAP_BYTES: Final = 256_000_000
CAP_VARIABLE: Final = "ENACT_SHARED_BYTES_MAX"

IMAGES: Final[tuple[Aspect[Any], Aspect[Any]]] = (
    Aspect("history_image", np.ndarray, Durability.VOLATILE, Retention(age_s=600.0)),
    Aspect("history_image_bare", np.ndarray, Durability.VOLATILE, retention=1),
)
"""Images with history, as far as memory goes, and without."""
COUNTS: Final = (
    Aspect("history_count", int, Durability.VOLATILE),
    Aspect("history_count_bare", int, Durability.VOLATILE, retention=1),
)
SIDES: Final = ("with history", "without history")
BESIDE: Final = "update beside 8 cameras, {}"


def run_history(run: Run) -> None:
    """Measure updates with history and without, looks at the past, forks, and camera traffic."""
    carrier = EMBEDDED if run.place.embedded else run.place.carrier
    world, floor = run.place.world(carrier), floor_of(run.place.way(carrier))
    run.measure([case for durability in Durability for case in _updates(world, floor, durability)])
    run.measure([*_looks(world, floor), *_forks(run, carrier, floor)])
    if run.place.own and not run.place.embedded:
        _run_cameras(run, floor)


# ---------------------------------------------------------------- updates


def _updates(world: WorldContext, floor: Key, durability: Durability) -> Iterator[Case]:
    for label, versions in KEPT.items():
        aspect = Aspect(f"history_{durability.value}_{versions or 0}", int, durability, versions)
        write = Write(world, Entity("history"), aspect)
        for _ in range(versions or 1):
            update((write,))  # full from the first measured one on
        measure = repeating(partial(update, (write,)))
        yield Case(NAME, _update(durability, label), measure, floor, _cost(durability, label))


def _update(durability: Durability, label: str) -> str:
    return f"update, {durability.value}, {label}"


def _cost(durability: Durability, label: str) -> Goal | None:
    if KEPT[label] == 1:
        return None
    return times(1.1, (NAME, _update(durability, SIDES[1])), ITS_COST)


# ---------------------------------------------------------------- looks


def _looks(world: WorldContext, floor: Key) -> list[Case]:
    """Return cases that look at a slot of many versions: now, then, and all of them."""
    aspect = Aspect("history_looked_at", int, Durability.VOLATILE, MANY)
    write = Write(world, Entity("history"), aspect)
    positions: list[Position] = []
    for _ in range(MANY):
        with Lock(write, wait_s=WAIT_S) as lock:
            lock[write] = lock.get(write, 0) + 1
        if lock.position is not None:
            positions.append(lock.position)
    past = world.at(positions[MANY // 2])
    views = View(world, write.entity, aspect), View(past, write.entity, aspect)

    def listed() -> None:
        found = world.history(Entity("history"), aspect)
        assert len(found) == MANY, len(found)

    return [
        Case(NAME, what, repeating(act), floor)
        for what, act in (
            ("view of one slot as it is", lambda: world.view(views[0])),
            (f"view as of {MANY // 2} versions ago", lambda: past.view(views[1])),
            (f"list of {MANY:,} versions", listed),
        )
    ]


def _forks(run: Run, carrier: str, floor: Key) -> Iterator[Case]:
    """Yield cases that fork contexts of small and of large data, a time per slot."""
    for label, size in FORKED_BYTES.items():
        name = f"{WORLD}_history_{size}"
        source = run.place.world(carrier, name)
        forked = run.place.unused(carrier, f"{name}_fork")  # it is dropped again and again
        run.place.uses(carrier, forked)
        aspect = Aspect("history_forked", np.ndarray, Durability.VOLATILE)
        for number in range(FORKED):
            write = Write(source, Entity(f"forked/{number}"), aspect)
            with Lock(write, wait_s=WAIT_S) as lock:
                lock[write] = np.zeros(size, np.uint8)
        first = (NAME, _fork(next(iter(FORKED_BYTES))))
        goal = times(1.3, first, "independent of size (≤ 1.3 x 1 kB)") if size > 1_000 else None
        yield Case(NAME, _fork(label), _forking(source, forked), floor, goal)


def _fork(label: str) -> str:
    return f"fork of {FORKED} slots of {label}, per slot"


def _forking(source: WorldContext, name: str) -> Measure:
    def dropped() -> None:
        with contextlib.suppress(UnknownWorldError):
            drop_world(source.session, name)

    def measure(seconds_s: float) -> Sequence[float]:
        found = timed(lambda: source.fork(name), seconds_s, before=dropped)
        dropped()
        return [time_us / FORKED for time_us in found]

    return measure


# ---------------------------------------------------------------- cameras


def _run_cameras(run: Run, floor: Key) -> None:
    """Measure updates beside cameras, and what shared memory and the shard take meanwhile."""
    ticks = max(2 * BLOCK_TICKS, int(TIMES * run.seconds_s * 1e9 / PERIOD_NS))
    run.told(f"history: cameras for {ticks * PERIOD_NS / 1e9:g} s")
    with environment(**{CAP_VARIABLE: str(CAP_BYTES)}), fresh_place() as (place, shared):
        measured = _Cameras(place, shared, ticks)
    for side, found_us in zip(SIDES, measured.times_us, strict=True):
        goal = times(1.1, (NAME, BESIDE.format(SIDES[1])), ITS_COST) if side == SIDES[0] else None
        run.add(Case(NAME, BESIDE.format(side), lambda _seconds_s: (), floor, goal), found_us)
    _add_memory(run, measured)


class _Cameras:
    """One run of the cameras.

    Attributes:
        times_us: Times of the updates beside them, with history and without.
        usage: What the shard and the shared folder took.
        late: How many images came later than the next one was due.
        images: How many there were.
    """

    def __init__(self, place: Place, shared: Path, ticks: int) -> None:
        world = place.world("auto")
        writes = [Write(world, Entity("history"), aspect) for aspect in COUNTS]
        for write in writes:
            update((write,))
        self.times_us: tuple[list[float], list[float]] = ([], [])
        self.images = ticks * CAMERAS
        with place.worker("cameras", carrier="auto", ticks=ticks) as cameras:
            start_ns = time.perf_counter_ns() + HEAD_START_NS
            cameras.tell(str(start_ns))
            self.usage = Usage({"shard": place.daemon_pids()}, shared)
            watcher = threading.Thread(target=self.usage.watch, args=(ticks * PERIOD_NS / 1e9,))
            watcher.start()
            while (tick := (time.perf_counter_ns() - start_ns) // PERIOD_NS) < ticks:
                time.sleep(PAUSE_S)
                side = side_of(tick)
                begun_ns = time.perf_counter_ns()
                update(writes[side : side + 1])
                if tick >= 0:
                    self.times_us[side].append((time.perf_counter_ns() - begun_ns) / 1e3)
            watcher.join()
            self.late = sum(json.loads(cameras.expect("did:", timeout_s=WAIT_S)))


def side_of(tick: int) -> int:
    """Return whether images are written with history (0) or without (1) at a tick."""
    return max(0, tick) // BLOCK_TICKS % 2


def _add_memory(run: Run, measured: _Cameras) -> None:
    usage = measured.usage
    most = max(sample.files_bytes for sample in usage.samples)
    rate = CAMERAS * IMAGE_BYTES / PERIOD_NS * 1e3
    note = f"{measured.late} of {measured.images:,} images late"
    run.add_row(
        value_row(
            NAME,
            f"8 cameras, {rate:.0f} MB/s, shared memory at most",
            round(most / 1e6, 1),
            "MB",
            len(usage.samples),
            f"≤ its cap of {CAP_BYTES / 1e6:g} MB",
            met=most <= CAP_BYTES,
            note=note,
        )
    )
    what = f"8 cameras, {rate:.0f} MB/s, growth of the shard's own memory"
    run.add_row(growth_row(usage, NAME, what, lambda one: one.kinds["shard"].private))
