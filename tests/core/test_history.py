"""History: how replaced versions are found, by time, by list and by capture stamp."""

from __future__ import annotations

import pytest
from history_parts import SEC, VE, V, W, as_of, capture, listed, retain, shown, write
from hypothesis import given, settings
from hypothesis import strategies as st
from shard_bench import S, datum, item, lock_id, slot

from enact_dist.core.protocol.datum import Datum
from enact_dist.core.protocol.messages import (
    Forgotten,
    KeepVersions,
    ListHistory,
    Prepare,
    Refused,
    SlotVersion,
    TakeView,
    Viewed,
    WriteItem,
)
from enact_dist.core.protocol.parts import NO_LIMIT
from enact_dist.core.protocol.records import Content
from enact_dist.core.state.history import Policy
from enact_dist.core.state.retention import Limits
from enact_dist.core.state.slots import SlotMap
from enact_dist.terms import NullReason

SESSIONS = ("ann",)


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
        assert "nearest to no capture stamp" in answer.text


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
