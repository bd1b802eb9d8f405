"""A process beside the measuring one: `python -m enact_dist.bench.worker CELL ROLE OPTIONS`.

========  =======================================================================================
storer    writes an array anew at each line ``ENTITY BYTES``
notifier  at a line, writes numbered and stamped arrays with pauses between them
fetcher   fetches one datum over and over, and says when it begins and when it has it
waiter    at a line, its threads queue for a slot; says when each had it and began to leave it
cameras   from the time in a line on, a thread per camera writes images, with history and without
========  =======================================================================================

It says ``ready:`` once it has joined; it leaves when its standard input ends.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

import numpy as np

from enact_dist.access.lock import Lock
from enact_dist.bench.cases.history import CAMERAS, IMAGE_BYTES, IMAGES, PERIOD_NS, side_of
from enact_dist.bench.cases.payloads import ARRAY, WAIT_S, said, store
from enact_dist.bench.cases.updates import slots
from enact_dist.bench.place import WORLD
from enact_dist.bench.timing import sleep_until
from enact_dist.link.client.fetch import DatumCache
from enact_dist.terms import Entity, View, Write
from enact_dist.world.connecting import connect
from enact_dist.world.context import WorldContext


def _store(world: WorldContext, _options: dict[str, Any]) -> None:
    arrays: dict[int, Any] = {}
    print("ready:", flush=True)
    for line in sys.stdin:
        name, size = line.split()
        count = int(size) // 4
        array = arrays.setdefault(count, np.arange(count, dtype=np.float32))
        array[0] += 1.0
        store(world, Entity(name), array)
        print("stored:", flush=True)


def _notify(world: WorldContext, options: dict[str, Any]) -> None:
    of = Entity(options["entity"])
    write = Write(world, of, ARRAY)
    array = np.zeros(options["bytes"], np.uint8)
    head = array[:16].view(np.int64)
    head[:] = -1, 0
    store(world, of, array)
    print("ready:", flush=True)
    sys.stdin.readline()
    for number in range(options["count"]):
        time.sleep(options["gap_s"])
        with Lock(write, wait_s=WAIT_S) as lock:
            head[:] = number, time.perf_counter_ns()
            lock[write] = array
    print("done:", flush=True)
    sys.stdin.read()


def _fetch(world: WorldContext, options: dict[str, Any]) -> None:
    view = View(world, Entity(options["entity"]), ARRAY)
    print("ready:", flush=True)
    while True:
        world.session.cache = DatumCache(0)  # what is known already would not travel
        print("fetching:", flush=True)
        world.view(view)
        print("fetched:", flush=True)


def _wait(world: WorldContext, options: dict[str, Any]) -> None:
    write = slots(world, options["slot"] + 1, entity="waiters")[-1]
    with Lock(write, wait_s=WAIT_S):
        pass
    print("ready:", flush=True)
    sys.stdin.readline()
    end_s = time.monotonic() + options["seconds_s"]
    held: list[tuple[int, int]] = []

    def queue_up(_number: int) -> None:
        while time.monotonic() < end_s:
            with Lock(write, wait_s=WAIT_S) as lock:
                granted_ns = time.perf_counter_ns()
                lock[write] = lock.get(write, 0) + 1
                left_ns = time.perf_counter_ns()
            held.append((granted_ns, left_ns))

    _side_by_side(queue_up, options["threads"])
    print("held:", said(held), flush=True)
    sys.stdin.read()


def _film(world: WorldContext, options: dict[str, Any]) -> None:
    late = [0] * CAMERAS
    images = [np.full(IMAGE_BYTES, camera, np.uint8) for camera in range(CAMERAS)]
    writes = [
        [Write(world, Entity(f"history/camera/{camera}"), aspect) for aspect in IMAGES]
        for camera in range(CAMERAS)
    ]
    print("ready:", flush=True)
    start_ns = int(sys.stdin.readline())

    def film(camera: int) -> None:
        for tick in range(options["ticks"]):
            due_ns = start_ns + tick * PERIOD_NS
            sleep_until(due_ns)
            write = writes[camera][side_of(tick)]
            images[camera][:8].view(np.int64)[0] = tick
            with Lock(write, wait_s=WAIT_S) as lock:
                lock.put(write, images[camera], stamp_ns=tick + 1)
            late[camera] += time.perf_counter_ns() > due_ns + PERIOD_NS

    _side_by_side(film, CAMERAS)
    print("did:", said(late), flush=True)
    sys.stdin.read()


def _side_by_side(act: Callable[[int], None], count: int) -> None:
    """Let so many threads act at once, each with its number; raise what one of them raises."""
    with ThreadPoolExecutor(count) as pool:
        list(pool.map(act, range(count)))


_ROLES: Final[dict[str, Callable[[WorldContext, dict[str, Any]], None]]] = {
    "storer": _store,
    "notifier": _notify,
    "fetcher": _fetch,
    "waiter": _wait,
    "cameras": _film,
}


def main(words: Sequence[str]) -> None:
    """Play one role until the parent ends this process."""
    target, role, options = words
    with connect(target, actor=f"bench-{role}", timeout_s=20.0) as cell:
        _ROLES[role](cell.create_world(WORLD), json.loads(options))


if __name__ == "__main__":
    main(sys.argv[1:])
