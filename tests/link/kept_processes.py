"""What the tests of kept grants share: a process that keeps one, and what others see of it."""

import os
import signal
import threading
from concurrent.futures import ThreadPoolExecutor

from socket_parts import COUNT, CUP

from enact_dist import Lock, Write

RETAINER = """
import ctypes, os, signal, sys, threading
from enact_dist import Aspect, Durability, Entity, Lock, Read, Write, connect
from enact_dist.errors import EnactError
from enact_dist.world import connecting

connecting.TTL_S = float(os.environ.get("LEASE_S", connecting.TTL_S))
signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1})
cell = connect(sys.argv[1], actor="retainer")
online, cup = cell.world("online"), Entity("cup")
COUNT = Aspect("count", int, Durability.VOLATILE)
write, read = Write(online, cup, COUNT), Read(online, cup, COUNT)
kept = cell._client.core.kept.by_items

def add_one():
    with Lock(write, wait_s=60.0) as lock:
        lock[write] = lock.get(write, 0) + 1

def keep(request=write):
    for _ in range(10):
        if kept:
            return
        with Lock(request) as lock:
            if request is write:
                lock[write] = lock.get(write, 0)
    assert kept, cell.statistics()

def tell(*words):
    print(*words, flush=True)

def hear():
    return sys.stdin.readline().strip()

def hold_interpreter():
    ctypes.PyDLL(None).read(0, ctypes.create_string_buffer(1), 1)

exec(sys.argv[2])
"""
"""A client that runs the text of its second argument."""


def slot(cell, entity=CUP):
    return Write(cell.world("online"), entity, COUNT)


def kept_of(cell):
    """Return the kept grants of this session that no block uses."""
    return cell._client.core.kept.by_items


def keep(cell, request):
    """Lock the same again and again until the grant stays."""
    before, number = len(kept_of(cell)), 0
    while len(kept_of(cell)) == before:
        with Lock(request) as lock:
            if isinstance(request, Write):
                lock[request] = lock.get(request, 0)
        number += 1
        assert number < 10, cell.statistics()


def used_again(cell):
    """Return how many locks of this session have used a kept grant."""
    return cell.statistics().get("grants_used_again", 0)


def heard(process, line):
    """Take the next line of a process, which has to be this one."""
    found = process.stdout.readline()
    assert found == line + "\n", (found, process.stderr.read() if not found else "")


def stopped(process):
    """Stop a process; return once the kernel says that it is stopped."""
    process.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, process.pid, os.WSTOPPED)


class Waiting:
    """A lock that another thread waits for."""

    def __init__(self, request, *, wait_s=60.0):
        self.granted = threading.Event()
        self.failed = []
        self._request, self._wait_s = request, wait_s
        self._thread = threading.Thread(target=self._wait)
        self._thread.start()

    def _wait(self):
        try:
            with Lock(self._request, wait_s=self._wait_s):
                self.granted.set()
        except Exception as error:
            self.failed.append(error)

    def end(self):
        self._thread.join()
        assert self.granted.is_set(), self.failed


def waiters(cell):
    return [info for info in cell.locks() if not info.granted]


def in_thread(act, *arguments):
    """Call in another thread, which may lock though this one does."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(act, *arguments).result()
