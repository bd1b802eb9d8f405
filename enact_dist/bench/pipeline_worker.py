"""A process of the pipeline: `python -m enact_dist.bench.pipeline_worker CELL ROLE OPTIONS`.

=========  ======================================================================================
camera     stores an image at each tick
segmenter  is woken by its camera's image, reads it and writes its mask under one lock
consumer   is woken by masks, and takes eight of one tick under one lock
=========  ======================================================================================

A line with the first tick's time starts it.  Without sharing each does the same work at each tick,
on arrays of its own, and joins no cell.  The first 16 bytes of an image and of its mask are the
tick's number and the time before the image was stored.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from enact_dist.bench.place import WORLD
from enact_dist.bench.timing import sleep_until
from enact_dist.connecting import connect
from enact_dist.lock import Lock
from enact_dist.terms import Aspect, Durability, Entities, Entity, Read, ReadEach, Write

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from enact_dist.world import WorldContext

CAMERAS: Final = 8
PERIOD_NS: Final = 100_000_000
SHAPE: Final = (480, 640, 3)
"""Rows, columns and channels of an image, uint8; a mask has the first two."""
WAIT_S: Final = 30.0
LATE_NS: Final = 2_000_000_000
"""For so long after the last tick its set may still come."""
IMAGE: Final[Aspect[Any]] = Aspect("pipeline_image", np.ndarray, Durability.VOLATILE)
MASK: Final[Aspect[Any]] = Aspect("pipeline_mask", np.ndarray, Durability.VOLATILE)
NO_TICK: Final = -1


def _image_entity(camera: int) -> Entity:
    return Entity(f"camera/{camera}")


def _mask_entity(camera: int) -> Entity:
    return Entity(f"silhouette/{camera}")


def head_of(array: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return tick and time in the first 16 bytes of an image or a mask, as a view, shape (2,)."""
    return array.reshape(-1)[:16].view(np.int64)


def new_image() -> NDArray[np.uint8]:
    """Return an image of noise whose head names no tick."""
    image = np.random.default_rng(1).integers(0, 256, SHAPE, np.uint8)
    head_of(image)[:] = NO_TICK, 0
    return image


def mask_of(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return where an image is more green than red, 0 or 1, with the image's head."""
    mask = (image[:, :, 1] > image[:, :, 0]).view(np.uint8)
    head_of(mask)[:] = head_of(image)
    return mask


def area_of(masks: Mapping[Any, NDArray[np.uint8]]) -> int:
    """Return how many pixels are set in all masks: what the consumer makes of a set."""
    return sum(int(np.count_nonzero(mask)) for mask in masks.values())


class _Ticks:
    """The moments of a run."""

    def __init__(self, start_ns: int, count: int) -> None:
        self._start_ns, self.count = start_ns, count
        self.end_ns = start_ns + count * PERIOD_NS + LATE_NS

    def wait(self, tick: int) -> None:
        """Sleep until a tick."""
        sleep_until(self._start_ns + tick * PERIOD_NS)

    def left_s(self) -> float:
        """Return how long a change may still come."""
        return max(0.0, (self.end_ns - time.perf_counter_ns()) / 1e9)


def _started(options: dict[str, Any]) -> _Ticks:
    print("ready:", flush=True)
    return _Ticks(int(sys.stdin.readline()), options["ticks"])


# ---------------------------------------------------------------- with sharing


def _camera(world: WorldContext, options: dict[str, Any]) -> None:
    write = Write(world, _image_entity(options["camera"]), IMAGE)
    image = new_image()
    with Lock(write, wait_s=WAIT_S) as lock:
        lock[write] = image
    ticks = _started(options)
    for tick in range(ticks.count):
        ticks.wait(tick)
        head_of(image)[:] = tick, time.perf_counter_ns()
        with Lock(write, wait_s=WAIT_S) as lock:
            lock[write] = image
    print("done:", flush=True)


def _segmenter(world: WorldContext, options: dict[str, Any]) -> None:
    entity = _image_entity(options["camera"])
    read, write = Read(world, entity, IMAGE), Write(world, _mask_entity(options["camera"]), MASK)
    with Lock(write, wait_s=WAIT_S) as lock:
        lock[write] = mask_of(new_image())
    with world.watch(entity, IMAGE) as watch:
        ticks = _started(options)
        last = NO_TICK
        while last < ticks.count - 1 and ticks.left_s():
            change = watch.next(timeout_s=ticks.left_s())
            if change is None or change.null:
                continue
            with Lock(read, write, wait_s=WAIT_S) as lock:
                image = lock[read]
                seen = int(head_of(image)[0])
                # A start that was seen already, or a change that an earlier lock has shown.
                if seen > last:
                    last = seen
                    lock[write] = mask_of(image)
    print("done:", flush=True)


def _consumer(world: WorldContext, options: dict[str, Any]) -> None:
    masks = ReadEach(world, Entities("silhouette/*"), MASK)
    sets: list[tuple[int, int]] = []
    uneven = 0
    with world.watch("silhouette/*", MASK) as watch:
        ticks = _started(options)
        last, moved = NO_TICK, set[Entity]()
        while last < ticks.count - 1 and ticks.left_s():
            change = watch.next(timeout_s=ticks.left_s())
            if change is not None:
                moved.add(change.entity)
            if len(moved) < CAMERAS:
                continue
            with Lock(masks, wait_s=WAIT_S) as lock:
                found = dict(lock[masks])
                had_ns = time.perf_counter_ns()
                heads = [head_of(mask) for mask in found.values()]
                numbers = {int(head[0]) for head in heads}
                whole = len(found) == CAMERAS and len(numbers) == 1
                if whole and numbers != {NO_TICK} and max(numbers) > last:
                    area_of(found)
                    (last,) = numbers
                    sets.append((last, had_ns - min(int(head[1]) for head in heads)))
                    moved.clear()
                elif whole:
                    moved.clear()
                else:
                    uneven += 1
    print("sets:", json.dumps({"sets": sets, "uneven": uneven}), flush=True)


# ---------------------------------------------------------------- without


def _alone(role: str, options: dict[str, Any]) -> None:
    image = new_image()
    masks = {number: mask_of(image) for number in range(CAMERAS)}
    ticks = _started(options)
    for tick in range(ticks.count):
        ticks.wait(tick)
        if role == "camera":
            head_of(image)[:] = tick, time.perf_counter_ns()
        elif role == "segmenter":
            mask_of(image)
        else:
            area_of(masks)
    print("sets:", json.dumps({"sets": [], "uneven": 0}), flush=True)
    print("done:", flush=True)


_ROLES: Final[dict[str, Callable[[WorldContext, dict[str, Any]], None]]] = {
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
            _ROLES[role](cell.create_world(WORLD), options)
        else:
            _alone(role, options)
        sys.stdin.read()


if __name__ == "__main__":
    main(sys.argv[1:])
