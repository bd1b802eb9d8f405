"""One program on large data: `large_data_program.py CELL_FILE [pause]`; prints what it found.

With `pause` it says how far it is in the middle of each transfer and goes on when told, so that the
test can do something to the network.
"""

import hashlib
import sys

import numpy as np

from enact_dist import (
    Aspect,
    Durability,
    Entities,
    Entity,
    Lock,
    Read,
    ReadEach,
    View,
    Write,
    WriteEach,
    connect,
)

CLOUD = Aspect("cloud", np.ndarray, Durability.VOLATILE)
MODEL = Aspect("model", np.ndarray, Durability.OS)
LEFT, RIGHT = Entity("left/tray"), Entity("right/tray")  # on a shard each
IMAGES = Entities("left/camera/*")
LARGE = 40_000_000
MIDST = 20 << 20


def say(word, array):
    digest = hashlib.sha256(np.ascontiguousarray(array)).hexdigest()[:16]
    print(f"{word}: {array.dtype} {array.shape} {digest}", flush=True)


def pause_in_the_midst(cell):
    """Stop before the first slice behind `MIDST` of each transfer until told to go on."""
    carrier = cell._client.carrier
    begin, stopped = carrier.begin, set()

    def begin_or_wait(shard, message, *, timeout_s):
        kind = type(message).__name__
        if message.offset >= MIDST and kind not in stopped:
            stopped.add(kind)
            print(f"midst: {kind}", flush=True)
            sys.stdin.readline()
        return begin(shard, message, timeout_s=timeout_s)

    carrier.begin = begin_or_wait


def run(cell):
    online, draw = cell.world("online"), np.random.default_rng(7)
    left, right = Write(online, LEFT, CLOUD), Write(online, RIGHT, MODEL)
    with Lock(left, right, wait_s=30.0) as lock:  # one commit over both shards
        lock.put(left, draw.integers(0, 255, LARGE, np.uint8), stamp_ns=17)
        lock[right] = draw.standard_normal((300_000, 3))
    images = WriteEach(online, IMAGES, CLOUD)
    with Lock(images, wait_s=30.0) as lock:
        for number in range(6):
            image = draw.integers(0, 255, (480, 640, 3), np.uint8)
            lock[images][Entity(f"left/camera/{number}")] = image
    cell._session.cache.__init__()  # nothing of what was written is known
    reads = Read(online, LEFT, CLOUD), Read(online, RIGHT, MODEL)
    each = ReadEach(online, IMAGES, CLOUD)
    with Lock(*reads, each, wait_s=30.0) as lock:
        say("left", lock[reads[0]])
        say("right", lock[reads[1]])
        for entity, image in lock[each].items():
            say(entity.name, image)
        print(f"stamp: {lock.stamp_ns(reads[0])}", flush=True)
    view = View(online, RIGHT, MODEL)
    say("view", online.view(view)[view])


with connect(sys.argv[1], request_timeout_s=60.0) as cell:
    if sys.argv[2:] == ["pause"]:
        pause_in_the_midst(cell)
    run(cell)
    ways = sorted(cell._client.carrier.transport_of(shard).split()[0] for shard in ("s0", "s1"))
    print(f"repeated: {cell.statistics().get('slices_repeated', 0)}", flush=True)
    print(f"done: {' '.join(ways)}", flush=True)
