"""A lock that has ended may be kept, as `lock` in the function that made it; its data are not."""

import gc
import os
import time
from contextlib import suppress
from pathlib import Path
from types import FunctionType, ModuleType

import numpy as np
import pytest

from enact_dist import Aspect, Durability, Entity, Lock, Read, View, Write
from enact_dist.access.session import Session
from enact_dist.core.client.client import Client
from enact_dist.core.protocol.datum import Datum
from enact_dist.link.client.fetch import DatumCache
from enact_dist.link.client.locks import CellClient
from enact_dist.link.memory.maps import leftovers

piece, bench = Entity("work_piece"), Entity("work_bench")
CLOUD = Aspect("cloud", np.ndarray, Durability.VOLATILE, retention=1)
OTHERS = (type, ModuleType, FunctionType, Client, CellClient, DatumCache, Session)
"""Whatever is of the whole cell or of all programs."""
CARRIERS = pytest.mark.carrier("local", "socket", "zenoh")


def data_of(lock):
    """Return what bodies are reached from a lock, by their lengths; not those of its cell."""
    seen, left, found = set(), [lock], []
    while left:
        one = left.pop()
        if id(one) in seen or isinstance(one, OTHERS):
            continue
        seen.add(id(one))
        found += [one.size] if isinstance(one, Datum) else []
        left += gc.get_referents(one)
    return found


@CARRIERS
@pytest.mark.parametrize("fails", [False, True])
@pytest.mark.parametrize("size", [10_000, 1_000_000])
def test_kept_lock_keeps_none_of_its_data(online, size, fails):
    """Neither what it has read, nor what it wrote, was to write or handed out to be filled."""
    write, other = Write(online, piece, CLOUD), Write(online, bench, CLOUD)
    with Lock(write) as lock:
        lock[write] = np.zeros(size, np.uint8)
    read = Read(online, piece, CLOUD)
    for request in (View(online, piece, CLOUD), read, write):
        with suppress(KeyError), Lock(request, other) as lock:
            assert lock[request].size == size
            lock.new(other, (size,), np.uint8)[:] = 1
            if request is write:
                lock[write] = np.ones(size, np.uint8)
            assert data_of(lock), "nothing is found where there is something"
            if fails:
                raise KeyError

        assert data_of(lock) == []


@pytest.mark.carrier("socket")
def test_memory_of_a_replaced_version_goes_while_its_writers_lock_is_kept(online, loose):
    """Its file and all maps of it: nobody has an array of it any more."""
    write = Write(online, piece, CLOUD)
    with Lock(write) as kept:
        kept[write] = np.zeros(1_000_000, np.uint8)
    [file] = Path(os.environ["ENACT_SHARED_FOLDER"]).glob("*/*-*")
    assert str(file) in Path("/proc/self/maps").read_text()

    with Lock(write) as lock:
        lock[write] = np.zeros(3, np.uint8)
    loose.end()

    end_s = time.monotonic() + 30.0
    while str(file) in Path("/proc/self/maps").read_text():
        assert time.monotonic() < end_s, f"{file} is mapped still"
        leftovers().wait(0.05)
        with Lock(Read(online, piece, CLOUD)):
            pass  # its shard looks at what it may let go of
    assert not file.exists()
    assert kept.position is not None
