"""Client processes that write and read large arrays; each line of output is waited for by a test.

payload_worker.py ROLE CELL [ARGUMENT…]; an array of version v is full of v.  PAYLOAD_WORKER_USER
names another user, its group and further groups by number.
"""

import importlib
import os
import pkgutil
import sys
from pathlib import Path

import numpy as np

import enact_dist.config
import enact_dist.core
import enact_dist.link
import enact_dist.wire
from enact_dist import Aspect, Durability, Entity, Lock, Read, Write, connect
from enact_dist.errors import LeaseLostError, NullDatumError

ARRAY = Aspect("array", np.ndarray, Durability.VOLATILE)
KEPT = Aspect("kept", np.ndarray, Durability.OS)
ASPECTS = {"array": ARRAY, "kept": KEPT}


def say(*words):
    print(*words, flush=True)


def certainly(act):
    """Do it again as long as its lock was lost, by a machine that let it wait."""
    while True:
        try:
            return act()
        except LeaseLostError:
            continue


def request(kind, cell, name):
    return kind(cell.world("online"), Entity("piece"), ASPECTS[name])


def fill(cell, way, size, value, name="array"):
    """Commit an array of `size` bytes full of `value`, by `put` or by `new`."""
    write = request(Write, cell, name)

    def commit():
        before = cell.statistics().get("payload_fallbacks", 0)
        with Lock(write, wait_s=60.0) as lock:
            if way == "put":
                lock[write] = np.full(int(size), int(value), np.uint8)
            else:
                lock.new(write, (int(size),), np.uint8)[:] = int(value)
        return cell.statistics().get("payload_fallbacks", 0) - before

    say("filled:", certainly(commit))
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
            sys.stdin.read()
        say("half")
        while True:
            lock[write] = np.full(int(size), int(value), np.uint8)


def read(cell, name="array"):
    """Read the array whole; say its length and its values."""
    asked = request(Read, cell, name)

    def look():
        with Lock(asked, wait_s=60.0) as lock:
            return lock[asked]

    try:
        array = certainly(look)
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


def become(user, group, *groups):
    """Go on as another user, who may not be able to read the interpreter's own files."""
    import zenoh  # noqa: F401

    for package in (enact_dist.core, enact_dist.wire, enact_dist.config, enact_dist.link):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            importlib.import_module(module.name)
    os.setgroups([int(one) for one in groups])
    os.setresgid(int(group), int(group), int(group))
    os.setresuid(int(user), int(user), int(user))


if __name__ == "__main__":
    if os.environ.get("PAYLOAD_WORKER_USER"):
        become(*os.environ["PAYLOAD_WORKER_USER"].split())
    role, file, *arguments = sys.argv[1:]
    with connect(file) as cell:
        globals()[role](cell, *arguments)
