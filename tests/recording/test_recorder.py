"""A recording has every version of what it follows, commits whole and in order, or names the gap."""

import errno
import os
import threading
import time
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.reader import make_reader
from polling import until

from enact_dist import Aspect, Durability, Entity, Lock, Read, Write
from enact_dist.access.snapshot import HeldView
from enact_dist.core.state import history
from enact_dist.errors import ConfigError, StoreError, UnknownWorldError
from enact_dist.link import notices
from enact_dist.recording import (
    Recorder,
    Replay,
    Shows,
    export_world,
    exporting,
    file,
    recorder,
)
from enact_dist.recording.exporting import world_as_of
from enact_dist.recording.file import RecordingFile
from enact_dist.recording.reading import Recording
from enact_dist.recording.summary import DISK_SLOW, DROPPED
from enact_dist.world import version_data

COUNT = Aspect("count", int)
CLOUD = Aspect("cloud", np.ndarray, Durability.VOLATILE)
bench, piece = Entity("bench"), Entity("piece")


@dataclass(frozen=True, eq=False)
class Scan:
    points_m: np.ndarray
    label: str


SCAN = Aspect("scan", Scan)


def put(*pairs):
    """Set (request, datum) pairs in one commit; None deletes."""
    with Lock(*(request for request, _ in pairs)) as lock:
        for request, value in pairs:
            if value is None:
                del lock[request]
            else:
                lock[request] = value
    return lock.position


class Running:
    """A recorder in a thread of its own, begun when its block begins."""

    def __init__(self, cell, path, **options):
        self.recorder = Recorder(cell, path, **options)
        self.stop, self.begun = threading.Event(), threading.Event()
        self.error = None
        self.thread = threading.Thread(target=self._run)

    def _run(self):
        try:
            self.recorder.run(self.stop, tell=lambda _: self.begun.set())
        except Exception as error:
            self.error = error
            self.begun.set()

    def __enter__(self):
        self.thread.start()
        assert self.begun.wait(60)
        return self.recorder.summary

    def __exit__(self, *_):
        self.stop.set()
        self.thread.join(60)
        assert not self.thread.is_alive()
        if self.error is not None:
            raise self.error


def commits_of(path):
    return list(Recording(path).commits())


# ---------------------------------------------------------------- what is in it


def test_it_begins_with_what_is_there(cell, online, tmp_path):
    """The newest version of each slot, of all contexts, as the state before the first commit."""
    online.init(piece, COUNT, 1)
    put((Write(online, piece, COUNT), 2))
    cell.world("training").init(bench, COUNT, 7)
    with Running(cell, tmp_path / "run.mcap") as summary:
        pass
    (first,) = commits_of(tmp_path / "run.mcap")
    assert first.number == 0
    assert [(v.slot.context, v.version) for v in first.versions] == [("online", 2), ("training", 1)]
    assert (summary.initial, summary.commits, summary.missing) == (2, 0, 0)


def test_every_commit_of_concurrent_writers_is_whole_and_in_order(cell, online, tmp_path):
    """Stamps rise, versions follow each other, and what was set together stands together."""
    rounds, path = 60, tmp_path / "run.mcap"
    requests = [Write(online, entity, COUNT) for entity in (bench, piece)]

    def work():
        for _ in range(rounds):
            with Lock(*requests) as lock:
                for request in requests:
                    lock[request] = lock.get(request, 0) + 1

    with Running(cell, path) as summary:
        workers = [threading.Thread(target=work) for _ in range(3)]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
    commits = [commit for commit in commits_of(path) if commit.number]
    assert [commit.number for commit in commits] == list(range(1, 3 * rounds + 1))
    assert all(len(commit.versions) == 2 for commit in commits)
    assert [c.versions[0].version for c in commits] == list(range(1, 3 * rounds + 1))
    stamps = [commit.log_ns for commit in commits]
    assert stamps == sorted(set(stamps))
    assert (summary.commits, summary.missing, summary.out_of_order) == (3 * rounds, 0, 0)


def test_a_recorder_that_stood_still_takes_what_was_told_meanwhile(
    cell, online, tmp_path, monkeypatch
):
    """At its begin what is there, and at its end what was committed before it was told to stop."""
    standing_still = time.monotonic
    path = tmp_path / "run.mcap"
    online.init(piece, COUNT, 1)
    listen_until_settled = Recorder._listen_until_settled

    def stood_still(self, watch):
        """Let all of the time pass between the first look at the clock and the second."""
        clock = iter([0.0])
        with monkeypatch.context() as patched:
            patched.setattr(
                recorder, "time", SimpleNamespace(monotonic=lambda: next(clock, standing_still()))
            )
            listen_until_settled(self, watch)

    monkeypatch.setattr(Recorder, "_listen_until_settled", stood_still)
    with Running(cell, path) as summary, monkeypatch.context() as resting:
        resting.setattr(recorder.Recorder, "_listen", lambda *_: None)
        put((Write(online, piece, COUNT), 2))
    assert (summary.initial, summary.commits) == (1, 1)
    assert [v.version for commit in commits_of(path) for v in commit.versions] == [1, 2]


def test_a_version_names_its_stamp_shard_and_actor(cell, online, tmp_path):
    """What the shard knows of its commit."""
    with Running(cell, tmp_path / "run.mcap"):
        position = put((Write(online, piece, COUNT), 1))
    (commit,) = commits_of(tmp_path / "run.mcap")
    (version,) = commit.versions
    assert (version.stamp_ns, version.shard) == position
    assert version.pid == os.getpid()
    assert version.actor


def test_a_commit_over_two_contexts_is_one(cell, online, tmp_path):
    """Groups are those of the locks, not of the contexts."""
    training = cell.world("training")
    with Running(cell, tmp_path / "run.mcap"):
        put((Write(online, piece, COUNT), 1), (Write(training, piece, COUNT), 2))
    (commit,) = commits_of(tmp_path / "run.mcap")
    assert [version.slot.context for version in commit.versions] == ["online", "training"]


def test_null_is_a_version(cell, online, tmp_path):
    """A deletion is recorded with its reason."""
    with Running(cell, tmp_path / "run.mcap"):
        put((Write(online, piece, COUNT), 1))
        put((Write(online, piece, COUNT), None))
    last = commits_of(tmp_path / "run.mcap")[-1].versions[0]
    assert (last.version, last.datum, last.null_reason) == (2, None, "DELETED")


def test_a_chunk_ends_by_time_while_nothing_happens(cell, online, tmp_path):
    """What a power cut may take is bounded for a quiet cell, too."""
    path = tmp_path / "run.mcap"
    with Running(cell, path, chunk_s=0.1):
        put((Write(online, piece, COUNT), 1))
        until(lambda: commits_of(path))
        assert not Recording(path).end


def test_only_what_is_chosen_is_recorded(cell, online, tmp_path):
    """By context, pattern of entities and aspect."""
    options = {"worlds": ["online"], "entities": "piece*", "aspects": ["count"]}
    with Running(cell, tmp_path / "run.mcap", **options):
        put((Write(online, piece, COUNT), 1), (Write(online, bench, COUNT), 1))
        put((Write(online, piece, Aspect("name", str)), "x"))
        put((Write(cell.world("training"), piece, COUNT), 1))
        put((Write(online, Entity("piece2"), COUNT), 1))
    found = [str(v.slot) for commit in commits_of(tmp_path / "run.mcap") for v in commit.versions]
    assert found == ["online:piece/count", "online:piece2/count"]


def test_what_is_declared_is_shown(cell, online, tmp_path):
    """The declaration of an aspect decides over its shape, and a misfit is counted."""
    path = tmp_path / "run.mcap"
    shows = {"scan": Shows(("point_cloud",), frame="tray"), "count": Shows(("image",))}
    with Running(cell, path, shows=shows) as summary:
        put((Write(online, piece, SCAN), Scan(np.zeros((2, 3), np.float32), "x")))
        put((Write(online, piece, COUNT), 1))
    with path.open("rb") as stream:
        found = {c.topic: s.name for s, c, _ in make_reader(stream).iter_messages() if s}
    assert found["/online/piece/scan"] == "foxglove.PointCloud"
    assert found["/online/piece/count/json"] == "enact.Datum"
    assert summary.counts == {"unfit count image": 1}


# ---------------------------------------------------------------- round trip


def same_data(one, other):
    def facts(world):
        return {
            (v.slot.entity, v.slot.aspect): (v.datum.encoding, bytes(v.datum.body), v.captured_ns)
            for v in world_as_of(world)
        }

    return facts(one) == facts(other)


def test_record_and_replay_give_the_same_context(cell, online, tmp_path):
    """Bit for bit, large and small, deleted ones not there."""
    path = tmp_path / "run.mcap"
    scan, count, cloud = (Write(online, piece, aspect) for aspect in (SCAN, COUNT, CLOUD))
    put((count, 1))
    with Running(cell, path, compression="zstd"):
        for number in range(5):
            points = np.full((30_000, 3), number, np.float32)
            put((scan, Scan(points, f"scan {number}")), (cloud, points.astype(">f8")))
        put((count, None))
    Replay(cell, path, worlds={"online": "copy"}, speed=0.0).run()
    assert same_data(online, cell.world("copy"))
    assert len(cell.world("copy").list_slots()) == 3


def test_recording_of_a_replay_is_the_recording(cell, online, tmp_path):
    """The same versions, groups and bytes again."""
    requests = [Write(online, entity, COUNT) for entity in (bench, piece)]
    with Running(cell, tmp_path / "one.mcap", worlds=["online"]):
        for number in range(20):
            put(*((request, number) for request in requests[: 1 + number % 2]))
    copy = cell.create_world("copy")
    with Running(cell, tmp_path / "two.mcap", worlds=["copy"]):
        Replay(cell, tmp_path / "one.mcap", worlds={"online": "copy"}, speed=0.0).run()

    def facts(path):
        return [
            (c.number, [(v.slot.entity, v.version, v.datum.encoding) for v in c.versions])
            for c in commits_of(path)
        ]

    assert facts(tmp_path / "one.mcap") == facts(tmp_path / "two.mcap")
    assert same_data(online, copy)


# ---------------------------------------------------------------- what is missing


def test_versions_without_a_notice_come_from_the_history(cell, online, tmp_path, monkeypatch):
    """A recorder whose queue of notices overflows still has every version that is kept."""
    monkeypatch.setattr(notices.NoticeQueue.__init__, "__kwdefaults__", {"notices_max": 4})
    keeping = Aspect("kept", int, retention=100)
    path = tmp_path / "run.mcap"
    entered, go_on = threading.Event(), threading.Event()
    listen = Recorder._listen

    def paused(self, watch, wait_s):
        if self.summary.commits:
            entered.set()
            assert go_on.wait(60)
        listen(self, watch, wait_s)

    monkeypatch.setattr(Recorder, "_listen", paused)
    with Running(cell, path) as summary:
        put((Write(online, piece, keeping), 0))
        assert entered.wait(60)
        for number in range(1, 30):
            put((Write(online, piece, keeping), number))
        put((Write(online, bench, keeping), 0))
        go_on.set()
    assert summary.gaps == {}
    versions = [v.version for c in commits_of(path) for v in c.versions if v.slot.entity == "piece"]
    assert versions == list(range(1, 31))


def test_disk_that_is_too_slow_costs_no_memory_and_is_named(cell, online, tmp_path, monkeypatch):
    """What its shard forgets meanwhile is counted, and stands by name in summary and file."""
    monkeypatch.setattr(history, "LOOSE_NS", 0)
    writes, go_on, write = threading.Event(), threading.Event(), RecordingFile.add_commit

    def slow(self, versions, log_ns):
        writes.set()
        assert go_on.wait(60)
        write(self, versions, log_ns)

    monkeypatch.setattr(RecordingFile, "add_commit", slow)
    fleeting = Aspect("fleeting", int, retention=1)
    path = tmp_path / "run.mcap"
    running = Running(cell, path, queue_bytes=1)
    with running as summary:
        put((Write(online, piece, fleeting), 0))
        assert writes.wait(60)
        put((Write(online, piece, fleeting), 1))
        until(lambda: summary.versions == 2)  # one is being written, one has taken all room
        for number in range(2, 40):
            last = put((Write(online, piece, fleeting), number))
        waits = running.recorder  # for room, although all commits have settled
        until(lambda: min(waits._settled_ns, waits._stalled_ns) >= last.stamp_ns)
        assert summary.versions == 2, "no more is fetched than what has room"
        go_on.set()
    assert [v.version for c in commits_of(path) for v in c.versions] == [1, 2, 40]
    assert summary.gaps == {DISK_SLOW: 37}
    assert summary.gap_slots == {"online:piece/fleeting": 37}
    with path.open("rb") as stream:
        gaps = list(make_reader(stream).iter_messages(topics=["/enact/gaps"]))
    assert len(gaps) == summary.missing
    assert Recording(path).facts["cell"] == "local"


def test_too_many_that_wait_are_dropped_by_name(cell, online, tmp_path, monkeypatch):
    """The oldest go, and the reason says why."""
    monkeypatch.setattr(recorder, "WANTED_MAX", 5)
    with Running(cell, tmp_path / "run.mcap") as summary, monkeypatch.context() as resting:
        resting.setattr(recorder, "SETTLE_S", 3600.0)
        for number in range(20):
            put((Write(online, piece, COUNT), number))
        until(lambda: summary.missing >= 15)
    assert summary.gaps == {DISK_SLOW: 15}
    assert [v.version for c in commits_of(tmp_path / "run.mcap") for v in c.versions] == list(
        range(16, 21)
    )


def test_disk_that_refuses_ends_the_recording_and_says_what_is_good(
    cell, online, tmp_path, monkeypatch
):
    """The file has its whole chunks."""
    path = tmp_path / "run.mcap"
    sync, left = os.fdatasync, [3]

    def full(descriptor):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        sync(descriptor)

    monkeypatch.setattr(os, "fdatasync", full)
    with (
        pytest.raises(StoreError, match=r"No space left.*last whole chunk"),
        Running(cell, path, chunk_bytes=1) as summary,
    ):
        for number in range(10):
            put((Write(online, piece, COUNT), number))
    assert summary.chunks == 2
    assert len(commits_of(path)) >= 2


def test_nothing_to_record_is_told(cell, tmp_path):
    """A context that does not exist, and a file that does."""
    with pytest.raises(UnknownWorldError, match="attic"):
        Recorder(cell, tmp_path / "run.mcap", worlds=["attic"])
    (tmp_path / "there.mcap").touch()
    with pytest.raises(ConfigError, match="exists"):
        Recorder(cell, tmp_path / "there.mcap").run(seconds=0.0)


# ---------------------------------------------------------------- export


def test_export_is_a_recording_of_one_moment(cell, online, tmp_path):
    """All data of a context, and replaying it makes the context again."""
    path = tmp_path / "now.mcap"
    put((Write(online, piece, COUNT), 1), (Write(online, bench, COUNT), 2))
    put((Write(online, bench, COUNT), None))
    put((Write(online, piece, SCAN), Scan(np.ones((40_000, 3), np.float32), "x")))
    summary = export_world(online, path)
    assert summary.versions == 2
    Replay(cell, path, worlds={"online": "copy"}).run()
    assert same_data(online, cell.world("copy"))


def test_export_names_the_causes_of_its_data(online, tmp_path):
    """Which process wrote them, and what that lock had read."""
    put((Write(online, bench, COUNT), 2))
    count, seen = Write(online, piece, COUNT), Read(online, bench, COUNT)
    with Lock(count, seen) as lock:
        lock[count] = lock[seen] + 1
    export_world(online, tmp_path / "now.mcap")
    versions = {v.slot.entity: v for c in commits_of(tmp_path / "now.mcap") for v in c.versions}
    made = versions["piece"]
    assert (made.kind, made.pid) == ("commit", os.getpid())
    assert [read.slot.entity for read in made.reads] == ["bench"]
    assert made.reads[0].stamp_ns == versions["bench"].stamp_ns


def test_export_asks_once_for_the_cause_of_a_commit(online, tmp_path, monkeypatch):
    """A shard would name all that a commit has set for each of its data; those of a fork differ."""
    asked, ask = [], version_data.explained
    monkeypatch.setattr(
        version_data,
        "explained",
        lambda session, some: asked.append(len(some)) or ask(session, some),
    )
    put(*((Write(online, Entity(f"part/{n}"), COUNT), n) for n in range(50)))
    export_world(online, tmp_path / "now.mcap")
    assert asked == [1, 0]
    export_world(online.fork("copy"), tmp_path / "copy.mcap")
    for name, kind in (("now", "commit"), ("copy", "fork")):
        found = commits_of(tmp_path / f"{name}.mcap")
        versions = [version for commit in found for version in commit.versions]
        assert [one.kind for one in versions] == [kind] * 50
        reads = [read.slot for one in versions for read in one.reads]
        assert reads == [one.slot._replace(context="online") for one in versions if kind == "fork"]


def test_export_ends_and_leaves_no_file_once_it_is_too_large(online, tmp_path, monkeypatch):
    """Nothing is fetched after the portion with which it passed the bound."""
    monkeypatch.setattr(exporting, "PORTION_BYTES", 1)
    monkeypatch.setitem(file.RecordingFile.__init__.__kwdefaults__, "chunk_bytes", 1)
    fetched, fetch = [], HeldView.fetch
    monkeypatch.setattr(HeldView, "fetch", lambda *given: fetched.append(1) or fetch(*given))
    scan = Scan(np.ones((1000, 3), np.float32), "x")
    put(*((Write(online, Entity(f"piece/{number}"), SCAN), scan) for number in range(20)))
    whole = export_world(online, tmp_path / "whole.mcap", bytes_max=1 << 20)
    assert whole.versions == len(fetched) == 20
    fetched.clear()
    with pytest.raises(exporting.FileTooLargeError, match=r"large\.mcap takes more than"):
        export_world(online, tmp_path / "large.mcap", bytes_max=whole.size_bytes // 2)
    assert 1 < len(fetched) < 20
    assert not (tmp_path / "large.mcap").exists()


def test_export_of_the_past_is_of_the_past(cell, online, tmp_path):
    """As of a stamp: every commit up to it, none after."""
    old = put((Write(online, piece, COUNT), 1), (Write(online, bench, COUNT), 1))
    put((Write(online, piece, COUNT), 2))
    put((Write(online, bench, COUNT), None))
    export_world(online, tmp_path / "old.mcap", at_ns=old.stamp_ns)
    found = commits_of(tmp_path / "old.mcap")
    assert [(v.slot.entity, v.version) for c in found for v in c.versions] == [
        ("bench", 1),
        ("piece", 1),
    ]


def test_versions_are_explained_in_parts_where_one_answer_is_too_short(cell, online, monkeypatch):
    """What is left out of an answer is not forgotten."""
    request = Write(online, piece, COUNT)
    for number in range(9):
        put((request, number))
    versions = online.history(piece, COUNT)
    monkeypatch.setattr("enact_dist.core.protocol.pages.PAGE_BYTES_MAX", 1_000)
    wanted = [
        version_data.Wanted(v.position.stamp_ns, v.slot, v.version, v.position.shard)
        for v in versions
    ]

    found = version_data.explained(online.session, wanted)

    assert [found[one].cause for one in wanted] == [version.cause for version in versions]


def test_a_context_that_is_dropped_does_not_end_the_recording(cell, online, tmp_path, monkeypatch):
    """What waits of it is named as missing; the others are recorded on."""
    fork = online.fork("what_if")
    kept, lost = Write(online, bench, COUNT), Write(fork, bench, COUNT)
    with Running(cell, tmp_path / "run.mcap") as summary:
        with monkeypatch.context() as resting:  # so that the drop comes while they wait
            resting.setattr(recorder, "SETTLE_S", 3600.0)
            put((kept, 1), (lost, 1))
            cell.drop_world("what_if")
        put((kept, 2))
    assert summary.gaps == {DROPPED: 1}
    assert summary.gap_slots == {"what_if:bench/count": 1}
    found = [v for commit in commits_of(tmp_path / "run.mcap") for v in commit.versions]
    assert {(v.slot.context, v.version, v.null_reason) for v in found} == {
        ("online", 1, ""),
        ("online", 2, ""),
        ("what_if", 2, "DELETED"),
    }
