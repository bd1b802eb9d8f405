"""Sets in the paper's first application: eight cameras, their silhouettes, one visual hull."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from together_parts import (
    PATIENCE_S,
    SYSTEM,
    cameras,
    role,
)

from enact_dist import (
    ActorThread,
    Aspect,
    Durability,
    Entity,
    Lock,
    Together,
    View,
    Write,
)
from enact_dist.actor.actor import Actor

pytestmark = pytest.mark.carrier("local", "drawn")
TICKS = 12
CAMERAS = [Entity(f"camera/{index}") for index in range(8)]
FRAME = Aspect("frame", np.ndarray, Durability.VOLATILE)
MASK = Aspect("mask", np.ndarray, Durability.VOLATILE, retention=TICKS)
VOLUME = Aspect("volume", int, Durability.VOLATILE)
DROPPED = (3, 5)
"""Camera and tick of the frame that is never published."""
START_NS = 1_700_000_000_000_000_000


@pytest.fixture(params=["local", "two shards"])
def cell(request, tmp_path, monkeypatch):
    """The left camera on one shard, the right one on another; or both in this process."""
    with cameras(request.param, tmp_path, monkeypatch) as opened:
        yield opened


def stamp_of(tick):
    return START_NS + tick * 100_000_000


def silhouette(camera, tick):
    """What camera `camera` sees at a tick: (48, 64) bool."""
    mask = np.zeros((48, 64), bool)
    mask[camera : camera + 10, 3 * tick : 3 * tick + 8] = True
    return mask


def silhouettes_of(camera):
    """Return an actor that makes masks of one camera's frames."""

    class Silhouettes(Actor):
        frame = View(role, CAMERAS[camera], FRAME)
        mask = Write(role, CAMERAS[camera], MASK)
        triggers = (frame,)

        def update(self, lock):
            bright = lock[self.frame][..., 0] > 127
            lock.put(self.mask, bright, stamp_ns=lock.stamp_ns(self.frame))

    return Silhouettes()


class VisualHull(Actor):
    """Take eight masks of one moment."""

    masks = Together([View(role, camera, MASK) for camera in CAMERAS], by="stamp")
    volume = Write(role, SYSTEM, VOLUME)
    triggers = (masks,)

    def __init__(self):
        self.sets = {}
        self.all_seen = threading.Event()

    def update(self, lock):
        masks = lock[self.masks]
        self.sets[lock.stamp_ns(self.masks)] = [mask.copy() for mask in masks]
        lock[self.volume] = int(sum(mask.sum() for mask in masks))
        if stamp_of(TICKS - 1) in self.sets:
            self.all_seen.set()


def publish(cell, camera, errors):
    """Publish a camera's frames, each once the mask of the one before is there."""
    online = cell.world("online")
    request = Write(online, CAMERAS[camera], FRAME)
    try:
        with online.watch(CAMERAS[camera], MASK) as watch:
            for tick in range(TICKS):
                if (camera, tick) == DROPPED:
                    continue
                frame = np.zeros((48, 64, 3), np.uint8)
                frame[silhouette(camera, tick)] = 255
                with Lock(request) as lock:
                    lock.put(request, frame, stamp_ns=stamp_of(tick))
                change = watch.next(PATIENCE_S)
                assert change is not None, f"no mask {tick} of camera {camera}"
                assert change.captured_ns == stamp_of(tick)
    except Exception as error:
        errors.append(error)


def test_eight_cameras_eight_workers_and_one_consumer_of_whole_sets(cell):
    """Always eight masks of one stamp; the frame that a camera drops is counted and named."""
    hull, errors = VisualHull(), []
    workers = [ActorThread(silhouettes_of(camera), cell) for camera in range(8)]
    cameras = [threading.Thread(target=publish, args=(cell, c, errors)) for c in range(8)]
    with ActorThread(hull, cell) as thread:
        for worker in workers:
            worker.__enter__()
        try:
            for camera in cameras:
                camera.start()
            for camera in cameras:
                camera.join()
            assert not errors
            assert hull.all_seen.wait(PATIENCE_S), (thread.statistics(), sorted(hull.sets))
        finally:
            for worker in workers:
                worker.__exit__(None, None, None)

    camera, dropped = DROPPED
    assert list(hull.sets) == [stamp_of(tick) for tick in range(TICKS) if tick != dropped]
    for tick in set(range(TICKS)) - {dropped}:
        for index, mask in enumerate(hull.sets[stamp_of(tick)]):
            assert (mask == silhouette(index, tick)).all(), (tick, index)
    found = thread.statistics()
    assert (found.updates, found.incomplete, found.late, found.unstamped) == (TICKS - 1, 1, 0, 0)
    assert found.last_incomplete == (
        f"set of stamp {stamp_of(dropped)}: without online:camera/{camera}/mask"
    )
