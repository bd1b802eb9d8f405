"""What was acknowledged survives kill -9, a crash at any point, and a full disk."""

import contextlib
import os
import random
import resource
import selectors
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import store_writer
from store_writer import contents, group_versions, outcome_record, persist, reopened, slot_record

from enact_dist.core.protocol.datum import Slot
from enact_dist.core.protocol.records import SessionRecord, SlotRecord
from enact_dist.errors import StoreError
from enact_dist.link.folder.lock import FORMAT
from enact_dist.link.folder.mark import MarkFile
from enact_dist.link.store.database import Database
from enact_dist.link.store.store import open_store
from enact_dist.terms import Durability

FORMAT_LINE = f"enact-dist store {FORMAT}\n".encode()
FRAME_BYTES = 24 + 4096
LOG_HEADER_BYTES = 32


@pytest.fixture
def writers(tmp_path):
    """A process that starts one writer after the other on the same folder."""
    command = [sys.executable, store_writer.__file__, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as writers:
        yield writers
        writers.stdin.close()


def test_acknowledged_batches_survive_kill_9_at_random_moments(tmp_path, writers):
    """20 kills of a busy writer: every acknowledged batch is there, none is half there."""
    rng = random.Random(5)
    acknowledged = [0] * store_writer.GROUPS
    acknowledged_in_all = 0
    for number in range(20):
        for group, version in killed_writer(writers, number, run_s=rng.uniform(0.0, 0.1)):
            assert version > acknowledged[group]
            acknowledged[group] = version
            acknowledged_in_all += 1
        store, recovered = open_store(tmp_path, unix_s=1)
        found = group_versions(recovered)
        pairs = list(zip(acknowledged, found, strict=True))
        assert all(a <= b <= a + store_writer.IN_FLIGHT for a, b in pairs), pairs
        assert len(list((tmp_path / "blobs").iterdir())) == sum(v > 0 for v in found)
        store.close()
        acknowledged = found
    assert acknowledged_in_all > 100


def killed_writer(writers, seed, *, run_s, ready=lambda _: None):
    """Let a writer run for `run_s`, kill it, and return the (group, version) it acknowledged.

    `ready` is called with its process once it writes, and may kill it before.
    """
    writers.stdin.write(f"{seed}\n".encode())
    writers.stdin.flush()
    said = b""
    pid, end_s = 0, time.monotonic() + 20.0
    with selectors.DefaultSelector() as selector:
        selector.register(writers.stdout, selectors.EVENT_READ)
        while not said.endswith(b"ended\n"):
            if selector.select(max(end_s - time.monotonic(), 0.0)):
                part = os.read(writers.stdout.fileno(), 65_536)
                assert part, said
                said += part
            if not pid and b"\n" in said:
                pid, end_s = int(said.split()[1]), time.monotonic() + run_s
                ready(pid)
            if time.monotonic() >= end_s:
                assert pid, "the writer did not open its store"
                os.kill(pid, signal.SIGKILL)
                end_s = time.monotonic() + 20.0
    lines = said.decode().splitlines()[1:-1]
    return [tuple(map(int, line.split())) for line in lines]


def crash_points(folder):
    """Write to a store and crash; return (log length, mark, contents) after each batch."""
    rng = random.Random(3)
    store, recovered = open_store(folder, unix_s=100)
    log, mark = folder / "store.db-wal", folder / "mark"
    points = [(log.stat().st_size, mark.read_bytes(), contents(recovered))]
    state = {}
    for version in range(1, 16):
        durability = rng.choice([Durability.DURABLE, Durability.OS])
        records = [slot_record(f"e{rng.randrange(6)}", version) for _ in range(rng.randrange(1, 4))]
        records += [slot_record("large", version, size=70_000), outcome_record(0, version)]
        records += [SessionRecord(f"session{version}", version)]
        records += [SlotRecord(Slot("w", f"v{version}", "a"), 0, 0, None, "", volatile=True)]
        store.write([persist(*records, durability=durability)])
        for record in records:
            state[
                getattr(record, "slot", None) or str(type(record)) + getattr(record, "session", "")
            ] = record
        points.append((log.stat().st_size, mark.read_bytes(), state_of(state)))
    crashed = folder.with_name("crashed")
    shutil.copytree(folder, crashed)
    store.close()
    return crashed, points


def state_of(state):
    """Return what `contents` shows of a store that holds these records."""
    slots = [record for record in state.values() if isinstance(record, SlotRecord)]
    sessions = [record for record in state.values() if isinstance(record, SessionRecord)]
    outcomes = [r for r in state.values() if not isinstance(r, SlotRecord | SessionRecord)]
    return (
        {record.slot: store_writer.flat(record) for record in slots},
        {(outcome.lock.session, outcome.lock.lane): outcome for outcome in outcomes},
        [],
        [],
        sorted((record.session, record.ttl_ns) for record in sessions),
    )


def test_store_opens_with_a_prefix_wherever_a_crash_cuts_the_log(tmp_path):
    """Cut at every frame and inside frames, with and without rubbish behind: a prefix, whole."""
    rng = random.Random(4)
    crashed, points = crash_points(tmp_path / "folder")
    log = (crashed / "store.db-wal").read_bytes()
    assert points[-1][0] == len(log)
    frames = (len(log) - LOG_HEADER_BYTES) // FRAME_BYTES
    first = points[0][0]
    boundaries = [LOG_HEADER_BYTES + number * FRAME_BYTES for number in range(frames + 1)]
    torn = [rng.randrange(first, len(log)) for _ in range(15)]
    torn += [boundary + 24 for boundary in boundaries[-4:-1]]
    seen = set()
    for cut in sorted({*boundaries, *torn}):
        if cut < first:
            continue
        _, mark, expected = [point for point in points if point[0] <= cut][-1]
        seen.add(len(expected[0]))
        tail = rng.randbytes(rng.randrange(5000)) if rng.random() < 0.3 else b""
        folder = tmp_path / "copy"
        shutil.copytree(crashed, folder)
        (folder / "store.db-wal").write_bytes(log[:cut] + tail)
        (folder / "mark").write_bytes(mark)
        assert contents(reopened(folder)) == expected, cut
        assert contents(reopened(folder)) == expected, "the second opening differs"
        shutil.rmtree(folder)
    assert len(seen) > 8


def test_torn_log_written_on_and_torn_again_opens(tmp_path):
    """Remains of a torn transaction behind the end of the log never look like damage later."""
    folder = tmp_path / "folder"
    crashed, points = crash_points(folder)
    log = crashed / "store.db-wal"
    length, mark, expected = points[3]
    spoilt = bytearray(log.read_bytes())
    spoilt[length : length + 4] = b"\xff\xff\xff\xff"
    log.write_bytes(spoilt[: length + 2 * FRAME_BYTES - 1])
    (crashed / "mark").write_bytes(mark)
    store, recovered = open_store(crashed, unix_s=1)
    assert contents(recovered) == expected
    store.write([persist(slot_record("a", 1))])
    again = tmp_path / "again"
    shutil.copytree(crashed, again)
    store.close()
    assert "a" in {record.slot.entity for record in reopened(again).slots}


def test_crash_at_the_first_opening_leaves_a_usable_folder(tmp_path):
    """Whatever step of making a new folder was the last one, the next opening succeeds."""
    whole = tmp_path / "whole"
    store, _ = open_store(whole, unix_s=1)
    crashed = tmp_path / "crashed"
    shutil.copytree(whole, crashed)
    store.close()
    database = (crashed / "store.db").read_bytes()
    Database(tmp_path / "bare.db").close()
    bare = (tmp_path / "bare.db").read_bytes()
    marked = {"format": FORMAT_LINE, "mark": first_mark(tmp_path)}
    steps = [
        {},
        {"format": FORMAT_LINE},
        marked,
        {**marked, "store.db": b""},
        {**marked, "store.db": bare},
        {**marked, "store.db": bare, "store.db-wal": b""},
        {**marked, "store.db": database},
        {**marked, "store.db": database, "store.db-wal": b""},
    ]
    for number, step in enumerate(steps):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "lock").touch()
        for name, content in step.items():
            (folder / name).write_bytes(content)
        assert reopened(folder, unix_s=9).epoch == 9


def first_mark(folder):
    """Return the mark that a first start leaves before everything else."""
    MarkFile.open(folder, 0).close()
    return (folder / "mark").read_bytes()


def test_first_start_marks_the_boot_before_the_log(tmp_path):
    """Else a power cut during the first start could not be told from a damaged log."""
    script = f"""
import os
from pathlib import Path
from store_writer import open_store
open_store(Path({str(tmp_path / "folder")!r}), unix_s=1)
os.write(1, b"opened")
"""
    ((_, calls),) = traced(tmp_path, script)
    logged = next(i for i, call in enumerate(calls) if "store.db-wal>" in call)
    assert any(call.startswith("fsync(") and "/mark>" in call for call in calls[:logged])
    assert any(call.startswith("fsync(") and "/folder>" in call for call in calls[:logged])


@contextlib.contextmanager
def file_size_limit(count):
    """Let this process write no file beyond `count` bytes, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (count, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("size", [300, 200_000])
def test_full_disk_stops_the_store_and_keeps_what_was_acknowledged(tmp_path, size):
    """A write that finds no room raises, every later one too; what was kept is all there."""
    store, _ = open_store(tmp_path, unix_s=1)
    kept = 0
    with pytest.raises(StoreError) as failed:
        for version in range(1, 1000):
            # The large body meets the limit at its second version, small rows fill the log.
            with file_size_limit(150_000 if size > 150_000 and version > 1 else 400_000):
                store.write(
                    [persist(slot_record("a", version, size=size), outcome_record(0, version))]
                )
            kept = version
    assert kept >= 1
    assert str(tmp_path) in str(failed.value)
    assert ("no room for the data" in str(failed.value)) == (size > 65_536)
    assert "start the shard again" in str(failed.value)
    with pytest.raises(StoreError, match="has failed before"):
        store.write([persist(slot_record("a", 5000))])
    with pytest.raises(StoreError, match="has failed before"):
        store.rest()
    store.close()
    found = reopened(tmp_path)
    assert [record.version for record in found.slots] == [kept]
    assert [outcome.lock.seq for outcome in found.outcomes] == [kept]
    assert len(bytes(found.slots[0].datum.body)) == size


def test_forced_file_stays_until_its_replacement_is_forced(tmp_path):
    """A power cut may take an `os` batch: the durable body that it replaced must be there then."""
    store, _ = open_store(tmp_path, unix_s=1)
    blobs = tmp_path / "blobs"

    def write(version, durability):
        record = slot_record("a", version, size=70_000)
        store.write([persist(record, durability=durability)])
        store.rest()
        return {path.name for path in blobs.iterdir()}

    first = write(1, Durability.DURABLE)
    second = write(2, Durability.OS)
    third = write(3, Durability.OS)
    assert first < second
    assert first < third
    assert len(second) == len(third) == 2
    store.write([persist(slot_record("b", 1))])
    store.rest()
    assert {path.name for path in blobs.iterdir()} == third - first
    store.close()


def test_file_is_unlinked_only_after_its_batch_was_acknowledged(tmp_path):
    """`write` leaves replaced files to `rest`: unlinking a large file takes its time."""
    store, _ = open_store(tmp_path, unix_s=1)
    for version in (1, 2):
        store.write([persist(slot_record("a", version, size=70_000))])
    assert len(list((tmp_path / "blobs").iterdir())) == 2
    store.rest()
    assert len(list((tmp_path / "blobs").iterdir())) == 1
    store.close()


SYNCS = {"fsync", "fdatasync"}


def traced(tmp_path, script, *arguments, options=()):
    """Run a script under strace; return (text, calls before it) of each text that it wrote."""
    if shutil.which("strace") is None:
        pytest.skip("needs strace")
    trace = tmp_path / "trace"
    trace.unlink(missing_ok=True)
    command = [
        "strace",
        "-f",
        "-y",
        "-o",
        trace,
        "-e",
        "trace=fsync,fdatasync,write,pwrite64,rename,unlink",
    ]
    ended = subprocess.run(
        [*command, *options, sys.executable, "-c", script, *arguments],
        check=False,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
    )
    if "ptrace" in ended.stderr.lower():
        pytest.skip("strace is not allowed here")
    assert ended.returncode in {0, -9}, ended.stderr
    parts, calls = [], []
    for line in trace.read_text().splitlines():
        call = line.partition(" ")[2].strip()
        if call.startswith("write(1<"):
            parts.append((call.split('"')[1], calls))
            calls = []
        else:
            calls.append(call)
    return parts


def test_durable_batch_is_forced_to_the_disk_before_it_returns_and_an_os_batch_is_not(tmp_path):
    """System calls as they happen: log forced for durable only; files and names before the log."""
    folder = tmp_path / "folder"
    script = f"""
import os
from pathlib import Path
from store_writer import persist, slot_record, open_store, Durability
store, _ = open_store(Path({str(folder)!r}), unix_s=1)
os.write(1, b"opened")
for name, size, durability in (
    ("os small", 9, "os"), ("durable small", 9, "durable"),
    ("os large", 70_000, "os"), ("durable large", 70_000, "durable"),
    ("both", 70_000, "both"),
):
    kinds = ("durable", "os") if durability == "both" else (durability,)
    store.write([persist(slot_record("a", 1, size=size), durability=Durability(k)) for k in kinds])
    os.write(1, name.encode())
    store.rest()
    os.write(1, b"rest")
store.close()
"""
    parts = dict(traced(tmp_path, script))
    syncs = {name: [c for c in calls if c.split("(")[0] in SYNCS] for name, calls in parts.items()}
    for name in ("opened", "durable small", "durable large", "both"):
        # The epoch and every durable batch: written to the log, forced, only then marked.
        calls = parts[name]
        written = last_index(calls, "pwrite64(", "store.db-wal>")
        forced = last_index(calls, "fdatasync(", "store.db-wal>")
        assert written < forced < last_index(calls, "pwrite64(", "/mark>")
    assert syncs["os small"] == syncs["os large"] == []
    assert len(syncs["durable small"]) == 1
    for name in ("durable large", "both"):
        body, names, log = syncs[name]
        assert (".blob.tmp>" in body, "/blobs>" in names, "store.db-wal>" in log) == (True,) * 3
    calls = [call.split("(")[0] for call in parts["durable large"]]
    assert calls.index("rename") < calls.index("fsync")
    assert not any(call.startswith("unlink") for call in parts["durable large"])


def last_index(calls, *parts):
    """Return the index of the last call that contains all `parts`."""
    return max(i for i, call in enumerate(calls) if all(part in call for part in parts))


@pytest.mark.parametrize(
    ("call", "size"), [("fdatasync", 9), ("fdatasync", 70_000), ("fsync", 70_000)]
)
def test_failed_sync_kills_the_store_and_is_not_tried_again(tmp_path, call, size):
    """An I/O error from fsync: the batch is not acknowledged, and no later call may claim it is."""
    script = """
import os, sys
from pathlib import Path
from enact_dist.errors import StoreError
from store_writer import persist, slot_record, open_store
store, _ = open_store(Path(sys.argv[1]), unix_s=1)
store.write([persist(slot_record("a", 1))])
os.write(1, b"opened")
for version in (2, 3):
    try:
        store.write([persist(slot_record("a", version, size=SIZE))])
        os.write(1, b"kept")
    except StoreError as failure:
        os.write(1, b"failed before" if "has failed before" in str(failure) else b"failed")
os.kill(os.getpid(), 9)
""".replace("SIZE", str(size))
    sound = traced(tmp_path, script, tmp_path / "sound")
    assert [name for name, _ in sound] == ["opened", "kept", "kept"]
    number = sum(made.startswith(f"{call}(") for made in sound[0][1]) + 1
    inject = ("-e", f"inject={call}:error=EIO:when={number}")
    failing = traced(tmp_path, script, tmp_path / "failing", options=inject)
    assert [name for name, _ in failing] == ["opened", "failed", "failed before"]
    assert failing[2][1] == []
    (found,) = reopened(tmp_path / "failing").slots
    assert found.version in {1, 2}
