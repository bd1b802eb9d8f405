"""A small production line whose actors run in one process or on hosts far apart.

`python -m production_line CELL` waits until the line has counted all parts, and prints what it finds.
"""

import json
import sys
import zlib

import numpy as np

from enact_dist import (
    Actor,
    Aspect,
    Durability,
    Entities,
    Entity,
    ReadEach,
    View,
    ViewEach,
    World,
    Write,
    WriteEach,
    connect,
)

PARTS = Entities("part/*")
LINE = Entity("line")
FRAME = Aspect("part_frame", np.ndarray, Durability.VOLATILE)
AREA = Aspect("part_area", int)
COUNT = Aspect("part_count", dict)
PARTS_MAX = 4
SIDE = 600
"""A frame of 360 kB: a file in shared memory on one host, slices of a transfer between two."""


class Camera(Actor):
    """Show each part once."""

    online = World("online")
    frames = WriteEach(online, PARTS, FRAME)

    def update(self, lock):
        for number in range(PARTS_MAX):
            draw = np.random.default_rng(number)
            frame = draw.integers(0, 256, (SIDE, SIDE), dtype=np.uint8)
            lock[self.frames][Entity(f"part/{number}")] = frame


class Measuring(Actor):
    """Say how many pixels of a part are bright."""

    online = World("online")
    frame = View(online, PARTS, FRAME)
    area = Write(online, PARTS, AREA)
    triggers = (frame,)

    def update(self, lock):
        lock[self.area] = int(np.count_nonzero(lock[self.frame] > 127))


class Counting(Actor):
    """Keep the areas of all parts in one datum."""

    online = World("online")
    areas = ReadEach(online, PARTS, AREA)
    count = Write(online, LINE, COUNT)
    triggers = (areas,)

    def update(self, lock):
        lock[self.count] = {part.name: area for part, area in lock[self.areas].items()}


def found(cell, *, wait_s=180.0):
    """Wait until all parts are counted; return the count and a checksum of each frame."""
    online = cell.world("online")
    count, frames = View(online, LINE, COUNT), ViewEach(online, PARTS, FRAME)
    with online.watch(Entities("line"), COUNT) as watch:
        while len(online.view(count).get(count, {})) < PARTS_MAX:
            assert watch.next(wait_s) is not None, f"not all counted after {wait_s} s"
    seen = online.view(count, frames)
    sums = {part.name: zlib.crc32(frame.tobytes()) for part, frame in seen[frames].items()}
    return {"count": dict(sorted(seen[count].items())), "frames": dict(sorted(sums.items()))}


def main():
    with connect(sys.argv[1], actor="reader", timeout_s=120.0) as cell:
        print("found", json.dumps(found(cell)), flush=True)
        print(
            "ways",
            json.dumps([cell._client.carrier.transport_of(s.name) for s in cell.shards()]),
            flush=True,
        )


if __name__ == "__main__":
    main()
