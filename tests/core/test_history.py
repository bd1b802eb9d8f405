"""History: how long replaced versions stay, how they are found, what a restart finds again."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shard_bench import S, ShardBench, datum, item, lock_id, slot

from enact_dist.core import history
from enact_dist.core.datum import Datum
from enact_dist.core.history import Policy
from enact_dist.core.messages import (
    AspectEntry,
    Commit,
    EpochChanged,
    Forgotten,
    Item,
    KeepVersions,
    Kept,
    ListHistory,
    Prepare,
    Refused,
    Register,
    SlotVersion,
    TakeView,
    Versions,
    Viewed,
    WriteItem,
)
from enact_dist.core.records import HistoryForgotten, Persist
from enact_dist.core.retaining import NO_LIMIT, Limits
from enact_dist.core.slots import Content, SlotMap
from enact_dist.terms import Access, NullReason

W, V, VE = Access.WRITE, Access.VIEW, Access.VIEW_EACH
SEC = 1_000_000_000


@pytest.fixture
def bench() -> ShardBench:
    """A shard with one session; `count` is durable, `note` of class `os`, `frame` volatile."""
    made = ShardBench()
    made.hello("ann")
    return made


def retain(bench: ShardBench, aspect: str, versions: int, age_ns: int = 0, size: int = 0) -> None:
    """Let an aspect retain so much."""
    bench.ask(Register("ann", (), (AspectEntry(aspect, "int", "", versions, age_ns, size),)))


def write(
    bench: ShardBench, value: str | None, aspect: str = "count", entity: str = "piece"
) -> int:
    """Set a slot (None: to null) and return the stamp of its commit."""
    seq = next(bench._handles)
    lock, to = lock_id("ann", 3, seq), slot(entity, aspect)
    grant = bench.granted(lock, Item(W, *to))
    return bench.commit(lock, grant.token, (to, value)).position.stamp_ns


def capture(bench: ShardBench, captured_ns: int) -> None:
    """Write a datum that was captured at a stamp."""
    lock = lock_id("ann", 3, next(bench._handles))
    grant = bench.granted(lock, item(W, "cam", "frame"))
    write_item = WriteItem(slot("cam", "frame"), Datum(b"t", b"x", 1, captured_ns))
    bench.ask(Commit(lock, grant.token, (write_item,), 0))


def as_of(bench: ShardBench, at_ns: int, *items: Item) -> object:
    """Return the answer to a strict view as of a stamp."""
    lock, count = lock_id("ann", 4, next(bench._handles)), bench.next_count("ann")
    items = items or (item(V),)
    return bench.ask(TakeView(lock, bench.shard.epoch, 1, count, items, 0, at_ns, strict=True))


def shown(bench: ShardBench, at_ns: int, *items: Item) -> list[str]:
    """Return the data (or why there are none) that a strict view shows, in order."""
    answer = as_of(bench, at_ns, *items)
    assert isinstance(answer, Viewed), answer
    assert answer.from_ns <= at_ns == answer.until_ns
    return [bytes(s.datum.body).decode() if s.datum else s.null_reason for s in answer.states]


def listed(bench: ShardBench, aspect: str = "count", **options: int) -> list[int]:
    """Return the versions that are listed of an aspect."""
    answer = bench.ask(ListHistory((), (), (aspect,), **options))
    assert isinstance(answer, Versions)
    return [entry.state.version for entry in answer.entries]


def keep(bench: ShardBench, label: str, *versions: int, aspect: str = "count") -> Kept:
    """Keep versions of the slot of all these tests."""
    asked = tuple(SlotVersion(slot(aspect=aspect), version) for version in versions)
    answer = bench.ask(KeepVersions("ann", label, asked))
    assert isinstance(answer, Kept), answer
    return answer


class TestAsOfAStamp:
    def test_every_moment_shows_what_was_then(self, bench):
        """At its stamp, before the next one; deleted data too, and nothing before the first."""
        stamps = [write(bench, value) for value in ("1", "2", None, "4")]

        assert shown(bench, stamps[0] - 1) == ["NEVER_SET"]
        assert [shown(bench, at_ns) for at_ns in stamps] == [["1"], ["2"], ["DELETED"], ["4"]]
        assert [shown(bench, at_ns - 1) for at_ns in stamps[1:]] == [["1"], ["2"], ["DELETED"]]

    def test_what_is_forgotten_is_said_and_never_replaced_by_the_present(self, bench):
        """With the slot, and the stamp from which on everything that was asked is known."""
        retain(bench, "count", 2)
        first, second, third = (write(bench, value) for value in "123")
        bench.wait(3 * S, keep=("ann",))

        assert as_of(bench, first) == as_of(bench, second - 1) == Forgotten(slot(), second)
        assert [shown(bench, at_ns) for at_ns in (second, third)] == [["2"], ["3"]]
        other_ns = write(bench, "x", "note")
        both = item(V), item(V, aspect="note")
        assert as_of(bench, first, *both) == Forgotten(slot(), second)
        assert shown(bench, other_ns - 1, *both) == ["3", "NEVER_SET"]

    def test_pattern_shows_what_was_deleted_since(self, bench):
        """And nothing that came later."""
        write(bench, "a", entity="tray/a")
        at_ns = write(bench, "b", entity="tray/b")
        write(bench, None, entity="tray/a")
        write(bench, "c", entity="tray/c")

        assert shown(bench, at_ns, item(VE, "tray/*")) == ["a", "b"]
        assert shown(bench, bench.shard.state.stamp(), item(VE, "tray/*")) == ["b", "c"]

    def test_volatile_data_are_lost_from_the_restart_on(self, bench):
        """What was before it is forgotten: not null."""
        before_ns = write(bench, "1", "frame")
        bench.wait(SEC, keep=("ann",))
        bench.restart()
        since_ns = bench.wall_ns
        bench.hello("ann", known_epoch=bench.shard.epoch)
        bench.wait(SEC, keep=("ann",))
        after_ns = write(bench, "2", "frame")

        asked = item(V, aspect="frame")
        assert as_of(bench, before_ns, asked) == Forgotten(slot(aspect="frame"), since_ns)
        assert shown(bench, since_ns, asked) == shown(bench, after_ns - 1, asked) == ["LOST"]
        assert shown(bench, after_ns, asked) == ["2"]

    def test_what_was_before_an_undecided_commit_was_before_the_restart(self, bench):
        """Though the wall clock lay behind: the stamp of what is prepared says how far time was."""
        bench.wall_ns += SEC
        before_ns = write(bench, "1", "frame")
        grant = bench.granted(lock_id("ann", 3, next(bench._handles)), item(W))
        writes = (WriteItem(slot(), datum("2")),)
        prepared = bench.ask(Prepare(grant.lock, grant.token, writes, 0, (), "far", grant.token))
        bench.wall_ns -= SEC
        bench.restart()
        bench.hello("ann", known_epoch=bench.shard.epoch)

        answer = as_of(bench, before_ns, item(V, aspect="frame"))
        assert answer == Forgotten(slot(aspect="frame"), prepared.stamp_ns)

    def test_time_that_is_still_to_come_is_refused(self, bench):
        """As far as the skew of clocks allows, the shard's own clock moves on instead."""
        write(bench, "1")

        answer = as_of(bench, bench.wall_ns + 5 * S)

        assert isinstance(answer, Refused)
        assert answer.code == "clock_skew"
        assert "5.0 s ahead" in answer.text
        ahead_ns = bench.wall_ns + SEC // 2
        assert shown(bench, ahead_ns) == ["1"]
        assert write(bench, "2") > ahead_ns

    def test_undecided_commit_is_waited_for_and_else_to_be_asked_again(self, bench):
        """Its stamp may lie before the asked one: nobody can say yet what was then."""
        write(bench, "1")
        bench.disk_is_done = False
        lock = lock_id("ann", 3, next(bench._handles))
        grant = bench.granted(lock, item(W))
        bench.commit(lock, grant.token, (slot(), "2"))
        at_ns = bench.shard.state.stamp()
        asked = TakeView(lock_id("ann", 4, 1), 1, 1, 99, (item(V),), 0, at_ns, strict=True)
        handle = bench.send(asked)
        assert handle not in bench.answers

        bench.wait(SEC // 2)
        answer = bench.answers[handle]
        assert isinstance(answer, Viewed)
        assert answer.until_ns < at_ns

        bench.finish_disk()
        assert shown(bench, at_ns) == ["2"]

    def test_cut_without_strictness_takes_the_present_for_what_is_gone(self, bench):
        """As ever: its interval says so."""
        retain(bench, "count", 1)
        first, _, third = (write(bench, value) for value in "123")
        bench.wait(3 * S, keep=("ann",))

        answer = bench.ask(TakeView(lock_id("ann", 4, 1), 1, 1, 99, (item(V),), 0, first))

        assert isinstance(answer, Viewed)
        assert answer.states[0].version == 3
        assert answer.until_ns < answer.from_ns == third


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


class TestList:
    def test_versions_are_listed_oldest_first_with_their_time(self, bench):
        """Each was current until the stamp of the next; the newest until further notice."""
        first, second = write(bench, "1"), write(bench, None)

        answer = bench.ask(ListHistory(("online",), ("pie*",), ()))

        assert [(e.state.version, e.state.stamp_ns, e.until_ns) for e in answer.entries] == [
            (1, first, second),
            (2, second, 0),
        ]
        assert [e.state.null_reason for e in answer.entries] == ["", "DELETED"]
        assert not any(entry.state.datum or entry.kept for entry in answer.entries)

    def test_list_is_narrowed(self, bench):
        """By what was still current then, and by number."""
        stamps = [write(bench, value) for value in "1234"]

        assert listed(bench, since_ns=stamps[2]) == [3, 4]
        assert listed(bench, since_ns=stamps[2] - 1) == [2, 3, 4]
        assert listed(bench, count_max=3) == [2, 3, 4]
        assert bench.ask(ListHistory((), ("other",), ())).entries == ()


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
        monkeypatch.setattr("enact_dist.core.history_desk.KEPT_MAX", 1)
        version = SlotVersion(slot(), 1)

        stranger = bench.ask(KeepVersions("zoe", "a", (version,)))
        unreadable = bench.ask(KeepVersions("ann", "a b", (version,)))
        many = bench.ask(KeepVersions("ann", "a", (version, version)))

        assert isinstance(stranger, EpochChanged)
        assert [unreadable.code, many.code] == ["value", "no_room"]


def test_kept_version_is_not_found_by_its_capture(bench):
    """Its slot may have had others with that stamp, which are forgotten: a set would be torn."""
    retain(bench, "frame", 2)
    capture(bench, 100)
    bench.ask(KeepVersions("ann", "a", (SlotVersion(slot("cam", "frame"), 1),)))
    for stamp_ns in (100, 200, 300):
        capture(bench, stamp_ns)
    asked = item(V, "cam", "frame")._replace(captured_ns=100)

    assert shown(bench, bench.shard.state.stamp(), asked) == ["OUTSIDE_RETENTION"]
    assert listed(bench, "frame") == [1, 3, 4]


class TestNearest:
    @pytest.mark.parametrize(
        ("captured_ns", "version"),
        [(100, 1), (149, 1), (150, 2), (151, 2), (400, 5), (10_000, 5), (1, 1), (310, 4), (300, 4)],
    )
    def test_version_next_to_a_stamp_is_shown(self, bench, captured_ns, version):
        """Of two as near, the later one; of two with one stamp, too."""
        for stamp_ns in (100, 200, 300, 300, 400):
            capture(bench, stamp_ns)
        asked = item(V, "cam", "frame")._replace(captured_ns=captured_ns, nearest=True)

        answer = as_of(bench, bench.shard.state.stamp(), asked)

        assert [state.version for state in answer.states] == [version]

    def test_nearest_as_of_a_stamp_sees_nothing_later(self, bench):
        """What was written since may be nearer, and is not shown."""
        capture(bench, 100)
        at_ns = bench.shard.state.stamp()
        capture(bench, 200)
        capture(bench, 190)
        asked = item(V, "cam", "frame")._replace(captured_ns=190, nearest=True)

        assert as_of(bench, at_ns, asked).states[0].version == 1
        assert as_of(bench, bench.shard.state.stamp(), asked).states[0].version == 3

    def test_data_without_a_stamp_are_near_to_nothing(self, bench):
        """There is no version to show then."""
        write(bench, "1", "frame", "cam")
        asked = item(V, "cam", "frame")._replace(captured_ns=190, nearest=True)

        assert shown(bench, bench.shard.state.stamp(), asked) == ["OUTSIDE_RETENTION"]

    def test_nearest_to_no_stamp_is_refused(self, bench):
        """It says nothing of when."""
        answer = as_of(bench, 0, item(V)._replace(nearest=True))

        assert isinstance(answer, Refused)
        assert "nearest to no stamp" in answer.text


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["write", "write", "write", "wait", "keep", "let go", "room"]),
            st.integers(0, 3),
            st.integers(0, 2),
        ),
        max_size=60,
    ),
    st.tuples(st.integers(1, 5), st.sampled_from([3 * SEC, NO_LIMIT]), st.integers(1, 40)),
)
def test_history_agrees_with_a_plain_list(acts, figures):
    """Each stamp shows what was then or that it is gone; what must stay does; nothing else does."""
    limits = Limits(*figures)
    slots = SlotMap((), policies={"mask": Policy(limits, stored=True)}, since_ns=0)
    plain: dict = {entity: [] for entity in range(3)}
    now_ns = 1
    for act, number, entity in acts:
        now_ns += 1
        at = slot(f"e{entity}", "mask")
        if act == "write":
            body, captured_ns = bytes(number * 4), 100 * (number % 3)
            made = Datum(b"e", body, len(body), captured_ns, f"s-{now_ns:x}" if number == 3 else "")
            content = Content(len(plain[entity]) + 1, now_ns, made, NullReason.DELETED)
            plain[entity].append(content)
            slots.replace(at, content)
        elif act == "wait":
            now_ns += SEC * number
            slots.history.grow_old(now_ns)
        elif act == "keep" and plain[entity]:
            version = plain[entity][max(0, len(plain[entity]) - 1 - number)].version
            slots.history.keep("label", SlotVersion(at, version), slots[at])
        elif act == "let go":
            slots.history.let_go("label")
        else:
            slots.make_room(1)
        slots.assert_invariants()
    for entity, versions in plain.items():
        at = slot(f"e{entity}", "mask")
        since_ns = slots.known_since_ns(at, slots[at])
        for at_ns in {content.stamp_ns + by for content in versions for by in (-1, 0, 1)}:
            right = next((c for c in reversed(versions) if c.stamp_ns <= at_ns), None)
            found = slots.as_of(at, at_ns)
            if isinstance(found, int):
                assert at_ns < found == since_ns
            else:
                assert found is right or (right is None and not found.version)
        replaced = len([c for c, until_ns in slots.versions(at) if until_ns])
        kept = slots.history.of(at).kept if slots.history.of(at) is not None else {}
        assert replaced <= limits.versions - 1 + len(kept)
