"""A process of the pipeline: `python -m enact_dist.bench.cases.pipeline_worker CELL ROLE OPTIONS`.

=========  ======================================================================================
camera     stores an image at each tick, with the tick as its capture stamp
segmenter  an actor that is triggered by its camera's image and writes its mask, same stamp
consumer   an actor that is triggered once per set of eight masks with one stamp
=========  ======================================================================================

A line with the first tick's time starts it.  Without sharing each does the same work at each tick,
on arrays of its own, and joins no cell.  The first 16 bytes of an image and of its mask are the
tick's number and the time before the image was stored; below its first row an image repeats after
four ticks, and every camera has images of its own, so the reader knows a mask by what is in it.
"""

from __future__ import annotations

import contextlib
import json
import sys
import threading
import time
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from enact_dist.access.lock import Lock
from enact_dist.access.together import Together
from enact_dist.actor.actor import Actor
from enact_dist.actor.running.runner import ActorRun
from enact_dist.bench.place import WORLD
from enact_dist.bench.timing import sleep_until
from enact_dist.terms import Aspect, Durability, Entity, View, World, Write
from enact_dist.world.connecting import connect

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from enact_dist.world.cell import Cell

CAMERAS: Final = 8
PERIOD_NS: Final = 100_000_000
SHAPE: Final = (480, 640, 3)
"""Rows, columns and channels of an image, uint8; a mask has the first two."""
WAIT_S: Final = 30.0
LATE_NS: Final = 2_000_000_000
"""For so long after the last tick its set may still come."""
AGAIN_MAX: Final = 64
"""So often an actor may be run for a tick that it has seen already."""
FRAMES: Final = 4
IMAGE: Final[Aspect[Any]] = Aspect("pipeline_image", np.ndarray, Durability.VOLATILE)
MASK: Final[Aspect[Any]] = Aspect("pipeline_mask", np.ndarray, Durability.VOLATILE, retention=4)
ROLE: Final = World(WORLD)


def _image_entity(camera: int) -> Entity:
    return Entity(f"camera/{camera}")


def _mask_entity(camera: int) -> Entity:
    return Entity(f"silhouette/{camera}")


def head_of(array: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return tick and time in the first 16 bytes of an image or a mask, as a view, shape (2,)."""
    return array.reshape(-1)[:16].view(np.int64)


def frames_of(camera: int) -> list[NDArray[np.uint8]]:
    """Return the images of noise that a camera shows in turn, of `SHAPE`."""
    noise = np.random.default_rng(camera)
    return [noise.integers(0, 256, SHAPE, np.uint8) for _ in range(FRAMES)]


def mask_of(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return where an image is more green than red, 0 or 1, with the image's head."""
    mask = (image[:, :, 1] > image[:, :, 0]).view(np.uint8)
    head_of(mask)[:] = head_of(image)
    return mask


def area_of(mask: NDArray[np.uint8]) -> int:
    """Return how many pixels are set below the first row, where the head lies."""
    return int(np.count_nonzero(mask[1:]))


def areas_of_frames() -> list[list[int]]:
    """Return the area of the mask of each camera's images."""
    return [[area_of(mask_of(frame)) for frame in frames_of(camera)] for camera in range(CAMERAS)]


def tick_of_set(masks: Sequence[NDArray[np.uint8]], areas: Sequence[Sequence[int]]) -> int | None:
    """Return the tick that all masks show, by head and by content; None if they differ."""
    ticks = {int(head_of(mask)[0]) for mask in masks}
    found = [area_of(mask) for mask in masks]
    if len(ticks) != 1:
        return None
    (tick,) = ticks
    return tick if found == [area[tick % FRAMES] for area in areas] else None


class FixedRows:
    """Rows of integers, in memory that is taken and touched before the run: they do not grow it.

    Args:
        rows: How many there may be; further ones raise `IndexError`.
        width: How many integers each has.
    """

    def __init__(self, rows: int, width: int) -> None:
        self._rows = np.full((rows, width), -1, np.int64)
        self._count = 0

    def add(self, *row: int) -> None:
        """Take one row."""
        self._rows[self._count] = row
        self._count += 1

    def told(self) -> list[list[int]]:
        """Return all rows that were taken."""
        rows: list[list[int]] = self._rows[: self._count].tolist()
        return rows


class _Ticks:
    """The moments of a run."""

    def __init__(self, start_ns: int, count: int) -> None:
        self._start_ns, self.count = start_ns, count
        self.end_ns = start_ns + count * PERIOD_NS + LATE_NS

    def wait(self, tick: int) -> None:
        """Sleep until a tick."""
        sleep_until(self._start_ns + tick * PERIOD_NS)


def _started(options: dict[str, Any]) -> _Ticks:
    print("ready:", flush=True)
    return _Ticks(int(sys.stdin.readline()), options["ticks"])


def _say(**found: Any) -> None:
    print("did:", json.dumps(found, separators=(",", ":")), flush=True)


# ---------------------------------------------------------------- with sharing


def _camera(cell: Cell, options: dict[str, Any]) -> None:
    write = Write(cell.world(WORLD), _image_entity(options["camera"]), IMAGE)
    frames, image = frames_of(options["camera"]), np.empty(SHAPE, np.uint8)
    with Lock(write, wait_s=WAIT_S) as lock:  # a null datum: registers the aspect, and connects
        del lock[write]
    ticks = _started(options)
    stored = FixedRows(ticks.count, 3)
    for tick in range(ticks.count):
        ticks.wait(tick)
        np.copyto(image, frames[tick % FRAMES])  # a driver's copy out of its ring
        begun_ns = time.perf_counter_ns()
        head_of(image)[:] = tick, begun_ns
        with Lock(write, wait_s=WAIT_S) as lock:
            lock.put(write, image, stamp_ns=tick + 1)
        stored.add(tick, begun_ns, time.perf_counter_ns())
    _say(ticks=stored.told())


def _segmenter(cell: Cell, options: dict[str, Any]) -> None:
    class Segmenter(Actor):
        """Makes the mask of each image."""

        image = View(ROLE, _image_entity(options["camera"]), IMAGE)
        mask = Write(ROLE, _mask_entity(options["camera"]), MASK)
        triggers = (image,)

        def update(self, lock: Lock) -> None:
            """Make the mask of one image."""
            mask = mask_of(lock[self.image])
            lock.put(self.mask, mask, stamp_ns=lock.stamp_ns(self.image))
            tick = int(head_of(mask)[0])
            done.add(tick, time.perf_counter_ns())
            if tick == options["ticks"] - 1:
                stop.set()

    done = FixedRows(options["ticks"] + AGAIN_MAX, 2)
    stop = threading.Event()
    _run_actor(Segmenter(), cell, options, stop, lambda: {"ticks": done.told()})


def _consumer(cell: Cell, options: dict[str, Any]) -> None:
    class Consumer(Actor):
        """Looks at each set of masks."""

        masks = Together([View(ROLE, _mask_entity(n), MASK) for n in range(CAMERAS)], by="stamp")
        triggers = (masks,)

        def update(self, lock: Lock) -> None:
            """Look at one set."""
            masks = lock[self.masks]
            had_ns = time.perf_counter_ns()
            tick = tick_of_set(masks, areas)
            if tick is None:
                torn.append(lock.stamp_ns(self.masks) - 1)
                return
            sets.add(tick, had_ns, had_ns - min(int(head_of(mask)[1]) for mask in masks))
            if tick == options["ticks"] - 1:
                stop.set()

    sets = FixedRows(options["ticks"] + AGAIN_MAX, 3)
    torn: list[int] = []
    areas = areas_of_frames()
    stop = threading.Event()
    _run_actor(Consumer(), cell, options, stop, lambda: {"sets": sets.told(), "torn": torn})


def _run_actor(
    actor: Actor,
    cell: Cell,
    options: dict[str, Any],
    stop: threading.Event,
    found: Callable[[], dict[str, Any]],
) -> None:
    """Run an actor until it stops itself, or the last tick is long over; then say what it did."""

    def stop_late() -> None:
        ticks = _started(options)
        stop.wait(max(0.0, (ticks.end_ns - time.perf_counter_ns()) / 1e9))
        stop.set()

    late = threading.Thread(target=stop_late)
    late.start()
    did = ActorRun(actor, cell, stop=stop).run()
    late.join()
    _say(
        **found(),
        skipped=did.skipped,
        refused=did.refused,
        incomplete=did.incomplete,
        example=did.last_incomplete or did.last_error or "",
    )


# ---------------------------------------------------------------- without


def _alone(role: str, options: dict[str, Any]) -> None:
    camera = options.get("camera", 0)
    frames, image = frames_of(camera), np.empty(SHAPE, np.uint8)
    areas = areas_of_frames()
    masks = [mask_of(frames_of(number)[0]) for number in range(CAMERAS)]
    ticks = _started(options)
    for tick in range(ticks.count):
        ticks.wait(tick)
        if role == "camera":
            np.copyto(image, frames[tick % FRAMES])
            head_of(image)[:] = tick, time.perf_counter_ns()
        elif role == "segmenter":
            mask_of(image)
        else:
            tick_of_set(masks, areas)
    _say()


_ROLES: Final[dict[str, Callable[[Cell, dict[str, Any]], None]]] = {
    "camera": _camera,
    "segmenter": _segmenter,
    "consumer": _consumer,
}


def main(words: Sequence[str]) -> None:
    """Play one role until the parent ends this process."""
    target, role, text = words
    options = json.loads(text)
    with contextlib.ExitStack() as stack:
        if options["sharing"]:
            cell = stack.enter_context(connect(target, actor=f"bench-{role}", timeout_s=60.0))
            cell.create_world(WORLD)
            _ROLES[role](cell, options)
        else:
            _alone(role, options)
        sys.stdin.read()


if __name__ == "__main__":
    main(sys.argv[1:])
