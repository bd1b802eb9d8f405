"""A host whose clock is wrong by a year: the error names validity and clock, and comes at once."""

import os
import shutil
import subprocess
import sys
import time

import pytest

pytest.importorskip("cryptography", reason="making keys needs the extra 'keys'")

import key_cells

pytestmark = [
    pytest.mark.carrier("zenoh"),
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("cc") is None, reason="a clock is shifted by a C library"),
]

YEAR_S = 366 * 86_400
SOON_S = 10.0
"""Far below what connecting may take, and far above half a second on a busy machine."""
SHIFT = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdlib.h>
#include <sys/time.h>
#include <time.h>

int clock_gettime(clockid_t clock, struct timespec *found) {
    static int (*real)(clockid_t, struct timespec *);
    if (!real) real = dlsym(RTLD_NEXT, "clock_gettime");
    int status = real(clock, found);
    if (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)
        found->tv_sec += atoll(getenv("SHIFT_S"));
    return status;
}

time_t time(time_t *found) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (found) *found = now.tv_sec;
    return now.tv_sec;
}

int gettimeofday(struct timeval *found, void *zone) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    found->tv_sec = now.tv_sec;
    found->tv_usec = now.tv_nsec / 1000;
    return 0;
}
"""
CLIENT = """
import sys, time
from enact_dist import connect
from enact_dist.errors import ShardUnreachableError

began_s = time.monotonic()
try:
    connect(sys.argv[1], actor="ada", timeout_s=60.0).close()
    print("connected")
except ShardUnreachableError as error:
    print(time.monotonic() - began_s, error)
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """A library that shifts the clock of a process by `SHIFT_S`."""
    folder = tmp_path_factory.mktemp("clock")
    (folder / "shift.c").write_text(SHIFT)
    words = ["cc", "-shared", "-fPIC", "-o", str(folder / "shift.so"), str(folder / "shift.c")]
    subprocess.run([*words, "-ldl"], check=True)
    return folder / "shift.so"


@pytest.fixture
def run(library):
    """Start a Python process with a shifted clock; killed after the test."""
    started = []

    def start(shift_s, *words):
        environment = {**os.environ, "LD_PRELOAD": str(library), "SHIFT_S": str(shift_s)}
        process = subprocess.Popen(
            [sys.executable, *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=environment,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.mark.parametrize(
    ("shard_s", "client_s", "said"),
    [
        (0, -YEAR_S, ("certificate is not yet valid; it is valid from", "clock of this host")),
        (YEAR_S, 0, ("alert certificate expired; it is valid from", "clock of the shard's host")),
        (YEAR_S, YEAR_S, ("alert certificate expired; it ended on", "this host's clock says")),
        (0, YEAR_S, ("connected",)),
    ],
)
def test_wrong_clock_is_named_with_the_validity(tmp_path, run, shard_s, client_s, said):
    """A client's certificate is good for a year, and the shard alone decides whether it is."""
    cell = key_cells.KeyCell(tmp_path)
    words = ("-m", "enact_dist.cli.main", "shard")
    shard = run(shard_s, *words, "run", "left", "--cell", str(cell.file))
    assert "ready" in shard.stdout.readline()

    found = run(client_s, "-c", CLIENT, str(cell.file)).communicate(timeout=120)[0]

    for text in (*said, "" if said == ("connected",) else "this host's clock says 20"):
        assert text in found
    if said != ("connected",):
        assert float(found.split()[0]) < SOON_S
    began_s = time.monotonic()
    check = run(client_s, *words, "check", "--timeout", "60", "--cell", str(cell.file))
    assert said[0] in check.communicate(timeout=120)[0] or check.returncode == 0
    assert (check.returncode == 0) == (said == ("connected",))
    assert time.monotonic() - began_s < 2 * SOON_S


def test_shard_with_a_wrong_clock_does_not_start(tmp_path, run):
    """Behind by a year it would be refused by everybody."""
    cell = key_cells.KeyCell(tmp_path)
    words = ("-m", "enact_dist.cli.main", "shard", "run", "left", "--cell", str(cell.file))

    shard = run(-YEAR_S, *words)
    text = shard.communicate(timeout=60)[0]

    assert shard.returncode != 0
    assert "is valid only from" in text
    assert "this host's clock says" in text
