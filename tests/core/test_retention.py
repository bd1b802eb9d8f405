"""History: how long replaced versions stay, by retention and by label, also over restarts."""

from __future__ import annotations

import pytest
from history_parts import SEC, W, as_of, keep, listed, retain, shown, write
from shard_bench import S, ShardBench, datum, item, lock_id, slot

from enact_dist.core.protocol.messages import (
    EpochChanged,
    Forgotten,
    KeepVersions,
    Kept,
    ListHistory,
    SlotVersion,
)
from enact_dist.core.protocol.parts import NO_LIMIT
from enact_dist.core.protocol.records import Content, HistoryForgotten, Persist
from enact_dist.core.state import history
from enact_dist.core.state.history import Policy
from enact_dist.core.state.retention import Limits
from enact_dist.core.state.slots import SlotMap
from enact_dist.terms import NullReason

SESSIONS = ("ann",)


class TestRetention:
    @pytest.mark.parametrize(
        ("figures", "left"),
        [((3, 0, 0), [5, 6, 7]), ((0, 0, 20), [5, 6, 7]), ((1, 0, 0), [7]), ((0, 0, 9), [7])],
        ids=["versions", "bytes", "none", "less than one"],
    )
    def test_oldest_versions_go(self, bench, figures, left):
        """By number, the newest included; by bytes, the newest left out."""
        retain(bench, "count", *figures)
        for value in "1234567":
            write(bench, value * 10)

        assert listed(bench) == left

    def test_versions_go_when_they_are_too_old(self, bench):
        """So long after they were replaced; and the newest one never does."""
        retain(bench, "count", 0, age_ns=10 * SEC)
        stamps = []
        for value in "123":
            stamps.append(write(bench, value))
            bench.wait(4 * S, keep=("ann",))
        assert listed(bench) == [1, 2, 3]

        bench.wait(3 * S, keep=("ann",))
        assert listed(bench) == [2, 3]
        assert as_of(bench, stamps[1] - 1) == Forgotten(slot(), stamps[1])
        bench.wait(100 * S, keep=("ann",))
        assert listed(bench) == [3]

    def test_history_is_bounded_where_nothing_is_said(self, bench):
        """16 versions, 600 s, 16 MiB."""
        for number in range(20):
            write(bench, str(number))

        assert listed(bench) == list(range(5, 21))
        bench.wait(605 * S, keep=("ann",))
        assert listed(bench) == [20]

    def test_store_is_told_with_the_next_commit(self, bench):
        """No batch more for it; where no commit comes, on a tick."""
        retain(bench, "count", 2)
        batches: list[Persist] = []
        submitted = bench.pending
        bench.disk_is_done = False
        for value in "1234":
            write_and_note(bench, value, batches)
        told = [
            [
                v.version
                for r in batch.records
                if isinstance(r, HistoryForgotten)
                for v in r.versions
            ]
            for batch in batches
        ]
        assert told == [[], [], [], [1]]

        bench.disk_is_done = True
        bench.wait(SEC, keep=("ann",))
        assert not submitted
        assert bench.log[-1] == HistoryForgotten((SlotVersion(slot(), 2),))

    def test_limits_of_the_shard_come_first_and_what_went_is_counted(self, monkeypatch):
        """The oldest of all slots goes first, whatever its aspect retains."""
        monkeypatch.setattr(history, "HELD_STATES_MAX", 5)
        policy = Policy(Limits(100, NO_LIMIT, NO_LIMIT), stored=True)
        slots = SlotMap((), policies={"mask": policy, "count": policy})
        for version in range(1, 8):
            for aspect in ("mask", "count"):
                content = Content(version, 10 * version, datum("xyz"), NullReason.DELETED)
                slots.replace(slot("cam", aspect), content)
                slots.assert_invariants()

        held = {
            aspect: [content.version for content, _ in slots.versions(slot("cam", aspect))]
            for aspect in ("mask", "count")
        }
        assert held == {"mask": [5, 6, 7], "count": [4, 5, 6, 7]}
        assert slots.history.dropped == 7
        (record,) = slots.history.take_forgotten()
        assert len(record.versions) == 7

    def test_restart_finds_what_is_stored_and_retains_it(self, bench):
        """Durable history is there again; of a volatile slot none is, and no version."""
        for aspect in ("count", "frame"):
            retain(bench, aspect, 3)
            stamps = [write(bench, value, aspect) for value in "12345"]
        bench.log = [r for r in bench.log if not isinstance(r, HistoryForgotten)]

        bench.restart()
        bench.hello("ann", known_epoch=bench.shard.epoch)

        assert listed(bench) == [3, 4, 5]
        assert listed(bench, "frame") == [0]
        bench.wait(SEC, keep=("ann",))
        gone = [v for r in bench.log if isinstance(r, HistoryForgotten) for v in r.versions]
        assert gone == [SlotVersion(slot(), 1), SlotVersion(slot(), 2)]
        assert write(bench, "6") > stamps[-1]
        assert listed(bench) == [4, 5, 6]


def write_and_note(bench: ShardBench, value: str, batches: list[Persist]) -> None:
    """Commit a value, and note what goes to the store in one batch."""
    lock = lock_id("ann", 3, next(bench._handles))
    grant = bench.granted(lock, item(W))
    bench.commit(lock, grant.token, (slot(), value))
    batches += bench.pending
    bench.finish_disk()


class TestLabels:
    @pytest.fixture(autouse=True)
    def retains_two(self, bench):
        """Let the versions go quickly that nobody keeps."""
        retain(bench, "count", 2)

    def test_kept_version_outlives_its_retention(self, bench):
        """It is listed, and shown at its own time; between it and the others nothing is known."""
        stamps = [write(bench, value) for value in "12"]
        answer = keep(bench, "why/this", 1)
        stamps += [write(bench, value) for value in "345"]
        bench.wait(3 * S, keep=("ann",))

        assert answer == Kept((SlotVersion(slot(), 1),), ())
        assert listed(bench) == [1, 4, 5]
        assert listed(bench, kept=True) == [1]
        assert shown(bench, stamps[0]) == shown(bench, stamps[1] - 1) == ["1"]
        assert as_of(bench, stamps[1]) == Forgotten(slot(), stamps[3])
        assert bench.ask(ListHistory((), (), ("count",))).entries[0].kept == ("why/this",)

    def test_version_goes_with_the_last_label(self, bench):
        """And the store is told."""
        write(bench, "1")
        keep(bench, "a", 1)
        keep(bench, "b", 1)
        for value in "234":
            write(bench, value)
        bench.wait(3 * S, keep=("ann",))
        keep(bench, "a")
        assert listed(bench) == [1, 3, 4]

        assert keep(bench, "b") == Kept((), ())

        assert listed(bench) == [3, 4]
        assert bench.log[-1] == HistoryForgotten((SlotVersion(slot(), 1),))

    def test_kept_versions_outlive_a_restart(self, bench):
        """The newest one was kept, and has been replaced since; what was volatile is lost."""
        write(bench, "1", "frame")
        first_ns = write(bench, "1")
        keep(bench, "a", 1)
        keep(bench, "a", 1, aspect="frame")
        for value in "234":
            write(bench, value)
        bench.wait(3 * S, keep=("ann",))
        bench.restart()
        bench.hello("ann", known_epoch=bench.shard.epoch)

        assert listed(bench) == [1, 3, 4]
        assert shown(bench, first_ns) == ["1"]
        assert isinstance(as_of(bench, first_ns + 1), Forgotten)
        write(bench, "2", "frame")
        assert listed(bench, "frame") == [1]
        assert bench.ask(ListHistory((), (), ("frame",), kept=True)).entries == ()

    def test_forgotten_versions_are_named(self, bench):
        """The others are kept."""
        for value in "1234":
            write(bench, value)

        answer = keep(bench, "a", 1, 4, 9)

        assert answer.versions == (SlotVersion(slot(), 4),)
        assert answer.forgotten == (SlotVersion(slot(), 1), SlotVersion(slot(), 9))

    def test_version_that_a_commit_is_replacing_is_not_kept(self, bench):
        """Where its aspect has no history, the store has been told already to put it away."""
        retain(bench, "note", 1)
        write(bench, "1", "note")
        bench.disk_is_done = False
        lock = lock_id("ann", 3, next(bench._handles))
        grant = bench.granted(lock, item(W, aspect="note"))
        bench.commit(lock, grant.token, (slot(aspect="note"), "2"))

        handle = bench.send(KeepVersions("ann", "a", (SlotVersion(slot(aspect="note"), 1),)))
        bench.finish_disk()

        assert bench.answers[handle] == Kept((), (SlotVersion(slot(aspect="note"), 1),))

    def test_answer_comes_when_it_is_durable(self, bench):
        """Whoever was told may rely on it."""
        write(bench, "1")
        bench.disk_is_done = False
        handle = bench.send(KeepVersions("ann", "a", (SlotVersion(slot(), 1),)))
        assert handle not in bench.answers

        bench.finish_disk()

        assert isinstance(bench.answers[handle], Kept)

    def test_who_asks_wrongly_is_refused(self, bench, monkeypatch):
        """A stranger, a name that nobody can read, and more than there is room for."""
        write(bench, "1")
        monkeypatch.setattr("enact_dist.core.shard.on_history.KEPT_MAX", 1)
        version = SlotVersion(slot(), 1)

        stranger = bench.ask(KeepVersions("zoe", "a", (version,)))
        unreadable = bench.ask(KeepVersions("ann", "a b", (version,)))
        many = bench.ask(KeepVersions("ann", "a", (version, version)))

        assert isinstance(stranger, EpochChanged)
        assert [unreadable.code, many.code] == ["value", "no_room"]
