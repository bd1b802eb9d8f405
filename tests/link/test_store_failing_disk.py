"""A disk that is really full, or fails to sync, below a real daemon: it stops by name, nothing lost.

For the full disk the daemon runs in a mount namespace of its own, its folder on a small file system
in memory; for the failing one strace lets each `fdatasync` from the fifteenth on fail.
"""

import contextlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from enact_dist import Aspect, Durability, Entity, Lock, View, Write, connect
from enact_dist.errors import CommitUnknownError, EnactError, LeaseLostError, LinkError

pytestmark = pytest.mark.slow
mounts = pytest.mark.skipif(
    os.geteuid() != 0 or shutil.which("unshare") is None, reason="mounts a file system"
)
DISK_BYTES = 900_000
BODY_BYTES = 30_000
KEPT = Aspect("kept", bytes, Durability.DURABLE)
DAEMON = """
import sys
from pathlib import Path
from enact_dist.core.protocol.messages import PlacementMap, ShardEntry
from enact_dist.core.shard.state import ShardSettings
from enact_dist.link.daemon.process import run_shard
from enact_dist.link.daemon.settings import DaemonSettings
endpoint, folder = sys.argv[1:]
shard = ShardSettings(
    "s0", PlacementMap(1, (ShardEntry("s0", (endpoint,)),), ()), worlds=("online",)
)
sys.exit(run_shard(DaemonSettings("cell", shard, (endpoint,), Path(folder))))
"""


@pytest.fixture
def disk(tmp_path):
    """A small file system that only processes in its namespace see; yields (enter, path to it)."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = f"mount -t tmpfs -o size={DISK_BYTES} tmpfs {folder} && echo mounted && exec cat"
    command = ["unshare", "-m", "sh", "-c", mount]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        if holder.stdout.readline() != b"mounted\n":
            pytest.skip("may not mount a file system here")
        enter = ["nsenter", "--mount", f"--target={holder.pid}"]
        yield enter, folder, Path(f"/proc/{holder.pid}/root") / folder.relative_to("/")
        holder.stdin.close()


@contextlib.contextmanager
def running(enter, endpoint, folder):
    """Run a daemon in the namespace; yields its process once it is ready."""
    command = [*enter, sys.executable, "-c", DAEMON, endpoint, str(folder)]
    daemon = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        line = daemon.stdout.readline()
        assert line.startswith("ready: "), line + daemon.stderr.read()
        yield daemon
    finally:
        daemon.kill()
        daemon.communicate()


def write_until_it_fails(endpoint):
    """Write one entity after the other; return how many were answered, and what then came."""
    with connect(endpoint) as joined:
        online = joined.world("online")
        number = lost = 0
        while number < 200:
            request = Write(online, Entity(f"e{number}"), KEPT)
            try:
                with Lock(request, wait_s=30.0) as lock:
                    lock[request] = bytes([number]) * BODY_BYTES
            except LeaseLostError:
                lost += 1
                assert lost < 60, "lost again and again"
                continue  # of a slow machine, and nothing was written: the disk has not failed yet
            except EnactError as failure:
                return number, failure
            number += 1
    raise AssertionError("the disk never was full")


def check_and_go_on(endpoint, written):
    """See that all that was answered is there, and that more can be written."""
    with connect(endpoint) as joined:
        online = joined.world("online")
        views = [View(online, Entity(f"e{number}"), KEPT) for number in range(written + 1)]
        snapshot = online.view(*views)
        for number, view in enumerate(views[:-1]):
            assert snapshot[view] == bytes([number]) * BODY_BYTES
        # The last one was not answered: there whole, or not at all.
        assert snapshot.get(views[-1], None) in {None, bytes([written]) * BODY_BYTES}
        request = Write(online, Entity("after"), KEPT)
        with Lock(request, wait_s=30.0) as lock:
            lock[request] = b"goes on"


@mounts
def test_full_disk_stops_the_daemon_and_loses_nothing_that_was_answered(disk, endpoint):
    """The writer gets a named error, the operator folder and free bytes; then all goes on."""
    enter, folder, seen = disk
    data = folder / "data"
    with running(enter, endpoint, data) as daemon:
        written, failure = write_until_it_fails(endpoint)
        assert daemon.wait(timeout=60) == 1
        story = daemon.stderr.read()
    assert isinstance(failure, CommitUnknownError | LinkError), failure
    assert written > 3
    free = os.statvfs(seen)
    assert f"no room for the data of {data}: " in story
    assert " bytes are free there" in story
    assert free.f_bavail * free.f_frsize < 4 * BODY_BYTES
    assert "Traceback" not in story

    subprocess.run([*enter, "mount", "-o", "remount,size=9m", str(folder)], check=True)
    with running(enter, endpoint, data):
        check_and_go_on(endpoint, written)


@mounts
def test_daemon_on_a_full_disk_does_not_start_and_says_why(disk, endpoint):
    """Not even the epoch can be kept: refused with folder and free bytes, nothing broken."""
    enter, folder, seen = disk
    data = folder / "data"
    with running(enter, endpoint, data) as daemon:
        daemon.terminate()
        assert daemon.wait(timeout=60) == 0
    with contextlib.suppress(OSError), (seen / "ballast").open("wb", buffering=0) as ballast:
        while True:
            ballast.write(bytes(4096))
    command = [*enter, sys.executable, "-c", DAEMON, endpoint, str(data)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 1
    assert f"no room for the data of {data}: 0 bytes are free there" in ended.stderr

    (seen / "ballast").unlink()
    with running(enter, endpoint, data):
        pass


@pytest.mark.skipif(shutil.which("strace") is None, reason="needs strace")
def test_failed_sync_stops_the_daemon_and_loses_nothing_that_was_answered(tmp_path, endpoint):
    """An I/O error from the disk: named to both sides, not tried again, and no answer was wrong."""
    data = tmp_path / "data"
    inject = "inject=fdatasync:error=EIO:when=15+"
    strace = ["strace", "-f", "-o", str(tmp_path / "trace"), "-e", "trace=fdatasync", "-e", inject]
    with running(strace, endpoint, data) as daemon:
        written, failure = write_until_it_fails(endpoint)
        assert daemon.wait(timeout=60) == 1
        story = daemon.stderr.read()
    assert isinstance(failure, CommitUnknownError | LinkError), failure
    assert written > 3
    assert f"the disk or file system below {data} fails" in story
    assert "Traceback" not in story
    calls = (tmp_path / "trace").read_text().splitlines()
    failed = [number for number, call in enumerate(calls) if "EIO" in call]
    assert failed
    # Only the closing of the database may still try to carry its log over; nobody is answered then.
    assert len(failed) <= 2

    with running([], endpoint, data):
        check_and_go_on(endpoint, written)
