"""When an update runs: coalescing, order, back-off, the grid of a source."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from enact_dist.actor.triggers import BackOff, FixedRate, PendingTriggers
from enact_dist.terms import Entity

A, B, C = Entity("view/a"), Entity("view/b"), Entity("view/c")
SECOND_NS = 1_000_000_000


def taken(pending: PendingTriggers, now_ns: int = 0) -> list[str]:
    """Take all runs that are due and name their entities."""
    names = []
    while trigger := pending.take(now_ns):
        names.append(trigger.entity.name)
    return names


def test_pending_runs_each_entity_once_when_it_changed_often():
    """Changes of one entity share one run; those passed over are counted."""
    pending = PendingTriggers(per_entity=True)

    for version in (1, 2, 3):
        pending.changed(0, A, version)
    pending.changed(0, B, 1)

    assert taken(pending) == ["view/a", "view/b"]
    assert pending.skipped == 2


def test_pending_keeps_the_order_of_first_changes_when_one_changes_again():
    """A busy entity keeps its place and does not overtake or starve a quiet one."""
    pending = PendingTriggers(per_entity=True)

    for entity, version in ((A, 1), (B, 1), (A, 2)):
        pending.changed(0, entity, version)

    assert taken(pending) == ["view/a", "view/b"]


def test_pending_puts_an_entity_last_when_it_changes_while_it_runs():
    """After its turn a busy entity waits for the others."""
    pending = PendingTriggers(per_entity=True)
    for entity in (A, B):
        pending.changed(0, entity, 1)

    running = pending.take(0)
    pending.changed(0, A, 2)

    assert running is not None
    assert running.entity == A
    assert taken(pending) == ["view/b", "view/a"]
    assert pending.skipped == 0


def test_pending_ignores_a_repeated_state_when_a_snapshot_comes_twice():
    """A watch that was opened again runs nothing that was handed in before."""
    pending = PendingTriggers(per_entity=True)
    pending.changed(0, A, (1, 100))
    taken(pending)

    news = pending.changed(0, A, (1, 100))

    assert not news
    assert taken(pending) == []


def test_pending_runs_the_same_version_again_when_its_stamp_differs():
    """A volatile slot's versions restart with the shard: version 1 may be another datum."""
    pending = PendingTriggers(per_entity=True)
    pending.changed(0, A, (1, 100))
    taken(pending)

    pending.changed(0, A, (1, 200))

    assert taken(pending) == ["view/a"]


def test_pending_shares_one_run_when_no_request_depends_on_the_entity():
    """A set is looked at once for all changes; the entity is the one that changed last."""
    pending = PendingTriggers(per_entity=False)

    for entity in (A, B, C):
        pending.changed(0, entity, 1)

    assert taken(pending) == ["view/c"]
    assert pending.skipped == 0


def test_pending_drops_a_run_when_its_only_datum_became_null():
    """There is nothing to look at any more."""
    pending = PendingTriggers(per_entity=True)
    pending.changed(0, A, 1)

    pending.vanished(0, A, 9)

    assert taken(pending) == []
    assert pending.skipped == 1


def test_pending_keeps_a_run_when_only_one_of_two_data_became_null():
    """The other trigger datum is still news."""
    pending = PendingTriggers(per_entity=True)
    pending.changed(0, A, 1)
    pending.changed(1, A, 1)

    pending.vanished(0, A, 9)

    assert taken(pending) == ["view/a"]


def test_pending_runs_a_set_again_when_one_of_its_data_became_null():
    """The set has changed; a null that was never in it changes nothing."""
    pending = PendingTriggers(per_entity=False)
    pending.changed(0, A, 1)
    taken(pending)

    pending.vanished(0, A, 2, in_set=True)
    pending.vanished(0, B, 1, in_set=True)

    assert taken(pending) == ["view/a"]


def test_pending_runs_again_when_a_null_datum_was_set_to_its_old_state():
    """Null forgets what was seen: the same state after it is news."""
    pending = PendingTriggers(per_entity=True)
    pending.changed(0, A, 1)
    taken(pending)
    pending.vanished(0, A, 9)

    pending.changed(0, A, 1)

    assert taken(pending) == ["view/a"]


def test_pending_drops_a_run_when_the_last_update_has_seen_its_state():
    """A change between the trigger and the grant is part of that update already."""
    pending = PendingTriggers(per_entity=True)
    pending.changed(0, A, 1)
    pending.take(0)
    pending.changed(0, A, 2)

    pending.used(0, A, 2)

    assert taken(pending) == []


def test_pending_ignores_a_late_notice_when_the_last_update_has_seen_its_state():
    """The same, with the notice coming after the update."""
    pending = PendingTriggers(per_entity=True)
    pending.changed(0, A, 1)
    pending.take(0)
    pending.used(0, A, 2)

    news = pending.changed(0, A, 2)

    assert not news


def test_pending_lets_others_pass_when_one_is_postponed():
    """A refused run waits for its time; the others do not wait for it."""
    pending = PendingTriggers(per_entity=True)
    for entity in (A, B):
        pending.changed(0, entity, 1)
    refused = pending.take(0)
    assert refused is not None

    pending.postpone(refused, due_ns=SECOND_NS)

    assert taken(pending, SECOND_NS - 1) == ["view/b"]
    assert pending.due_ns() == SECOND_NS
    again = pending.take(SECOND_NS)
    assert again is not None
    assert (again.entity, again.refused) == (A, 1)
    assert pending.due_ns() is None


def test_pending_keeps_the_back_off_when_a_postponed_entity_changes():
    """New data do not shorten the pause after a refusal, nor reset its growth."""
    pending = PendingTriggers(per_entity=True)
    pending.changed(0, A, 1)
    refused = pending.take(0)
    assert refused is not None
    pending.changed(0, A, 2)
    pending.postpone(refused, due_ns=SECOND_NS)

    pending.changed(0, A, 3)

    assert pending.take(SECOND_NS - 1) is None
    again = pending.take(SECOND_NS)
    assert again is not None
    assert again.refused == 1
    assert again.states == {(0, "view/a"): 3}
    assert pending.skipped == 2


@given(st.lists(st.tuples(st.sampled_from("cftp"), st.sampled_from((A, B, C))), max_size=60))
def test_pending_hands_out_every_newest_state_whatever_comes_between(
    steps: list[tuple[str, Entity]],
):
    """No entity's newest state is ever lost, and each handed-in state is taken or counted."""
    pending = PendingTriggers(per_entity=True)
    newest: dict[str, int] = {}
    seen: dict[str, int] = {}
    handed_in = handed_out = 0
    running = None
    for now, (step, entity) in enumerate(steps):
        if step == "c":
            newest[entity.name] = newest.get(entity.name, 0) + 1
            handed_in += pending.changed(0, entity, newest[entity.name])
        elif step == "f" and running is not None:
            seen[running.entity.name] = running.states[0, running.entity.name]
            handed_out, running = handed_out + 1, None
        elif step == "t" and running is None:
            running = pending.take(now)
        elif step == "p" and running is not None:
            pending.postpone(running, now + 3)
            running = None

    if running is not None:
        seen[running.entity.name] = running.states[0, running.entity.name]
        handed_out += 1
    while trigger := pending.take(10**6):
        seen[trigger.entity.name] = trigger.states[0, trigger.entity.name]
        handed_out += 1

    assert seen == newest
    assert handed_in == handed_out + pending.skipped


def test_rate_ticks_at_once_and_then_on_its_grid_when_updates_are_short():
    """The first tick is at the start, the k-th at k periods, however late it was taken."""
    rate = FixedRate(0.1, now_ns=0, wall_ns=SECOND_NS)
    times_ns = range(0, 500_000_001, 7_000_000)
    taken_ns = [now_ns for now_ns in times_ns if rate.tick(now_ns, SECOND_NS + now_ns)]

    assert [now_ns // 100_000_000 for now_ns in taken_ns] == [0, 1, 2, 3, 4]
    assert rate.due_ns() == 500_000_000
    assert rate.missed == 0


def test_rate_counts_and_does_not_bunch_ticks_when_an_update_took_long():
    """After 3.5 periods one tick is late, two are missed, the next is on the grid."""
    rate = FixedRate(0.1, now_ns=0, wall_ns=SECOND_NS)
    rate.tick(0, SECOND_NS)

    late = rate.tick(350_000_000, SECOND_NS + 350_000_000)

    assert late == SECOND_NS + 300_000_000
    assert rate.missed == 2
    assert not rate.tick(399_999_999, SECOND_NS + 399_999_999)
    assert rate.due_ns() == 400_000_000


def test_sources_of_one_period_tick_together_whenever_they_are_ready():
    """Their ticks are the multiples of the period since 1970; the first is late, and at once."""
    ticks = []
    for ready_ns in (3 * SECOND_NS + 1, 3 * SECOND_NS + 70_000_000):  # monotonic 0 for each
        rate = FixedRate(0.1, now_ns=0, wall_ns=ready_ns)
        first = rate.tick(0, ready_ns)
        assert rate.due_ns() == 3_100_000_000 - ready_ns
        ticks.append((first, rate.tick(rate.due_ns(), ready_ns + rate.due_ns())))

    assert ticks == [(3 * SECOND_NS, 3 * SECOND_NS + 100_000_000)] * 2


def test_source_apart_from_others_begins_its_grid_when_it_is_ready():
    """`in_phase = False`: sources that would disturb each other do not tick together."""
    rate = FixedRate(0.1, now_ns=0, wall_ns=SECOND_NS + 33, in_phase=False)

    assert rate.tick(0, SECOND_NS + 33) == SECOND_NS + 33
    assert rate.due_ns() == 100_000_000


@pytest.mark.parametrize("set_s", [3600, -3600, 0.04, -0.04])
def test_grid_follows_a_wall_clock_that_was_set(set_s):
    """The source neither waits for an hour nor counts one as missed, and no tick comes twice."""
    rate = FixedRate(0.1, now_ns=0, wall_ns=SECOND_NS * 10_000)
    rate.tick(0, SECOND_NS * 10_000)
    ahead_ns = SECOND_NS * 10_000 + round(set_s * 1e9)
    ticks = []
    for now_ns in range(1_000_000, 1_000_000_000, 1_000_000):
        if tick := rate.tick(now_ns, now_ns + ahead_ns):
            ticks.append(tick)

    assert rate.missed == 0
    assert 9 <= len(ticks) <= 11
    assert all(tick % 100_000_000 == 0 for tick in ticks)
    assert len(set(ticks)) == len(ticks)
    assert abs(ticks[-1] - ahead_ns - SECOND_NS) <= 100_000_000


def test_back_off_doubles_up_to_its_limit_when_refused_again():
    """0.05 s, 0.1 s, 0.2 s … at most 2 s, also after very many refusals."""
    back_off = BackOff(spread=0.0)

    assert [back_off.wait_s(n, 0.9) for n in range(3)] == [0.05, 0.1, 0.2]
    assert back_off.wait_s(10_000, 0.9) == 2.0


def test_back_off_spreads_within_its_part_when_drawn_at_random():
    """Half of the wait is drawn: between 0.5 and 1 of the doubling."""
    back_off = BackOff(first_s=1.0, max_s=1.0, spread=0.5)

    assert back_off.wait_s(0, 0.0) == 1.0
    assert back_off.wait_s(0, 1.0) == 0.5
