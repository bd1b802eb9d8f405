"""Stamps, beliefs, placement and slots: the small pure parts."""

from __future__ import annotations

import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st
from shard_bench import S, datum, slot

from enact_dist.core.client.lease_clock import SENDINGS_KEPT, Sendings, shortened_ns
from enact_dist.core.protocol.datum import Column, Datum, Position, Slot
from enact_dist.core.protocol.messages import AspectEntry, Item, Pin, PlacementMap, ShardEntry
from enact_dist.core.protocol.placement import shard_of
from enact_dist.core.protocol.records import NOTHING, AuditRecord, Content, SlotRecord
from enact_dist.core.state.audit import ALARM, ENTRIES_MAX, SETTLED, Audit
from enact_dist.core.state.catalogue import Catalogue
from enact_dist.core.state.clock import AHEAD_NS_MAX, Stamps
from enact_dist.core.state.sessions import SessionState
from enact_dist.core.state.slots import INLINE_BYTES_MAX, SlotMap
from enact_dist.terms import Access, NullReason

STEPS = st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 10**6)), min_size=1, max_size=30)


class TestStamps:
    @given(STEPS)
    def test_stamps_grow_whatever_the_wall_clock_does(self, steps):
        """Each stamp exceeds the last one and everything that its client had seen."""
        stamps, last_ns = Stamps(0), 0
        for seen_ns, wall_ns in steps:
            stamp_ns = stamps.next(seen_ns=seen_ns, wall_ns=wall_ns)
            assert stamp_ns > last_ns
            assert stamp_ns > seen_ns
            assert stamp_ns >= wall_ns
            last_ns = stamp_ns

    @given(STEPS)
    def test_present_lies_before_every_later_commit(self, steps):
        """What was said to be now is never a later commit's stamp."""
        stamps = Stamps(0)
        for seen_ns, wall_ns in steps:
            present_ns = stamps.now(wall_ns=wall_ns)
            assert stamps.next(seen_ns=seen_ns, wall_ns=wall_ns) > present_ns

    @pytest.mark.parametrize(
        ("ahead_ns", "refused"), [(0, False), (AHEAD_NS_MAX, False), (AHEAD_NS_MAX + 1, True)]
    )
    def test_stamp_from_too_far_ahead_is_refused(self, ahead_ns, refused):
        """A second of skew is borne, not more."""
        assert Stamps(0).too_far_ahead(S + ahead_ns, wall_ns=S) is refused

    def test_own_stamps_are_never_too_far_ahead(self):
        """A wall clock that was set back does not shut out those who saw the old time."""
        assert not Stamps(3600 * S).too_far_ahead(3600 * S, wall_ns=0)


class TestBeliefs:
    def test_belief_counts_from_the_message_that_was_seen(self):
        """Not from the newest one sent."""
        sendings = Sendings()
        first = sendings.next(1 * S)
        sendings.next(2 * S)

        assert sendings.believe_until_ns(first, S) == 1 * S + shortened_ns(S)

    def test_message_that_was_never_sent_gives_no_belief(self):
        """A shard that has seen nothing proves nothing."""
        assert Sendings().believe_until_ns(0, S) == 0

    @pytest.mark.parametrize("sent", [1, SENDINGS_KEPT, SENDINGS_KEPT + 1, 3 * SENDINGS_KEPT])
    def test_exactly_the_newest_messages_give_the_belief_of_their_sending(self, sent):
        """Memory is bounded; forgetting shortens beliefs, which is safe."""
        sendings = Sendings()
        for number in range(1, sent + 1):
            assert sendings.next(number * S) == number

        for number in range(-1, sent + 2):
            known = max(0, sent - SENDINGS_KEPT) < number <= sent
            belief_ns = number * S + shortened_ns(S) if known else 0
            assert sendings.believe_until_ns(number, S) == belief_ns

    def test_memory_is_taken_before_the_first_message(self):
        """A client that has just started does not grow by what it sends."""
        sendings = Sendings()
        size = sys.getsizeof(sendings._sent)
        for number in range(3 * SENDINGS_KEPT):
            sendings.next(number * S)

        assert sys.getsizeof(sendings._sent) == size

    @given(st.integers(1, 10**12), st.integers(-10_000, 10_000), st.integers(-10_000, 10_000))
    def test_belief_ends_before_the_lease_for_all_clocks(self, ttl_ns, client_ppm, shard_ppm):
        """With both clocks within 1 % the client stops believing first."""
        believed_true_ns = shortened_ns(ttl_ns) * 1_000_000 / (1_000_000 + client_ppm)
        lease_true_ns = ttl_ns * 1_000_000 / (1_000_000 + shard_ppm)

        assert believed_true_ns <= lease_true_ns + 1


class TestLease:
    @pytest.mark.parametrize(
        ("renewed_ns", "token", "now_ns", "ends_ns"),
        [
            (0, None, 0, 100),
            (0, (True, 10), 500, 550),
            (0, (False, 10), 500, 100),
            (0, (False, 90), 500, 140),
        ],
    )
    def test_lease_ends_with_the_later_of_message_and_token(
        self, renewed_ns, token, now_ns, ends_ns
    ):
        """max(last keep-alive + TTL, token last seen + TTL / 2)."""
        session = SessionState("s", 100, renewed_ns=renewed_ns)
        if token is not None:
            session.token_present, session.token_seen_ns = token

        assert session.lease_end_ns(now_ns) == ends_ns


class TestPlacement:
    SHARDS = tuple(ShardEntry(f"s{number}", ()) for number in range(4))

    def test_entities_spread_over_the_shards(self):
        """No shard owns much more than its share."""
        placement = PlacementMap(1, self.SHARDS, ())
        owners = [shard_of(f"object/{number}", placement) for number in range(2000)]

        assert all(400 < owners.count(shard.name) < 600 for shard in self.SHARDS)

    def test_new_shard_takes_only_what_it_wins(self):
        """When a shard is added, no entity moves between the old ones."""
        before = PlacementMap(1, self.SHARDS[:3], ())
        after = PlacementMap(2, self.SHARDS, ())
        for number in range(500):
            name = f"object/{number}"
            assert shard_of(name, after) in (shard_of(name, before), "s3")

    def test_first_pin_that_matches_decides(self):
        """Pins come before the hash, in their order."""
        pins = (Pin("tray/1", "s2"), Pin("tray/**", "s1"))
        placement = PlacementMap(1, self.SHARDS, pins)

        assert [shard_of(name, placement) for name in ("tray/1", "tray/2")] == ["s2", "s1"]

    def test_placement_without_shards_owns_nothing(self):
        """An empty map is an error, not a guess."""
        with pytest.raises(ValueError, match="no shard"):
            shard_of("a", PlacementMap(1, (), ()))


class TestSlots:
    def test_counts_follow_what_is_set(self):
        """Bytes and slots are those of the newest states."""
        slots = SlotMap(())
        for size in (10, 3):
            body = Datum(b"", b"x" * size, size)
            slots.set(slot(), Content(1, 1, body, NullReason.DELETED))
        slots.set(slot("other"), Content(1, 1, None, NullReason.DELETED))

        assert (slots.count, slots.bytes) == (2, 3)

    def test_slot_that_nobody_wrote_is_never_set(self):
        """Null has a reason."""
        slots = SlotMap(())
        (state,) = slots.shown([Item(Access.READ, *slot())]).states

        assert slots[slot()] is NOTHING
        assert (state.version, state.datum, state.null_reason) == (0, None, "NEVER_SET")

    def test_pattern_shows_what_is_not_null(self):
        """A pattern stands for the entities that have the datum."""
        slots = SlotMap(())
        slots.set(slot("tray/1"), Content(1, 1, datum(), NullReason.DELETED))
        slots.set(slot("tray/2"), Content(2, 2, None, NullReason.DELETED))
        slots.set(slot("bench"), Content(1, 3, datum(), NullReason.DELETED))
        states = slots.shown([Item(Access.READ_EACH, "online", "tray/*", "count")]).states

        assert [state.slot.entity for state in states] == ["tray/1"]
        assert len(list(slots.matching(Column("online", "count"), "tray/*"))) == 2

    @pytest.mark.parametrize(
        ("size", "large"), [(INLINE_BYTES_MAX, False), (INLINE_BYTES_MAX + 1, True)]
    )
    def test_large_datum_does_not_travel_with_the_grant(self, size, large):
        """Up to 64 KiB travel, more waits to be fetched."""
        slots = SlotMap(())
        slots.set(slot(), Content(1, 1, Datum(b"e", bytes(size), size), NullReason.DELETED))
        (state,) = slots.shown([Item(Access.READ, *slot())]).states

        assert (state.large, state.size) == (large, size)
        assert state.datum is not None
        assert len(state.datum.body) == (0 if large else size)

    def test_recovered_states_are_what_was_recorded(self):
        """A restart shows what the store has kept; volatile slots are known but lost."""
        slots = SlotMap(
            [
                SlotRecord(slot("a"), 3, 7, datum("x"), ""),
                SlotRecord(slot("b"), 4, 8, None, "DELETED"),
                SlotRecord(slot("c"), 9, 9, None, "", volatile=True),
            ]
        )

        assert slots[slot("a")].version == 3
        assert slots[slot("b")].null_reason is NullReason.DELETED
        assert slots[slot("c")] == Content(0, 0, None, NullReason.LOST)


class TestCatalogue:
    def test_cell_decides_the_durability(self):
        """What `cell.toml` says wins over what an aspect says."""
        catalogue = Catalogue(
            configured=[AspectEntry("count", "", "volatile")], recovered=(), worlds=()
        )
        entry, new = catalogue.register(AspectEntry("count", "int", "os"))

        assert (entry.durability, new) == ("volatile", True)

    def test_cell_that_says_no_durability_leaves_it_to_the_aspect(self):
        """A line about its history alone makes nothing durable."""
        catalogue = Catalogue(configured=[AspectEntry("count", "", "", 5)], recovered=(), worlds=())
        entry, _ = catalogue.register(AspectEntry("count", "int", "volatile"))

        assert (entry.durability, entry.retention) == ("volatile", 5)

    def test_unsaid_durability_is_durable(self):
        """Whoever says nothing loses nothing."""
        catalogue = Catalogue(configured=(), recovered=(), worlds=())

        assert catalogue.register(AspectEntry("count", "int", ""))[0].durability == "durable"

    def test_other_durability_is_refused_by_name(self):
        """Two actors that disagree are told so."""
        catalogue = Catalogue(configured=(), recovered=(), worlds=())
        catalogue.register(AspectEntry("count", "int", "os"))

        refusal = catalogue.register(AspectEntry("count", "int", "volatile"))

        assert isinstance(refusal, str)
        assert "registered as os" in refusal


def test_positions_are_ordered_by_time():
    """A position can be compared with another one."""
    assert Position(1, "s1") < Position(2, "s0")
    assert Slot("a", "b", "c") == ("a", "b", "c")


def test_audit_remembers_the_newest_acts_and_every_alarm():
    """Locks that somebody breaks in a loop fill no memory; an alarm outlasts its own entry."""
    audit = Audit([AuditRecord(1, "torn", ALARM)])
    for number in range(2, 2 * ENTRIES_MAX):
        audit.keep(AuditRecord(number, "broken"))

    assert len(audit._records) == len(audit.entries()) == ENTRIES_MAX
    assert (len(audit), audit.left_out, audit.alarms) == (2 * ENTRIES_MAX - 1, ENTRIES_MAX - 1, 1)
    assert audit.may_settle(1)
    audit.keep(AuditRecord(3 * ENTRIES_MAX, "seen to", SETTLED))
    assert audit.alarms == 0
