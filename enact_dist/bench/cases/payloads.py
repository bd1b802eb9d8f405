"""Benches `fetch`, `publish` and `wakeup`: arrays of some sizes, read and written under locks.

A fetch is divided by mapping a file of that size from shared memory (over the network: by a raw
Zenoh answer of that size), a publication by writing such a file.

A process that has just written 100 MB has emptied the processor's caches of all else, and what
comes next is slow, whatever its size.  So where 100 MB are compared with 1 kB right after they were
written, the 1 kB come after 100 MB that another process wrote elsewhere; how they compare with 1 kB
alone stands beside it.
"""

from __future__ import annotations

import contextlib
import json
import math
import threading
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from enact_dist.access.lock import Lock
from enact_dist.actor.actor import Actor
from enact_dist.actor.running.runner import run_actor
from enact_dist.bench.cases.updates import floor_of
from enact_dist.bench.floors import SIZES, mapped, reply, written
from enact_dist.bench.place import EMBEDDED, WORLD
from enact_dist.bench.rows import Case, Key, at_most, times
from enact_dist.bench.timing import repeating, timed
from enact_dist.terms import Aspect, Durability, Entity, Read, World, Write

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from enact_dist.bench.run import Run
    from enact_dist.verify.daemons import LineProcess
    from enact_dist.world.cell import Cell
    from enact_dist.world.context import WorldContext

    _Woken = Callable[[Cell, Entity, Callable[[], None], Callable[[Any], bool]], None]

SMALL: Final = "1 kB"
LARGEST: Final = "100 MB"
ELSEWHERE: Final = f"after {LARGEST} elsewhere"
ANEW: Final = "{}, written anew"
FILLED: Final = "{}, filled in place, commit alone"
WAIT_S: Final = 60.0
WAKEUPS: Final = {"64 B": (64, 500.0, 0.003), "0.9 MB": (921_600, 800.0, 0.02)}
"""Bytes, goal in microseconds, and seconds between two changes."""


def entity(size: str) -> Entity:
    """Return the entity whose array has that size."""
    return Entity(f"array/{size.replace(' ', '')}")


ARRAY: Final[Aspect[Any]] = Aspect("volatile_array", np.ndarray, Durability.VOLATILE)


def store(world: WorldContext, of: Entity, array: NDArray[Any]) -> None:
    """Write an array under a lock of its own."""
    write = Write(world, of, ARRAY)
    with Lock(write, wait_s=WAIT_S) as lock:
        lock[write] = array


def fetch(world: WorldContext, of: Entity) -> float:
    """Read an array under a lock; return its first element plus its last."""
    read = Read(world, of, ARRAY)
    with Lock(read, wait_s=WAIT_S) as lock:
        return touched(lock[read])


def touched(array: NDArray[Any]) -> float:
    """Return an array's first element plus its last."""
    return float(array[0]) + float(array[-1])


def floats(size: int) -> NDArray[np.float32]:
    """Return an array of so many bytes, of shape (size / 4,), float32."""
    return np.arange(size // 4, dtype=np.float32)


# ---------------------------------------------------------------- fetch


def run_fetch(run: Run) -> None:
    """Read an array: one that this process has seen, one written anew, one from another host."""
    place = run.place
    if EMBEDDED in place.carriers:
        run.measure(_embedded_fetches(place.world(EMBEDDED)))
    if place.embedded:
        return
    with place.worker("storer", carrier=place.carrier) as storer:
        fresh = Storer(storer)
        world = place.world(place.carrier)
        for size in SIZES:
            fresh.store_sized(size)
            fetch(world, entity(size))
        cases = []
        for size in SIZES:
            cases += _fetches(world, size, fresh)
        run.measure([*cases, _small_fetch(world, fresh)])
        with place.far_world() as far:
            run.measure([_far_fetch(far, size, fresh) for size in SIZES])


class Storer:
    """A worker that writes arrays when told to."""

    def __init__(self, worker: LineProcess) -> None:
        self._worker = worker
        self._ordered = False

    def order(self, of: Entity, count: int) -> None:
        """Have an array of `count` bytes written anew, after what was ordered before."""
        self.wait()
        self._worker.tell(f"{of.name} {count}")
        self._ordered = True

    def wait(self) -> None:
        """Wait until what was ordered is written."""
        if self._ordered:
            self._worker.expect("stored:", timeout_s=WAIT_S)
            self._ordered = False

    def store(self, of: Entity, count: int) -> None:
        """Have an array of `count` bytes written anew; return once it is."""
        self.order(of, count)
        self.wait()

    def store_sized(self, size: str) -> None:
        """Have the array of that size written anew; return once it is."""
        self.store(entity(size), SIZES[size])


def _embedded_fetches(world: WorldContext) -> list[Case]:
    goal = at_most(60.0, "≤ 60 µs")
    for size in (SMALL, LARGEST):
        store(world, entity(size), floats(SIZES[size]))
    return [
        Case("fetch", f"embedded, {size}", _fetching(world, size), mapped(size), goal)
        for size in (SMALL, LARGEST)
    ]


def _fetching(
    world: WorldContext, size: str, before: Callable[[], None] | None = None
) -> Callable[[float], Sequence[float]]:
    return repeating(lambda: fetch(world, entity(size)), before=before)


def _fetches(world: WorldContext, size: str, fresh: Storer) -> list[Case]:
    seen = Case("fetch", f"{size}, seen before", _fetching(world, size), mapped(size))
    anew = Case(
        "fetch",
        ANEW.format(size),
        _fetching(world, size, lambda: fresh.store_sized(size)),
        mapped(size),
    )
    if size == LARGEST:
        goal = times(1.3, ("fetch", f"{SMALL}, seen before"), f"≤ 1.3 x {SMALL}")
        seen = replace(seen, goal=goal)
        anew = _beside_small(anew, ANEW)
    return [seen, anew]


def _small_fetch(world: WorldContext, fresh: Storer) -> Case:
    """Return the case of 1 kB written anew, then 100 MB elsewhere, before the 1 kB are read."""

    def before() -> None:
        fresh.store_sized(SMALL)
        fresh.store_sized(LARGEST)

    what = f"{ANEW.format(SMALL)}, {ELSEWHERE}"
    return Case("fetch", what, _fetching(world, SMALL, before), mapped(SMALL))


def _beside_small(case: Case, variant: str) -> Case:
    """Let a case of 100 MB be judged by that of 1 kB after 100 MB elsewhere."""
    small = variant.format(SMALL)
    goal = times(1.3, (case.name, f"{small}, {ELSEWHERE}"), f"≤ 1.3 x {SMALL} {ELSEWHERE}")
    return replace(case, goal=goal, beside=((case.name, small), SMALL))


def _far_fetch(world: WorldContext, size: str, fresh: Storer) -> Case:
    floor: Key = reply(size)
    return Case(
        "fetch",
        f"{size}, written anew, no common memory",
        _fetching(world, size, lambda: fresh.store_sized(size)),
        floor,
        times(1.0 / 0.8, floor, "≥ 0.8 of raw Zenoh"),
    )


# ---------------------------------------------------------------- publish


def run_publish(run: Run) -> None:
    """Write an array under a lock: from `with` to the end of the block."""
    place = run.place
    carrier = EMBEDDED if place.embedded else place.carrier
    world = place.world(carrier)
    cases = []
    for size, count in SIZES.items():
        goal = times(1.2, written(size), "≤ 1.2 x write()") if size == LARGEST else None
        cases.append(Case("publish", size, _storing(world, size, count), written(size), goal))
    run.measure([*cases, *_filled_cases(world, zeroed=not place.embedded)])


def _filled_cases(world: WorldContext, *, zeroed: bool) -> list[Case]:
    """Return the cases of arrays that were filled in place: what their commit alone takes.

    Args:
        world: Where.
        zeroed: Whether a shard hands out memory that it has just set to zero.
    """
    cases = [
        Case("publish", FILLED.format(size), _committing(world, size, count), written(size))
        for size, count in SIZES.items()
    ]
    if not zeroed:
        goal = times(1.3, ("publish", FILLED.format(SMALL)), f"≤ 1.3 x {SMALL}")
        return [*cases[:-1], replace(cases[-1], goal=goal)]
    cases[-1] = _beside_small(cases[-1], FILLED)
    spare = np.zeros(SIZES[LARGEST], np.uint8)
    control = _committing(world, SMALL, SIZES[SMALL], before=lambda: spare.fill(1))
    what = f"{FILLED.format(SMALL)}, {ELSEWHERE}"
    return [*cases, Case("publish", what, control, written(SMALL))]


def _committing(
    world: WorldContext, size: str, count: int, before: Callable[[], None] = lambda: None
) -> Callable[[float], Sequence[float]]:
    write = Write(world, entity(f"new/{size}"), ARRAY)
    filled = floats(SIZES[SMALL])

    def measure(seconds_s: float) -> Sequence[float]:
        with contextlib.ExitStack() as stack:

            def fill() -> None:
                stack.close()  # of the warm-up, or of an attempt that was interrupted
                lock = stack.enter_context(Lock(write, wait_s=WAIT_S))
                array = lock.new(write, (count // 4,), np.float32)
                array[: filled.size] = filled
                array[-1] = 1.0
                before()

            return timed(stack.close, seconds_s, before=fill)

    return measure


def _storing(world: WorldContext, size: str, count: int) -> Callable[[float], Sequence[float]]:
    def measure(seconds_s: float) -> Sequence[float]:
        array = floats(count)
        return timed(lambda: store(world, entity(f"out/{size}"), array), seconds_s)

    return measure


# ---------------------------------------------------------------- wakeup


def run_wakeup(run: Run) -> None:
    """From the commit of a change in one process to another one that has it, under a lock.

    A watch tells of the change, and a lock then fetches it; the notice of a watch that asks for
    data brings it, under no lock; the lock of an actor waits for it.
    """
    floor = floor_of(run.place.way(run.place.carrier))
    ways = {
        "{}": _woken_by_watch,
        "{}, by its notice": _woken_by_notice,
        "{}, as an actor": _woken_as_actor,
    }
    run.measure(
        [
            Case(
                "wakeup",
                way.format(size),
                _waking(run, count, gap_s, woken),
                floor,
                at_most(goal_us, f"≤ {goal_us / 1e3:g} ms"),
            )
            for size, (count, goal_us, gap_s) in WAKEUPS.items()
            for way, woken in ways.items()
        ]
    )


def _waking(run: Run, size: int, gap_s: float, woken: _Woken) -> Callable[[float], Sequence[float]]:
    place, of = run.place, Entity(f"wakeup/{size}")
    place.world(place.carrier)

    def measure(seconds_s: float) -> Sequence[float]:
        count = max(5, math.ceil(seconds_s / (gap_s + 0.002)))
        options: dict[str, Any] = {
            "entity": of.name, "bytes": size, "gap_s": gap_s, "count": count,
        }  # fmt: skip
        found: dict[int, float] = {}

        def take(array: NDArray[np.uint8]) -> bool:
            """Note when an array can be used; return whether it is the last one."""
            # The clock is the same in all processes.
            seq, sent_ns = (int(number) for number in array[:16].view(np.int64))
            had_ns = time.perf_counter_ns()
            if seq >= 0:
                found.setdefault(seq, (had_ns - sent_ns) / 1e3)
            return seq == count - 1

        with place.worker("notifier", carrier=place.carrier, **options) as notifier:
            woken(place.cell(place.carrier), of, lambda: notifier.tell("go"), take)
            notifier.expect("done:", timeout_s=WAIT_S)
        return list(found.values())

    return measure


def _woken_by_watch(
    cell: Cell, of: Entity, begin: Callable[[], None], take: Callable[[Any], bool]
) -> None:
    world, over = cell.world(WORLD), False
    read = Read(world, of, ARRAY)
    with world.watch(of, ARRAY) as watch:
        begin()
        while not over and watch.next(timeout_s=WAIT_S) is not None:
            with Lock(read, wait_s=WAIT_S) as lock:
                over = take(lock[read])


def _woken_by_notice(
    cell: Cell, of: Entity, begin: Callable[[], None], take: Callable[[Any], bool]
) -> None:
    world, over = cell.world(WORLD), False
    with world.watch(of, ARRAY, data=True) as watch:
        begin()
        while not over and (change := watch.next(timeout_s=WAIT_S)) is not None:
            over = take(watch.value(change))


def _woken_as_actor(
    cell: Cell, of: Entity, begin: Callable[[], None], take: Callable[[Any], bool]
) -> None:
    class Woken(Actor):
        """Takes each array; the first one was there before."""

        array = Read(World(WORLD), of, ARRAY)
        triggers = (array,)

        def update(self, lock: Lock) -> None:
            """Take one array."""
            if not begun.is_set():
                begun.set()
                begin()
            if take(lock[self.array]):
                stop.set()

    begun, stop = threading.Event(), threading.Event()
    late = threading.Timer(2 * WAIT_S, stop.set)
    late.start()
    try:
        run_actor(Woken(), cell, stop=stop)
    finally:
        late.cancel()


def said(numbers: Sequence[Any]) -> str:
    """Return numbers as one line that `json.loads` reads."""
    return json.dumps(list(numbers), separators=(",", ":"))
