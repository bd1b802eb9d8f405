"""Files mapped into memory: they last as long as somebody looks, and nothing is left open."""

import gc
import os
import tempfile
from pathlib import Path

import numpy as np
import pytest

from enact_dist.link.memory.maps import (
    AT_ONCE_BYTES,
    STEP_BYTES,
    Leftovers,
    body_of,
    leftovers,
    map_file,
    plain_memory,
    withdraw,
)

SIZES = (1, 4096, AT_ONCE_BYTES + 1, STEP_BYTES + 5)


@pytest.fixture
def file():
    with tempfile.TemporaryFile(dir="/dev/shm") as opened:
        yield opened


def maps(file):
    """Return how many maps of a file this process has."""
    inode = str(os.fstat(file.fileno()).st_ino)
    lines = Path("/proc/self/maps").read_text().splitlines()
    return sum(line.split()[4] == inode for line in lines)


def descriptors():
    """Return how many files this process has open."""
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.mark.parametrize("size", SIZES)
def test_map_lasts_as_long_as_a_view_of_it(file, size):
    """A slice of an array over a slice of the body keeps all of it; no descriptor does."""
    os.posix_fallocate(file.fileno(), 0, size)
    os.pwrite(file.fileno(), b"x", size - 1)
    gc.collect()  # what earlier tests have left
    assert leftovers().wait(30.0)
    before, ended = maps(file), []
    opened = descriptors()

    body = body_of(map_file(file.fileno(), size, writable=False, ended=lambda: ended.append(1)))
    last = np.frombuffer(body.toreadonly(), np.uint8)[-1:]
    del body
    assert (last[0], maps(file), ended) == (ord("x"), before + 1, [])
    assert descriptors() == opened
    del last
    gc.collect()
    assert leftovers().wait(30.0)
    assert (maps(file), ended) == (before, [1])


def test_map_for_reading_cannot_be_written(file):
    """Neither by the memoryview nor through an array over it."""
    os.posix_fallocate(file.fileno(), 0, 4096)
    body = body_of(map_file(file.fileno(), 4096, writable=False)).toreadonly()
    array = np.frombuffer(body, np.uint8)

    with pytest.raises(TypeError):
        body[0] = 1
    with pytest.raises(ValueError, match="WRITEABLE"):
        array.flags.writeable = True


def test_map_that_cannot_be_is_an_error(file):
    """A descriptor for reading gives no writable map."""
    os.posix_fallocate(file.fileno(), 0, 4096)
    reading = os.open(f"/proc/self/fd/{file.fileno()}", os.O_RDONLY)
    try:
        with pytest.raises(PermissionError):
            map_file(reading, 4096, writable=True)
    finally:
        os.close(reading)


@pytest.mark.parametrize("size", SIZES)
def test_withdrawn_memory_stays_as_it_was_and_reaches_nobody(file, size):
    """A stray write through a view that was made before neither crashes nor changes the file."""
    os.posix_fallocate(file.fileno(), 0, size)
    pages = map_file(file.fileno(), size, writable=True)
    view = np.frombuffer(body_of(pages), np.uint8)
    view[:] = 7

    withdraw(pages, file.fileno())

    assert (view == 7).all()
    view[:] = 9
    assert os.pread(file.fileno(), size, 0) == b"\x07" * size


def test_plain_memory_ends_as_a_map_does():
    """Once, when the last view is gone."""
    ended = []
    view = body_of(plain_memory(1000, ended=lambda: ended.append(1)))[5:]

    assert ended == []
    del view
    assert ended == [1]


def test_what_was_left_is_done_after_something_that_failed():
    """Memory is given back by the same thread, for all."""
    left = Leftovers()

    left.later(int, "none")

    assert left.wait(30.0)
    assert left.wait(30.0)
