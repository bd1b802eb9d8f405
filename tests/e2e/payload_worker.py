"""Client processes that write and read large arrays; each line of output is waited for by a test.

payload_worker.py ROLE CELL [ARGUMENT…]; an array of version v is full of v.
"""

import os
import sys
import time
from pathlib import Path

import numpy as np

from enact_dist import Aspect, Durability, Entity, Lock, Read, Write, connect
from enact_dist.errors import NullDatumError

ARRAY = Aspect("array", np.ndarray, Durability.VOLATILE)
KEPT = Aspect("kept", np.ndarray, Durability.OS)
ASPECTS = {"array": ARRAY, "kept": KEPT}


def say(*words):
    print(*words, flush=True)


def request(kind, cell, name):
    return kind(cell.world("online"), Entity("piece"), ASPECTS[name])


def fill(cell, way, size, value, name="array"):
    """Commit an array of `size` bytes full of `value`, by `put` or by `new`."""
    write = request(Write, cell, name)
    with Lock(write) as lock:
        if way == "put":
            lock[write] = np.full(int(size), int(value), np.uint8)
        else:
            lock.new(write, (int(size),), np.uint8)[:] = int(value)
    say("filled:", cell.statistics().get("payload_fallbacks", 0))
    sys.stdin.readline()


def fill_slowly(cell, way, size, value):
    """Begin to fill an array and never come to an end."""
    write = request(Write, cell, "array")
    with Lock(write, hold_s=600) as lock:
        say("filling")
        if way == "new":
            array = lock.new(write, (int(size),), np.uint8)
            half = len(array) // 2
            array[:half] = int(value)
            say("half")
            time.sleep(600)
        say("half")
        while True:
            lock[write] = np.full(int(size), int(value), np.uint8)


def read(cell, name="array"):
    """Read the array whole; say its length and its values."""
    asked = request(Read, cell, name)
    try:
        with Lock(asked) as lock:
            array = lock[asked]
    except NullDatumError as error:
        say("read: null", error.reason)
    else:
        way = "mapped" if payload_maps() else "copied"
        say("read:", len(array), int(array.min()), int(array.max()), way)
    sys.stdin.readline()


def hold(cell, name="array"):
    """Read the array and keep it; on each line say what is in it."""
    asked = request(Read, cell, name)
    with Lock(asked) as lock:
        array = lock[asked]
        say("held:", len(array), int(array[0]), int(array[-1]))
    for _ in sys.stdin:
        say("still:", len(array), int(array.min()), int(array.max()))


def payload_maps():
    root = os.environ["ENACT_SHARED_FOLDER"]
    return [line for line in Path("/proc/self/maps").read_text().splitlines() if root in line]


if __name__ == "__main__":
    role, file, *arguments = sys.argv[1:]
    with connect(file) as cell:
        globals()[role](cell, *arguments)
