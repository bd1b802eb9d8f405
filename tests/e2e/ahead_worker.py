"""Clients with files ahead that fork, freeze in a block, or publish on and on.

ahead_worker.py ROLE CELL [ARGUMENT…]; an image of number n is full of n.
"""

import os
import signal
import sys

import numpy as np

from enact_dist import Aspect, Durability, Entity, Lock, View, Write, connect
from enact_dist.errors import EnactError, LeaseLostError, MisuseError

IMAGE = Aspect("image", np.ndarray, Durability.VOLATILE, retention=1)
SIZE = 300_000
STEPS = 40


def say(*words):
    print(*words, flush=True)


def publish(cell, name, number, size=SIZE):
    """Commit an image and read it back; again if the machine let it wait for too long."""
    world = cell.world("online")
    write, view = Write(world, Entity(name), IMAGE), View(world, Entity(name), IMAGE)
    while True:
        try:
            with Lock(write, wait_s=60.0) as lock:
                lock[write] = np.full(size, number % 256, np.uint8)
            break
        except LeaseLostError:
            continue
    image = world.view(view)[view]
    assert image.size == size, (name, number, image.size)
    assert (image == number % 256).all(), (name, number, image.min(), image.max())


def begin(cell, name="camera"):
    """Publish until the shard has made files ahead."""
    for number in range(4):
        publish(cell, name, number)


def become_its_own(file, inherited):
    """In a child: use the parent's cell in vain, then go on as a program with its own session."""
    try:
        inherited._client.payloads.draft("s0", SIZE)
    except MisuseError:
        os.execv(sys.executable, [sys.executable, __file__, "child", file])


def child(cell, _):
    """Publish beside the parent."""
    for number in range(STEPS):
        publish(cell, "child", 100 + number)
    say("child done")


def forks(cell, file):
    """Fork in a block that has filled one file; parent and child publish both, then both end."""
    begin(cell)
    write = Write(cell.world("online"), Entity("camera"), IMAGE)
    with Lock(write, wait_s=60.0, hold_s=600.0) as lock:
        lock[write] = np.full(SIZE, 7, np.uint8)
        child = os.fork()
        if not child:
            try:
                lock[write] = np.full(SIZE, 99, np.uint8)
            except MisuseError:
                become_its_own(file, cell)
            finally:
                os._exit(3)  # it could write to a file of its parent
    view = View(cell.world("online"), Entity("camera"), IMAGE)
    assert (cell.world("online").view(view)[view] == 7).all()
    for number in range(STEPS):
        publish(cell, "camera", number)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    for number in range(STEPS):
        publish(cell, "camera", number)
    say("done:", status, cell.statistics().get("payload_fallbacks", 0))
    sys.stdin.readline()


def dies_after_a_fork(cell, file):
    """The parent is killed; its child goes on with a session of its own."""
    begin(cell)
    if not os.fork():
        try:
            say("child", os.getpid())
            sys.stdin.readline()
            become_its_own(file, cell)
        finally:
            os._exit(3)
    signal.pause()


def rests(cell, _):
    """Have files ahead, and do nothing."""
    begin(cell)
    say("rests")
    sys.stdin.readline()


def uses_one_late(cell, _):
    """Take a lock, and fill a file ahead once the test says so; then publish again."""
    begin(cell)
    write = Write(cell.world("online"), Entity("camera"), IMAGE)
    try:
        with Lock(write, wait_s=60.0, hold_s=600.0) as lock:
            say("holds")
            sys.stdin.readline()
            lock[write] = np.full(SIZE, 88, np.uint8)
            say("filled")
            sys.stdin.readline()
    except EnactError as error:
        say("ended:", type(error).__name__)
    world, view = cell.create_world("online"), View(write.world, write.entity, IMAGE)
    assert world.view(view).get(view) is None
    for number in range(6):
        publish(cell, "camera", number)
    say("done:", cell.statistics().get("payload_fallbacks", 0))
    sys.stdin.readline()


def publishes(cell, _):
    """Publish some images."""
    for number in range(12):
        publish(cell, "camera", number)
    say("done:", cell.statistics().get("payload_fallbacks", 0))
    sys.stdin.readline()


if __name__ == "__main__":
    role, file = sys.argv[1:]
    with connect(file) as opened:
        globals()[role](opened, file)
