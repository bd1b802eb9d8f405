"""Large data in shared memory: whoever dies, no half datum is read and no memory is lost."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from polling import until

from enact_dist import Entity, Lock, View, Write, connect
from enact_dist.core.protocol.messages import Survey
from enact_dist.errors import LeaseLostError, NoRoomError
from enact_dist.terms import Aspect, Durability

pytestmark = pytest.mark.slow
WORKER = str(Path(__file__).with_name("payload_worker.py"))
SIZE = 100_000_000
SMALL = 20_000_000
PAGE_BYTES = 1 << 20
"""What a file system may keep for itself between two looks at it."""
LAUNCH = "import os, sys; os.execvp(sys.argv[1], sys.argv[1:])"
CAP_S = float(os.environ.get("ENACT_TEST_CAP_S", "6"))
"""How long the cap is tried; 600 is the full run, under a cap of 1 GiB."""
piece = Entity("piece")
both = pytest.mark.carrier("socket", "zenoh")
some_without = pytest.mark.carrier("auto")
"""Some of these processes see no socket of the shard, others do."""


@pytest.fixture
def run(make_process):
    """Start payload workers: `run(cell, role, …)`, those with `before` in another namespace."""

    def start(cell, role, *words, before=(), **variables):
        # By the endpoint: another user may not read the file.
        line = [WORKER, role, f"tcp/127.0.0.1:{cell.ports['s0']}", *map(str, words)]
        if before:
            line = ["-c", LAUNCH, *before, sys.executable, *line]
        return make_process(*line, **variables)

    return start


def used(root):
    """Return how many bytes of memory the file system takes, deleted files in use included."""
    system = os.statvfs(root)
    return (system.f_blocks - system.f_bfree) * system.f_frsize


def done(process):
    """Let a worker end."""
    process.tell("")
    assert process.finish() == 0, process.story()


def committed(run, cell, way, size, value, name="array"):
    worker = run(cell, "fill", way, size, value, name)
    fallbacks = int(worker.expect("filled:"))
    done(worker)
    return fallbacks


def seen(run, cell, name="array", **options):
    worker = run(cell, "read", name, **options)
    found = worker.expect("read:")
    done(worker)
    return found


# ---------------------------------------------------------------- deaths


@both
@pytest.mark.sampled(2)
@pytest.mark.parametrize("way", ["put", "new"])
def test_writer_killed_while_it_fills_leaves_nothing(make_cell, run, root, way):
    """Readers keep the datum before; the draft's memory comes back while the shard lives on."""
    cell = make_cell(ttl_s=1.0).start_all()
    committed(run, cell, "put", SMALL, 1)
    before = used(root)
    for _ in range(3):
        writer = run(cell, "fill_slowly", way, SIZE, 2)
        writer.expect("half")
        until(lambda: used(root) > before + SIZE // 2)

        writer.signal(signal.SIGKILL)
        writer.finish()

        assert seen(run, cell) == f"{SMALL} 1 1 mapped"
        until(lambda: used(root) < before + PAGE_BYTES)


@both
@pytest.mark.sampled(1)
def test_reader_killed_while_it_maps_leaves_nothing(make_cell, run, root):
    """Its map of a replaced version was the last: the memory comes back at once."""
    cell = make_cell().start_all()
    committed(run, cell, "put", SMALL, 1)
    reader = run(cell, "hold")
    assert reader.expect("held:") == f"{SMALL} 1 1"
    committed(run, cell, "new", SMALL, 2)
    until(lambda: sum(file.stat().st_size for file in root.glob("*/*-*")) == SMALL)
    assert used(root) > 2 * SMALL

    reader.signal(signal.SIGKILL)
    reader.finish()

    until(lambda: used(root) < SMALL + PAGE_BYTES)
    assert seen(run, cell) == f"{SMALL} 2 2 mapped"


def test_replaced_version_stays_whole_for_whoever_maps_it(make_cell, run, root):
    """As long as one has it; then its memory comes back."""
    cell = make_cell().start_all()
    committed(run, cell, "new", SMALL, 1)
    readers = [run(cell, "hold"), run(cell, "hold")]
    for reader in readers:
        reader.expect("held:")
    for value in range(2, 12):
        committed(run, cell, "put" if value % 2 else "new", SMALL, value)

    for number, reader in enumerate(readers):
        reader.tell("look")
        assert reader.expect("still:") == f"{SMALL} 1 1"
        until(lambda: used(root) < 2 * SMALL + PAGE_BYTES)
        if number:
            assert used(root) > 2 * SMALL - PAGE_BYTES
        reader.popen.stdin.close()
        assert reader.finish() == 0
    until(lambda: used(root) < SMALL + PAGE_BYTES)


@both
@pytest.mark.parametrize("name", ["array", "kept"])
def test_shard_killed_leaves_nothing_after_its_next_start(make_cell, run, root, name):
    """Drafts and payloads of the old start are swept; whoever maps one keeps it."""
    cell = make_cell(ttl_s=1.0, aspects='[aspects.kept]\ndurability = "os"').start_all()
    committed(run, cell, "put", SMALL, 1, name)
    holder = run(cell, "hold", name)
    holder.expect("held:")
    writer = run(cell, "fill_slowly", "new", SIZE, 2)
    writer.expect("half")

    cell.kill()
    assert len(list(root.glob("*/*-*"))) == 2
    cell.start()

    assert list(root.glob("*/*-*")) == []
    holder.tell("look")
    assert holder.expect("still:") == f"{SMALL} 1 1"
    assert seen(run, cell, name).startswith("null lost" if name == "array" else f"{SMALL} 1 1")
    committed(run, cell, "new", SMALL, 3, name)
    assert seen(run, cell, name) == f"{SMALL} 3 3 mapped"
    for process in (writer, holder):
        process.signal(signal.SIGKILL)
        process.finish()
    until(lambda: used(root) < SMALL + PAGE_BYTES)


# ---------------------------------------------------------------- the cap


def test_memory_never_exceeds_the_cap(make_cell, root, monkeypatch):
    """74 MB/s, every version retained: the oldest go, and what cannot fit is refused by name."""
    cap = 1 << 30 if CAP_S > 60 else 150_000_000
    monkeypatch.setenv("ENACT_SHARED_BYTES_MAX", str(cap))
    frames = Aspect("frame", bytes, Durability.VOLATILE, retention=256)
    cell = make_cell().start_all()
    most, period_s, size = 0, 0.1, 7_400_000
    with connect(cell.file) as joined:
        online = joined.world("online")
        write = Write(online, piece, frames)
        begun_s = time.monotonic()
        number = 0

        def put(number):
            for _ in range(60):  # one that was lost, by a machine that let it wait, wrote nothing
                with contextlib.suppress(LeaseLostError), Lock(write) as lock:
                    lock.put(write, bytes(size), stamp_ns=number)
                if lock.position is not None:
                    return
            raise AssertionError("lost again and again")

        while time.monotonic() < begun_s + CAP_S:
            number += 1
            put(number)
            most = max(most, used(root))
            left_s = begun_s + number * period_s - time.monotonic()
            time.sleep(max(0.0, left_s))  # the rate is part of the case
        (shard,) = joined.shards()
        survey = Survey(("online",), (), ("frame",), retained=True)
        kept = joined._client.call("s0", survey).states
        assert most <= cap + PAGE_BYTES
        assert shard.counters["payload_bytes"] <= cap
        stamps = [state.captured_ns for state in kept]
        assert stamps == list(range(number - len(stamps) + 1, number + 1)), "a hole in history"
        if number * size > cap:
            assert shard.counters["history_dropped"] > 0
            assert len(stamps) > cap // size - 3, "more went than had to"

        def too_much():
            with Lock(write) as lock:
                lock[write] = bytes(cap - size + 1)

        with pytest.raises(NoRoomError, match=r"payload of .* of at most .* online:piece/frame"):
            too_much()
        with Lock(View(online, piece, frames)) as lock:
            assert lock.stamp_ns(View(online, piece, frames)) == number
        (shard,) = joined.shards()
        assert shard.counters["payloads_refused"] == 1
        assert len(joined._client.call("s0", survey).states) == len(kept), "for nothing"
    assert used(root) <= cap + PAGE_BYTES


@pytest.mark.parametrize("root", [30 << 20], indirect=True)
def test_full_file_system_costs_no_datum(make_cell, run, root):
    """Half of a small folder is used; what is larger travels, and it is counted."""
    cell = make_cell().start_all()

    assert committed(run, cell, "put", SMALL // 2, 1) == 0
    assert seen(run, cell) == f"{SMALL // 2} 1 1 mapped"
    assert committed(run, cell, "put", SIZE, 2) == 1
    assert seen(run, cell) == f"{SIZE} 2 2 copied"
    assert committed(run, cell, "new", SIZE, 3) == 1
    assert seen(run, cell) == f"{SIZE} 3 3 copied"
    assert committed(run, cell, "new", SMALL // 2, 4) == 0
    assert seen(run, cell) == f"{SMALL // 2} 4 4 mapped"


@pytest.mark.parametrize("root", [30 << 20], indirect=True)
def test_full_file_system_under_a_larger_cap_costs_no_datum(make_cell, run, root, monkeypatch):
    """The cap says more than there is: the system's own refusal counts (and no SIGBUS)."""
    monkeypatch.setenv("ENACT_SHARED_BYTES_MAX", str(1 << 30))
    cell = make_cell().start_all()

    assert committed(run, cell, "put", SMALL, 1) == 0
    assert committed(run, cell, "new", SIZE, 2) == 1
    assert seen(run, cell) == f"{SIZE} 2 2 copied"


# ---------------------------------------------------------------- other namespaces


@contextlib.contextmanager
def namespace(*commands):
    """A mount namespace in which these were run; yields what enters it."""
    script = " && ".join((*commands, "echo mounted", "exec cat"))
    holding = ["unshare", "-m", "sh", "-c", script]
    with subprocess.Popen(holding, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        try:
            if holder.stdout.readline() != b"mounted\n":
                pytest.skip("no mount namespace can be made here")
            yield ["nsenter", "--mount", f"--target={holder.pid}", f"--wd={Path.cwd()}"]
        finally:
            holder.stdin.close()


@some_without
def test_namespaces_without_common_memory_give_the_same(make_cell, run, root):
    """Both ways over the network, and nobody but a counter notices."""
    cell = make_cell().start_all()
    committed(run, cell, "new", SMALL, 1)
    with namespace(f"mount -t tmpfs tmpfs {root}") as enter:
        assert seen(run, cell, before=enter) == f"{SMALL} 1 1 copied"
        for way, value in (("put", 2), ("new", 3)):
            worker = run(cell, "fill", way, SMALL, value, before=enter)
            worker.expect("filled:")
            done(worker)
            assert seen(run, cell, before=enter) == f"{SMALL} {value} {value} copied"
            assert seen(run, cell).startswith(f"{SMALL} {value} {value} ")


@some_without
def test_folder_of_another_incarnation_is_not_used(make_cell, run, root, tmp_path):
    """The same name and files, and another nonce: what is in there is somebody else's."""
    cell = make_cell().start_all()
    committed(run, cell, "new", SMALL, 1)
    (folder,) = root.iterdir()
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy / folder.name, ignore=shutil.ignore_patterns("socket"))
    copy.chmod(0o700)
    nonce = copy / folder.name / "nonce"
    nonce.chmod(0o600)
    nonce.write_bytes(bytes(16))
    for file in (copy / folder.name).glob("*-*"):
        file.chmod(0o600)
        file.write_bytes(b"\xff" * SMALL)
    with namespace(f"mount --bind {copy} {root}") as enter:
        assert seen(run, cell, before=enter) == f"{SMALL} 1 1 copied"


@some_without
def test_folder_that_can_only_be_read_gives_maps_and_takes_nothing(make_cell, run, root):
    """As in a container whose root is read-only: readers map, writers take the network."""
    cell = make_cell().start_all()
    committed(run, cell, "new", SMALL, 1)
    with namespace(
        f"mount --bind -o ro {root} {root}", f"mount -o remount,bind,ro {root}"
    ) as enter:
        assert seen(run, cell, before=enter) == f"{SMALL} 1 1 mapped"
        worker = run(cell, "fill", "put", SMALL, 2, before=enter)
        assert worker.expect("filled:") == "1"
        done(worker)
        assert seen(run, cell, before=enter).startswith(f"{SMALL} 2 2 ")


@some_without
def test_users_of_the_group_and_strangers_get_copies(make_cell, run, root):
    """What another user may open as a file, he could change after its commit."""
    if os.geteuid() != 0:
        pytest.skip("becomes two other users")
    os.chown(root, -1, 4242)
    root.chmod(0o2770)
    cell = make_cell().start_all()
    committed(run, cell, "new", SMALL, 1)
    user = {"PAYLOAD_WORKER_USER": "4243 4243 4242"}
    stranger = {"PAYLOAD_WORKER_USER": "4244 4244"}

    assert seen(run, cell, **user) == f"{SMALL} 1 1 copied"
    worker = run(cell, "fill", "new", SMALL, 2, **user)
    assert worker.expect("filled:") == "0"
    done(worker)
    assert seen(run, cell).startswith(f"{SMALL} 2 2 ")
    assert seen(run, cell, **stranger) == f"{SMALL} 2 2 copied"


@pytest.mark.carrier("zenoh")
@pytest.mark.parametrize("way", ["put", "new"])
def test_data_are_shared_whatever_carries_the_messages(make_cell, run, root, way):
    """A cell without sockets shares memory as well."""
    cell = make_cell().start_all()

    assert committed(run, cell, way, SMALL, 1) == 0
    assert seen(run, cell) == f"{SMALL} 1 1 mapped"
    assert not list(root.glob("*/socket"))
