"""Client processes of the end-to-end tests: `worker.py ROLE CELL_FILE ARGUMENT…`.

Each prints what happened line by line and waits for lines where the test decides when to go on.
"""

import ctypes
import json
import random
import sys
import time

import numpy as np

from enact_dist import (
    Aspect,
    Durability,
    Entities,
    Entity,
    Lock,
    Read,
    View,
    Write,
    WriteEach,
    connect,
)
from enact_dist.errors import (
    CommitUnknownError,
    EnactError,
    LeaseLostError,
    LinkError,
    LockTimeoutError,
    ShardUnreachableError,
)

COUNT = Aspect("count", int)
FRAME = Aspect("frame", np.ndarray, Durability.VOLATILE)
NAME = Aspect("name", str)
counter = Entity("counter")
OFTEN = 50
"""So many views make an audit."""


def say(*words):
    print(*words, flush=True)


def wait_line():
    return sys.stdin.readline().strip()


def certainly(act, *arguments):
    """Do it again as long as its lock was lost: nothing was written then."""
    while True:
        try:
            return act(*arguments)
        except LeaseLostError:
            continue


def stands(cell, unknown):
    """Ask for the outcome of a commit until its shard is back; say whether it stands."""
    while True:
        try:
            return cell.outcome(unknown.lock_id) is not None
        except (CommitUnknownError, ShardUnreachableError):
            continue


def increment(cell, count):
    """Add 1 to a counter `count` times; every add is certain when the process ends well."""
    request = Write(cell.world("online"), counter, COUNT)
    done = lost = 0
    say("started")
    while done < int(count):
        try:
            with Lock(request, wait_s=120.0) as lock:
                lock[request] = lock.get(request, 0) + 1
            added = True
        except (LeaseLostError, ShardUnreachableError):
            added = False  # nothing was written: do it again
        except CommitUnknownError as error:
            added = stands(cell, error)  # its shard takes longer to start than a commit waits
        done += added
        lost += not added
        if added and done % 50 == 0:
            say("progress", done)
    say("done", done, "lost", lost)


def hold(cell, hold_s="60"):
    """Take the write lock, wait for a line, then commit 111."""
    request = Write(cell.world("online"), counter, COUNT)
    try:
        with Lock(request, hold_s=float(hold_s)) as lock:
            lock[request] = 111
            say("holding")
            wait_line()
        say("committed")
    except LeaseLostError as error:
        say("lost", error)


def skew(cell):
    """Read one account and write the other, wait for a line, then commit."""
    world = cell.world("online")
    read = Read(world, Entity("account/right"), COUNT)
    write = Write(world, Entity("account/left"), COUNT)
    try:
        with Lock(read, write) as lock:
            lock[write] = lock[read] + 1
            say("holding")
            wait_line()
        say("committed")
    except LeaseLostError as error:
        say("lost", error)


def hold_gil(cell, seconds):
    """Hold the lock while the interpreter lock is held by C code for `seconds`."""
    request = Write(cell.world("online"), counter, COUNT)
    watch = cell.world("online").watch(Entities("ticker"), COUNT)
    with Lock(request, hold_s=120.0) as lock:
        say("holding")
        libc = ctypes.PyDLL(None)  # unlike CDLL, calls keep the interpreter lock
        started = time.monotonic()
        libc.sleep(int(seconds))
        say("slept", round(time.monotonic() - started, 1))
        lock[request] = 222
    say("committed")
    watch.close()


def put(request, number):
    with Lock(request, wait_s=120.0) as lock:
        lock[request] = number


def ticker(cell, hz):
    """Commit a counter at a fixed rate until told to stop; say how far it came."""
    import threading

    request = Write(cell.world("online"), Entity("ticker"), COUNT)
    stop = threading.Event()
    threading.Thread(target=lambda: (wait_line(), stop.set()), daemon=True).start()
    period_s, number = 1 / float(hz), 0
    say("started")
    due = time.monotonic()
    while not stop.is_set():
        due += period_s
        stop.wait(max(0.0, due - time.monotonic()))
        number += 1
        certainly(put, request, number)
    say("committed", number)


def opposite(cell, seed, seconds, count):
    """Lock random pairs in random order for `seconds`, adding 1 to both."""
    world, draw = cell.world("online"), random.Random(int(seed))
    entities = [Entity(f"pair/{i}") for i in range(int(count))]
    end = time.monotonic() + float(seconds)
    done, longest_s, timeouts = 0, 0.0, 0
    say("started")
    while time.monotonic() < end:
        first, second = draw.sample(entities, 2)
        one, two = Write(world, first, COUNT), Write(world, second, COUNT)
        started = time.monotonic()
        try:
            with Lock(one, two, wait_s=45.0) as lock:  # less than a lock may be held
                longest_s = max(longest_s, time.monotonic() - started)
                lock[one] = lock.get(one, 0) + 1
                lock[two] = lock.get(two, 0) + 1
            done += 1
        except LockTimeoutError:
            timeouts += 1
        except LeaseLostError:  # nothing was written
            continue
    say("done", json.dumps({"done": done, "longest_s": longest_s, "timeouts": timeouts}))


def perceive(cell, label):
    """Look for a package; create it only if nobody has."""
    each = WriteEach(cell.world("online"), Entities("package/*"), NAME)
    say("ready")
    wait_line()

    def look():
        with Lock(each, wait_s=60.0) as lock:
            packages = lock[each]
            if label in packages.values():
                return "found"
            packages[Entity.fresh("package")] = label
        return "created"

    say(certainly(look))


def view_slowly(cell):
    """View the ticker and work on it until told to look again."""
    request = View(cell.world("online"), Entity("ticker"), COUNT)
    with Lock(request) as lock:
        say("viewing", lock.get(request, 0))
        wait_line()
        say("still", lock.get(request, 0))


def read_long(cell):
    """Hold a read lock until told to leave."""
    request = Read(cell.world("online"), counter, COUNT)
    with Lock(request, hold_s=100.0):
        say("reading")
        wait_line()
    say("left")


def write_once(cell, value):
    """Write the counter once."""
    request = Write(cell.world("online"), counter, COUNT)
    say("asking")
    certainly(put, request, int(value))
    say("wrote")


def commit_pairs(cell):
    """Commit growing equal numbers to a durable and an os aspect, saying each one acknowledged."""
    world = cell.world("online")
    one = Write(world, counter, Aspect("kept", int, Durability.DURABLE))
    two = Write(world, counter, Aspect("swift", int, Durability.OS))
    number = 0
    say("started")
    while True:
        try:
            with Lock(one, two, wait_s=120.0) as lock:
                number = max(lock.get(one, 0), lock.get(two, 0)) + 1
                lock[one] = number
                lock[two] = number
            say("acknowledged", number)
        except EnactError as error:
            say("refused", type(error).__name__)


def commit_swift(cell):
    """Commit growing numbers to an os aspect alone, saying each one acknowledged."""
    request = Write(cell.world("online"), Entity("swift"), Aspect("swift", int, Durability.OS))
    say("started")
    while True:
        try:
            with Lock(request, wait_s=120.0) as lock:
                number = lock.get(request, 0) + 1
                lock[request] = number
            say("acknowledged", number)
        except EnactError as error:
            say("refused", type(error).__name__)


def watch_ticker(cell):
    """Follow the ticker up to the version that a line names; say what was seen and was missed.

    Every fifty versions it says how far it is: whoever is behind may not see each of them.
    """
    import threading

    seen = gap = last = first = told = 0
    in_order, named = True, []
    threading.Thread(target=lambda: named.append(int(wait_line())), daemon=True).start()
    with cell.world("online").watch(Entities("ticker"), COUNT) as watch:
        while not named or last < named[0]:
            change = watch.next(0.2)
            if change is None:
                continue
            in_order = in_order and change.version > last
            first = first or change.version
            seen, gap, last = seen + 1, gap + change.gap, change.version
            if last >= told + 50:
                told = last
                say("version", last)
    counts = {"first": first, "seen": seen, "gap": gap, "last": last, "in_order": in_order}
    say("summary", json.dumps(counts))


def transfer(cell, seed, count):
    """Move numbers between two accounts on two shards; every move is certain at the end."""
    world, draw = cell.world("online"), random.Random(int(seed))
    one, two = (Write(world, Entity(f"account/{side}"), COUNT) for side in ("left", "right"))
    done = again = 0
    say("started")
    while done < int(count):
        amount = draw.randint(1, 9)
        try:
            with Lock(one, two, wait_s=120.0) as lock:
                lock[one] = lock[one] - amount
                lock[two] = lock[two] + amount
        except (LeaseLostError, ShardUnreachableError):
            again += 1  # nothing was written: do it again
        except CommitUnknownError:
            done += 1  # it was asked about for 10 s; the sum says whether it is half done
            say("unknown")
        else:
            done += 1
        if done % 20 == 0:
            say("progress", done)
    say("done", done, "again", again)


def audit(cell):
    """View both accounts again and again; say when it was often, and at the end each sum seen."""
    import threading

    world, stop, sums, views = cell.world("online"), threading.Event(), set(), 0
    threading.Thread(target=lambda: (wait_line(), stop.set()), daemon=True).start()
    requests = [View(world, Entity(f"account/{side}"), COUNT) for side in ("left", "right")]
    say("started")
    while not stop.is_set():
        try:
            seen = world.view(*requests)
        except (LockTimeoutError, ShardUnreachableError):
            continue  # it was killed, or both by turns for as long as a view has patience
        views += 1
        sums.add(sum(seen[request] for request in requests))
        if views == OFTEN:
            say("often")
    say("summary", json.dumps({"views": views, "sums": sorted(sums)}))


def joined(file, role):
    """Connect; a socket that is asked for is refused where a busy shard does not greet at once."""
    for _ in range(9):
        try:
            return connect(file, actor=role, timeout_s=20.0)
        except LinkError:
            continue
    return connect(file, actor=role, timeout_s=20.0)


def main():
    role, file, *arguments = sys.argv[1:]
    with joined(file, role) as cell:
        globals()[role](cell, *arguments)


if __name__ == "__main__":
    main()
