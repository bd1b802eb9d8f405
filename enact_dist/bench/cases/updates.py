"""Benches `update`, `multi`, `durable` and `waiters`: small data under locks.

An update is lock, read an int, write it, release.  Rows over Zenoh and in the process are divided
by one raw Zenoh query, rows over sockets by one echo of a Unix socket, each with pauses if the row
has pauses.  Where several benches need no comparison of carriers, "auto" is the fastest one.
"""

from __future__ import annotations

import itertools
import json
import threading
import time
from typing import TYPE_CHECKING, Any, Final

from enact_dist.access.lock import Lock
from enact_dist.bench.floors import (
    ECHO,
    ECHO_PAUSED,
    FDATASYNC,
    PAUSED,
    QUERY,
    QUERY_PAUSED,
)
from enact_dist.bench.place import EMBEDDED, environment
from enact_dist.bench.rows import Case, Goal, Key, at_most, times
from enact_dist.bench.timing import PAUSE_S, timed
from enact_dist.terms import Aspect, Durability, Entity, Read, Write

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from enact_dist.bench.run import Run
    from enact_dist.world.context import WorldContext

FOUR: Final = 4
WAIT_S: Final = 60.0
REDIS_ONE_US: Final = 200.0
REDIS_FOUR_US: Final = 260.0
"""Redis with a Lua lock, lease and fencing, through redis-py, on the machine of the README."""
THREADS: Final = (2, 8, 32)


def slots(
    world: WorldContext,
    count: int,
    durability: Durability = Durability.VOLATILE,
    *,
    entity: str = "counter",
) -> list[Write[int]]:
    """Return so many slots of one entity, hence of one shard."""
    return [
        Write(world, Entity(entity), Aspect(f"{durability.value}_{number}", int, durability))
        for number in range(count)
    ]


def update(writes: Iterable[Write[int]], reads: Iterable[Read[int]] = ()) -> None:
    """Lock all, read all, add one to what can be written, release."""
    writes, reads = tuple(writes), tuple(reads)
    with Lock(*reads, *writes, wait_s=WAIT_S) as lock:
        for read in reads:
            lock.get(read, 0)
        for write in writes:
            lock[write] = lock.get(write, 0) + 1


def floor_of(way: str, *, paused: bool = False) -> Key:
    """Return what a round trip is divided by, by the way that it takes."""
    if way in {"zenoh", EMBEDDED}:
        return QUERY_PAUSED if paused else QUERY
    return ECHO_PAUSED if paused else ECHO


# ---------------------------------------------------------------- update


def run_update(run: Run) -> None:
    """Whole updates: every durability class, one slot and four, back to back and with pauses."""
    cases = []
    for carrier in run.place.carriers:
        world, way = run.place.world(carrier), run.place.way(carrier)
        for durability in (Durability.VOLATILE, Durability.OS, Durability.DURABLE):
            for count in (1, FOUR) if durability is Durability.VOLATILE else (1,):
                cases += [
                    _update_case(carrier, way, world, durability, count, paused=paused)
                    for paused in (False, True)
                ]
    run.measure(cases)


def _variant(carrier: str, durability: Durability, count: int, *, paused: bool) -> str:
    slots_said = "" if count == 1 else f", {count} slots"
    return f"{carrier}, {durability.value}{slots_said}{PAUSED if paused else ''}"


def _update_case(
    carrier: str,
    way: str,
    world: WorldContext,
    durability: Durability,
    count: int,
    *,
    paused: bool,
) -> Case:
    writes = slots(world, count, durability)
    pause_s = PAUSE_S if paused else 0.0
    return Case(
        "update",
        _variant(carrier, durability, count, paused=paused),
        lambda seconds_s: timed(lambda: update(writes), seconds_s, pause_s=pause_s),
        floor_of(way, paused=paused),
        _update_goal(
            way,
            durability,
            count,
            ("update", _variant(carrier, durability, 1, paused=paused)),
            paused=paused,
        ),
    )


def _update_goal(
    way: str, durability: Durability, count: int, one: Key, *, paused: bool = False
) -> Goal | None:
    """Return what the budgets say of an update; `one` is that of one slot beside it."""
    if way == EMBEDDED:
        volatile = durability is Durability.VOLATILE and count == 1 and not paused
        return at_most(120.0, "≤ 120 µs") if volatile else None
    if way != "zenoh":
        if durability is not Durability.VOLATILE or paused:
            return None
        limit_us = REDIS_ONE_US if count == 1 else REDIS_FOUR_US
        return at_most(limit_us, f"≤ {limit_us:.0f} µs (Redis)")
    if count == FOUR:
        return times(1.2, one, "≤ 1.2 x one slot")
    floor = floor_of(way, paused=paused)
    if durability is Durability.VOLATILE:
        return times(2.3, floor, "≤ 2.3 x query")
    if durability is Durability.OS:
        return times(2.6, floor, "≤ 2.6 x query")
    return _durable_goal(floor)


def _durable_goal(query: Key) -> Goal:
    return times(2.6, query, "≤ 2.6 x query + 1.5 fdatasync", plus=(1.5, FDATASYNC))


# ---------------------------------------------------------------- multi


def run_multi(run: Run) -> None:
    """Several slots of one lock, of one shard or more, and several locks at a time.

    The budgets speak of four slots that are written, and of no other number.
    """
    cases = []
    for carrier in run.place.carriers:
        world, way = run.place.world(carrier), run.place.way(carrier)
        floor = floor_of(way)
        writes = slots(world, 2, entity="multi")
        reads = [Read(world, Entity("multi/read"), write.aspect) for write in writes]
        many = slots(world, 32, entity="multi")
        goal = _update_goal(way, Durability.VOLATILE, FOUR, ("multi", f"{carrier}, 1 written"))
        cases += [
            _multi_case(carrier, floor, "1 written", many[:1]),
            _multi_case(carrier, floor, f"{FOUR} written", many[:FOUR], goal=goal),
            _multi_case(carrier, floor, "2 read, 2 written", writes, reads),
            _multi_case(carrier, floor, "32 written", many),
        ]
        acts = [_updating(*slots(world, 1, entity=f"multi/{number}")) for number in range(8)]
        variant = f"{carrier}, 8 threads, each its own slot, per update"
        cases.append(Case("multi", variant, _side_by_side(acts), floor))
        if carrier != EMBEDDED and len(run.place.shard_names) > 1:
            spread = [
                write for shard in run.place.shard_names
                for write in slots(world, 1, entity=f"{shard}/multi")
            ]  # fmt: skip
            cases.append(
                _multi_case(carrier, floor, f"1 written on each of {len(spread)} shards", spread)
            )
    run.measure(cases)


def _multi_case(
    carrier: str,
    floor: Key,
    what: str,
    writes: list[Write[int]],
    reads: Iterable[Read[int]] = (),
    goal: Goal | None = None,
) -> Case:
    reads = tuple(reads)
    return Case(
        "multi",
        f"{carrier}, {what}",
        lambda seconds_s: timed(lambda: update(writes, reads), seconds_s),
        floor,
        goal,
    )


# ---------------------------------------------------------------- durable


def run_durable(run: Run) -> None:
    """Durable commits: one at a time, from several threads, and one with 10 MB.

    The budget of one is set over Zenoh, and holds for a faster carrier all the more.
    """
    import numpy as np

    carrier = EMBEDDED if run.place.embedded else run.place.carrier
    world = run.place.world(carrier)
    large = Write(world, Entity("durable"), Aspect("durable_large", np.ndarray))
    body = np.zeros(10_000_000, np.uint8)
    counters = slots(world, 8, Durability.DURABLE, entity="durable")

    def store() -> None:
        with Lock(large, wait_s=WAIT_S) as lock:
            lock[large] = body

    one = Case(
        "durable",
        "one slot",
        lambda seconds_s: timed(lambda: update(counters[:1]), seconds_s),
        FDATASYNC,
        _durable_goal(QUERY) if carrier != EMBEDDED else None,
    )
    cases = [one]
    for threads in (2, 8):
        acts = [_updating(counters[number]) for number in range(threads)]
        variant = f"{threads} threads, each its own slot, per commit"
        cases.append(Case("durable", variant, _side_by_side(acts), FDATASYNC))
    cases.append(Case("durable", "10 MB", lambda seconds_s: timed(store, seconds_s), FDATASYNC))
    run.measure(cases)


def _updating(write: Write[int]) -> Callable[[], None]:
    return lambda: update((write,))


def _side_by_side(acts: list[Callable[[], None]]) -> Callable[[float], list[float]]:
    """Let each act repeat in a thread of its own; one time per tenth: its length by its acts."""

    def measure(seconds_s: float) -> list[float]:
        counts = [0] * len(acts)
        failed: list[BaseException] = []
        end = threading.Event()

        def repeat(number: int) -> None:
            try:
                while not end.is_set():
                    acts[number]()
                    counts[number] += 1
            except BaseException as error:  # noqa: BLE001 (raised again below)
                failed.append(error)

        threads = [threading.Thread(target=repeat, args=(n,)) for n in range(len(acts))]
        for thread in threads:
            thread.start()
        try:
            found_us = _per_act_us(counts, seconds_s, failed)
        finally:
            end.set()
            for thread in threads:
                thread.join()
        if failed:
            raise failed[0]
        return found_us

    return measure


def _per_act_us(counts: list[int], seconds_s: float, failed: list[BaseException]) -> list[float]:
    found_us: list[float] = []
    end_s = time.perf_counter() + seconds_s
    while (time.perf_counter() < end_s or not found_us) and not failed:
        before, started_s = sum(counts), time.perf_counter()
        time.sleep(max(0.05, seconds_s / 10.0))
        done = sum(counts) - before
        if done:
            found_us.append((time.perf_counter() - started_s) * 1e6 / done)
    return found_us


# ---------------------------------------------------------------- waiters


def run_waiters(run: Run) -> None:
    """Hand-over of one slot, and the rate of processes that update one slot or a slot each.

    A hand-over is how long no thread holds the slot while several wait for it.  The rates stand
    beside those of one process alone: what contention costs, and what the shard's processor does.
    The budgets speak of the core's hand-over alone, which the bench `core` measures.
    """
    floor = floor_of(run.place.way(run.place.carrier))
    cases = [
        Case("waiters", f"{count} threads in 2 processes, hand-over", _hand_over(run, count), floor)
        for count in THREADS
    ]
    one, each = "1 process alone, per update", f"{FOUR} processes, each its own slot, per update"
    ended = f"{FOUR} processes, one slot, per update, each grant ends with its lock"
    goal = times(1.0 / 0.97, ("waiters", ended), "≥ 0.97 of the rate without kept grants")
    stays = f"{FOUR} processes, one slot, per update, grants may stay"
    cases += [
        Case("waiters", one, _contention(run, retain="0", processes=1), floor),
        Case("waiters", each, _contention(run, retain="0", apart=True), floor),
        Case("waiters", ended, _contention(run, retain="0"), floor),
        Case("waiters", stays, _contention(run, retain="1"), floor, goal),
    ]
    run.measure(cases)


def _hand_over(run: Run, count: int) -> Callable[[float], list[float]]:
    def measure(seconds_s: float) -> list[float]:
        held = _held(run, 2, count // 2, seconds_s)
        # From the moment at which one began to leave its block to the grant of the next.
        return [(after[0] - before[1]) / 1e3 for before, after in itertools.pairwise(held)]

    return measure


def _contention(
    run: Run, *, retain: str, processes: int = FOUR, apart: bool = False
) -> Callable[[float], list[float]]:
    """Return what measures processes that update one slot, or a slot each, as fast as they can."""

    def measure(seconds_s: float) -> list[float]:
        with environment(ENACT_RETAIN=retain):
            held = _held(run, processes, 1, seconds_s, apart=apart)
        return [(held[-1][0] - held[0][0]) / 1e3 / (len(held) - 1)]  # their mean: a rate

    return measure


def _held(
    run: Run, processes: int, threads: int, seconds_s: float, *, apart: bool = False
) -> list[tuple[int, int]]:
    """Let processes update one slot, or each its own if `apart`.

    Returns:
        When each lock was granted and left, in the order of the grants (ns).
    """
    place = run.place
    while True:
        options: dict[str, Any] = {"threads": threads, "seconds_s": seconds_s}
        roles = [("waiter", {**options, "slot": n * apart}) for n in range(processes)]
        with place.workers(roles, carrier=place.carrier) as workers:
            for worker in workers:
                worker.tell("go")
            held = [
                (granted_ns, left_ns)
                for worker in workers
                for granted_ns, left_ns in json.loads(
                    worker.expect("held:", timeout_s=seconds_s + WAIT_S)
                )
            ]
        if len(held) > 1:
            return sorted(held)
        seconds_s = max(2.0 * seconds_s, 0.1)  # a busy machine: no thread had its turn
