"""Real daemons and clients killed, stopped and cut off: no anomaly, and everything has happened.

The run is made once; what it recorded is then doctored in memory, to see that the checker would
have noticed.  A shard with a real fault is hit by one directed schedule.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from polling import until

from enact_dist.cli.main import main
from enact_dist.errors import LinkError
from enact_dist.verify.chaos import daemon, evidence, faults, runner
from enact_dist.verify.chaos.cell import TestedCell
from enact_dist.verify.chaos.figures import judge
from enact_dist.verify.chaos.journal import Journal
from enact_dist.verify.chaos.network.hosts import Loopback, open_hosts
from enact_dist.verify.checker import LockOutcome
from enact_dist.verify.daemons import LineProcess

pytestmark = pytest.mark.slow
SECONDS = float(os.environ.get("ENACT_CHAOS_SECONDS", "55"))
ATTEMPTS = 12
RUNS = 3
"""So many runs may be made until all has happened; a slow machine does less in its time."""
END_S = 180.0


@pytest.fixture(scope="module")
def _namespaces():
    """Skip where the system has no namespaces; the root conftest makes that a failure in CI."""
    try:
        open_hosts(("one",), required=True).close()
    except LinkError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def folder(tmp_path_factory, _namespaces):
    """The folder of one run of all kinds of faults, the first in which all has happened."""
    for _ in range(RUNS):
        kept = tmp_path_factory.mktemp("chaos") / "kept"
        minutes = str(SECONDS / 60)
        status = main(["verify", "--chaos", "--minutes", minutes, "--keep", str(kept), "--json"])
        if status or not lacking(evidence.load(kept)):
            break
    return kept, status


@pytest.fixture
def found(folder):
    """The evidence of the run, for a test to doctor."""
    return evidence.load(folder[0])


def lacking(found):
    """Name what is to happen in a run, and has not, or too seldom."""
    verdict = judge(found)
    wanted = {
        **{kind: verdict.faults.get(kind, 0) >= count for kind, count in faults.DECK.items()},
        "a fenced commit": verdict.fenced > 0,
        "a fenced commit, as the shards count": verdict.counters["fenced"] > 0,
        "a decision that was asked for": verdict.counters["resolves_asked"] > 0,
        "epochs": verdict.epoch_changes >= 5,
        "commits": verdict.commits > 70,  # twenty times as many on an idle machine
        "commits over shards": verdict.over_shards > 15,
        "views": verdict.views_checked > 5,
        "recoveries": verdict.recovery["serving to first grant"].n > 3,
        "a commit with a part to leave out": part_to_leave_out(found) is not None,
        "a reader to move": reader_to_move(found) is not None,
    }
    return [what for what, happened in wanted.items() if not happened]


def rules(found):
    return {anomaly.rule for anomaly in judge(found).anomalies}


def test_nothing_is_lost_doubled_or_half_done(folder):
    """A run of every kind of fault: no anomaly, and none of the kinds is missing."""
    kept, status = folder
    verdict = judge(evidence.load(kept))

    assert verdict.anomalies == []
    assert status == 0
    assert not verdict.missing
    assert lacking(evidence.load(kept)) == []


def processes_of(folder):
    """Return the ids of other processes that name the folder."""
    named, found = str(folder).encode(), []
    for process in Path("/proc").iterdir():
        if process.name.isdigit() and int(process.name) != os.getpid():
            try:
                if named in (process / "cmdline").read_bytes():
                    found.append(int(process.name))
            except OSError:
                continue  # it has just ended
    return found


def test_nobody_is_left_afterwards(folder):
    """No process still works in the folder of the run."""
    assert processes_of(folder[0]) == []


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, 130), (signal.SIGKILL, -signal.SIGKILL)]
)
@pytest.mark.usefixtures("_namespaces")
def test_nobody_is_left_when_the_run_is_broken_off(tmp_path, number, status):
    """Ctrl-C, and even a kill of the runner, end every process, stopped ones too."""
    kept = tmp_path / "kept"
    command = [sys.executable, "-m", "enact_dist.cli.main", "verify", "--chaos", "--keep", kept]
    with subprocess.Popen(
        [*command, "--actors", "2"], stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as run:
        for line in run.stderr:
            if line.startswith("chaos: faults"):
                break
        working = processes_of(kept)
        assert len(working) > 5
        for pid in working:
            if pid != run.pid:
                with contextlib.suppress(ProcessLookupError):  # the run has just killed it
                    os.kill(pid, signal.SIGSTOP)
                    break

        run.send_signal(number)

        assert run.wait(END_S) == status
    # No event reports that the process of another parent has ended.
    until(lambda: not processes_of(kept), limit_s=END_S, missed=lambda: processes_of(kept))


def test_history_is_checked_again_from_its_folder(folder, capsys):
    """`enact verify --history` says the same of the same journals."""
    kept, status = folder

    assert main(["verify", "--history", str(kept), "--json"]) == status
    told = json.loads(capsys.readouterr().out)
    assert told["commits"] == judge(evidence.load(kept)).commits


# ---------------------------------------------------------------- doctored histories


def final_look(found):
    """Return the lock that read everything at the end."""
    return next(
        lock
        for lock in found.locks.values()
        if lock.client == "final" and lock.told is LockOutcome.COMMITTED
    )


def part_to_leave_out(found):
    """Return a commit over several slots, and one of them with versions above, or None."""
    final = {slot: version for slot, version, _, _ in final_look(found).seen}
    return next(
        (
            (record, written)
            for record in found.locks.values()
            if record.told is LockOutcome.COMMITTED and len(record.writes) > 1
            for written in record.writes
            if written[0].endswith("/kept") and 1 < written[1] < final[written[0]] - 3
        ),
        None,
    )


def reader_to_move(found):
    """Return a lock that only read, and something that has changed since, or None."""
    slot, newest = kept_slot(found)
    return next(
        (
            lock
            for lock in found.locks.values()
            if lock.told is LockOutcome.COMMITTED
            and not lock.writes
            and any(
                held and version < newest - 3 for at, version, _, held in lock.seen if at == slot
            )
        ),
        None,
    )


def kept_slot(found):
    """Return a durable slot with many versions."""
    final = final_look(found)
    return max(
        ((slot, version) for slot, version, _, _ in final.seen if slot.endswith("/kept")),
        key=lambda seen: seen[1],
    )


def rewritten(record, change):
    """Let a lock have seen something else; `change` gets and returns (slot, version, writer)."""
    record.seen = [(*change(*reading), held) for *reading, held in record.seen]
    record.writes = [change(*written) for written in record.writes]


def test_swapped_versions_are_named(found):
    """Two writers of one slot that trade places, wherever anybody saw or wrote them."""
    slot, newest = kept_slot(found)
    one, other = newest // 2, newest // 2 + 1

    def change(at, version, writer):
        swapped = {one: other, other: one}.get(version, version)
        return (at, swapped, writer) if at == slot else (at, version, writer)

    for record in found.locks.values():
        rewritten(record, change)

    assert rules(found) & {"stale read", "real time order is broken", "lost update"}


def test_dropped_commit_is_named(found):
    """The last commit of a slot is undone: the last reader sees what it had overwritten."""
    slot, newest = kept_slot(found)
    older = {
        version: writer
        for record in found.locks.values()
        for at, version, writer, _ in record.seen
        if at == slot
    }
    assert older[newest], "the last state is a datum"

    def change(at, version, writer):
        return (
            (at, newest - 1, older.get(newest - 1, ""))
            if (at, version)
            == (
                slot,
                newest,
            )
            else (at, version, writer)
        )

    for record in found.locks.values():
        if older[newest] != record.id:
            record.seen = [(*change(*reading), held) for *reading, held in record.seen]

    assert rules(found) & {"told committed, but lost", "half a commit"}


def test_half_of_a_commit_is_named(found):
    """A commit over shards of which one part never came: versions above it close the gap."""
    record, (slot, version, _) = part_to_leave_out(found)

    def change(at, seen, writer):
        if at != slot or seen < version or (seen == version and writer != record.id):
            return at, seen, writer
        return at, seen - 1, writer

    before = next(
        (writer)
        for other in found.locks.values()
        for at, seen, writer, _ in other.seen
        if (at, seen) == (slot, version - 1)
    )
    for other in found.locks.values():
        if other is record:
            continue
        rewritten(other, change)
        other.seen = [
            (at, seen, before if (at, writer) == (slot, record.id) else writer, held)
            for at, seen, writer, held in other.seen
        ]

    assert rules(found) & {"half a commit", "told committed, but lost"}


def test_told_not_but_visible_is_named(found):
    """A commit whose client was told no."""
    record = next(
        lock
        for lock in found.locks.values()
        if lock.told is LockOutcome.COMMITTED
        and any(slot.endswith("/kept") for slot, *_ in lock.writes)
    )
    record.told = LockOutcome.NOT

    assert rules(found) & {"told not committed, but visible", "versions have a gap"}


def test_reader_moved_in_time_is_named(found):
    """A reader that is said to have begun after all others had ended read what was old by then."""
    record = reader_to_move(found)
    late_ns = max(lock.ended_ns or 0 for lock in found.locks.values())
    record.begun_ns, record.ended_ns = late_ns + 1, late_ns + 2

    assert rules(found) & {"stale read"}


def test_failure_of_a_process_is_an_anomaly(found):
    """What the runner noted while it ran counts, too."""
    found.failures.append(("a lock is left", "1 locks"))
    restart = found.restarts[-1]
    found.restarts[-1] = replace(restart, ready_ns=restart.ready_ns + 1)

    assert rules(found) == {"a lock is left"}


# ---------------------------------------------------------------- a broken shard


def zombie_commits(folder, daemon_module):
    """Let a commit come after its lock was taken away and given to another; return what is judged.

    The client stops itself with the commit ready to be sent, and goes on once another one has
    written the same slot.
    """
    log = Journal(folder / evidence.FAULTS)
    told = {"missing": [], "groups": {}, "ttl_s": runner.TTL_S}
    (folder / evidence.SETTINGS).write_text(json.dumps(told))
    hosts = Loopback(("s0", "watch"), why="none is wanted")
    options = {"ttl_s": runner.TTL_S, "seed": 0, "daemon_module": daemon_module}
    cell = TestedCell(folder, hosts, ("s0",), log, **options)

    def start(name):
        words = (str(cell.file), str(folder / f"{name}.journal"), name)
        return LineProcess("stopped_client", words, folder / f"{name}.output")

    started = []
    try:
        cell.start(("s0",), {}, watcher_host="watch")
        started.append(stopped := start("stopped"))
        _, status = os.waitpid(stopped.pid, os.WUNTRACED)
        assert os.WIFSTOPPED(status)
        started.append(other := start("other"))
        assert other.expect("said") == LockOutcome.COMMITTED.value
        stopped.signal(signal.SIGCONT)
        stopped.expect("said")
        runner._rest(cell, log)
    finally:
        for process in started:
            process.end()
        cell.close()
        hosts.close()
        log.close()
    return evidence.load(folder)


def test_zombie_is_fenced(tmp_path, monkeypatch):
    """What a stopped client sends after its lease is refused, and its history has no anomaly."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)

    verdict = judge(zombie_commits(tmp_path, daemon.MODULE))

    assert verdict.anomalies == []
    assert (verdict.commits, verdict.fenced) == (1, 1)


def test_shard_without_a_fence_is_caught(tmp_path, monkeypatch):
    """With the same commit applied though its lock was taken away, the history is refused.

    A client whose keep-alive goes out before its commit learns that the lock is lost and sends
    none; then the same happens again.  No grant stays: the shard has no place for that of a lock
    which was taken away.
    """
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
    monkeypatch.setenv("ENACT_RETAIN", "0")

    for attempt in range(ATTEMPTS):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        found = rules(zombie_commits(folder, "unfenced_daemon"))
        if found:
            break

    assert found & {"one version was written twice", "lost update"}, found
