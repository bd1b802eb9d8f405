"""The checker names what is wrong with a history, and passes sound ones."""

import random

import pytest

from enact_dist.verify.checker import (
    NOTHING,
    CapturedRead,
    ChainState,
    Checker,
    LockOutcome,
    LockStory,
    StateRead,
    name_of,
)


class HandMade:
    """Builds a history by hand: locks one after the other, slots as chains of their writers."""

    def __init__(self):
        self.stories = []
        self.chains = {}
        self.events = {}
        self.lost = set()

    def lock(
        self,
        name,
        *,
        at=(0, 100),
        told=LockOutcome.COMMITTED,
        reads=(),
        views=(),
        writes=(),
        **more,
    ):
        """Add a lock; readings are written `slot@writer`, and `slot@` for the state before all."""
        self.stories.append(
            LockStory(name, *at, told, _read(reads), _read(views), writes=writes, **more)
        )
        return self

    def chain(self, slot, *writers, versions=None):
        versions = versions or range(1, len(writers) + 1)
        self.chains[slot] = [ChainState(w, w, v) for w, v in zip(writers, versions, strict=True)]
        return self

    def checker(self):
        return Checker(self.stories, self.chains, events=self.events, lost=self.lost)

    def rules(self):
        return [anomaly.rule for anomaly in self.checker().anomalies()]


def _read(words):
    parts = [word.split("@") for word in words]
    return [StateRead(slot, name or NOTHING) for slot, name in parts]


@pytest.fixture
def told():
    return HandMade()


def test_sound_history_passes(told):
    """Transfers, a reader between them and a restart of a volatile slot are in order."""
    told.lock("a", at=(0, 10), writes=["x", "y"], reads=["x@", "y@"])
    told.lock("b", at=(11, 20), writes=["x"], reads=["x@a", "y@a"], views=["x@a", "y@a"])
    told.lock("c", at=(12, 30), reads=["y@a"], views=["x@b", "y@a"])
    told.lock("never ended", at=(5, None), told=LockOutcome.UNKNOWN, writes=["x"])
    told.lock("timed out", at=(5, 6), told=LockOutcome.NOT, writes=["x"])
    told.events["restart"] = (40, 41)
    told.chain("x", "a", "b").chain("y", "a").chain("v", "a", "restart", "b", versions=[1, 0, 1])
    told.chain("v", "a", "restart", versions=[1, 0])

    assert told.rules() == []


def test_lost_update_is_named(told):
    """Two locks that overwrite one and the same state lose one of them."""
    told.lock("a", writes=["x"], reads=["x@"]).lock("b", writes=["x"], reads=["x@"])
    told.chain("x", "a", "b")

    assert told.rules() == ["lost update"]


def test_write_skew_is_named(told):
    """Two locks that each read what the other writes have no order."""
    told.lock("a", writes=["x"], reads=["x@", "y@"]).lock("b", writes=["y"], reads=["x@", "y@"])
    told.chain("x", "a").chain("y", "b")

    assert told.rules() == ["write skew"]


def test_stale_read_is_named(told):
    """What began after another had committed sees what it wrote."""
    told.lock("a", at=(0, 10), writes=["x"]).lock("b", at=(11, 20), reads=["x@"])
    told.chain("x", "a")

    assert told.rules() == ["stale read"]


def test_reader_that_overlaps_may_see_either(told):
    """Without an end before a beginning, real time says nothing."""
    told.lock("a", at=(0, 12), writes=["x"]).lock("b", at=(11, 20), reads=["x@"])
    told.chain("x", "a")

    assert told.rules() == []


def test_writes_against_real_time_are_named(told):
    """A write that ended first cannot come second."""
    told.lock("a", at=(0, 10), writes=["x"]).lock("b", at=(11, 20), writes=["x"])
    told.chain("x", "b", "a")

    assert told.rules() == ["real time order is broken"]


def test_read_of_half_a_commit_is_named(told):
    """One slot from before a commit, the other from after it."""
    told.lock("a", writes=["x", "y"]).lock("b", reads=["x@a", "y@"])
    told.chain("x", "a").chain("y", "a")

    assert told.rules() == ["half of a commit was read"]


def test_view_of_half_a_commit_is_named(told):
    """Views are no reads, but they show a commit whole."""
    told.lock("a", writes=["x", "y"]).lock("b", views=["x@a", "y@"])
    told.chain("x", "a").chain("y", "a")

    assert told.rules() == ["a view shows half a commit"]


def test_half_a_commit_is_named(told):
    """A commit that is in one slot and not in the other; nobody was told anything."""
    told.lock("a", at=(0, None), told=LockOutcome.UNKNOWN, writes=["x", "y"]).chain("x", "a")

    assert told.rules() == ["half a commit"]


def test_dirty_read_is_named(told):
    """A committed lock read what nobody committed."""
    told.lock("a", told=LockOutcome.NOT, writes=["x"]).lock("b", reads=["x@a"])

    assert told.rules() == ["dirty read"]


def test_visible_though_told_not_is_named(told):
    """Who was told that nothing was written must not find it."""
    told.lock("a", told=LockOutcome.NOT, writes=["x"]).chain("x", "a")

    assert told.rules() == ["told not committed, but visible"]


def test_commit_that_is_gone_is_named(told):
    """Who was told that it stands must find it."""
    told.lock("a", writes=["x"])

    assert told.rules() == ["told committed, but lost"]


def test_declared_loss_is_none(told):
    """What an aspect declares may be lost."""
    told.lock("a", writes=["x"])
    told.lost.add("a")

    assert told.rules() == []


def test_gap_is_named(told):
    """A version that nobody wrote was there once."""
    told.lock("a", writes=["x"]).lock("b", writes=["x"]).chain("x", "a", "b", versions=[1, 3])

    assert told.rules() == ["versions have a gap"]


def test_version_written_twice_is_named(told):
    """Two locks that claim one version: one of them was not fenced."""
    told.lock("a", writes=["x"]).lock("b", writes=["x"]).chain("x", "a", "b", versions=[1, 1])

    assert told.rules() == ["one version was written twice"]


def test_writer_that_is_not_there_is_named(told):
    """Whatever is in a slot was put there by a lock."""
    told.chain("x", "a")

    assert told.rules() == ["written by no lock"]


def test_circle_of_writes_is_named(told):
    """Two locks that each overwrite the other have no order."""
    told.lock("a", writes=["x", "y"]).lock("b", writes=["x", "y"])
    told.chain("x", "a", "b").chain("y", "b", "a")

    assert told.rules() == ["circular dependency"]


def test_promise_over_a_restart_is_no_cycle(told):
    """A lock that writes over shards outlives the restart that empties what it has read."""
    told.events["restart"] = (50, 60)
    told.chain("v", "a", "restart", versions=[1, 0]).chain("x", "b")
    told.lock("a", at=(0, 10)).lock("c", at=(61, 70), reads=["v@restart", "x@"])
    told.lock("b", at=(20, 90), reads=["v@a"], writes=["x"], outlives_restarts=True)
    assert told.rules() == []

    told.stories[-1].outlives_restarts = False
    assert told.rules() == ["write skew"]


def test_cycle_is_told_by_its_shortest_way(told):
    """Of a long history only the locks that contradict each other are shown."""
    slots = [f"s{i}" for i in range(50)]
    for number, slot in enumerate(slots):
        told.lock(f"w{number}", at=(number, number + 0.5), writes=[slot, "x"], reads=[])
        told.chain(slot, f"w{number}")
    told.chain("x", *(f"w{i}" for i in range(50)))
    told.lock("late", at=(100, 110), reads=["x@w48"])

    (anomaly,) = told.checker().anomalies()

    assert anomaly.rule == "stale read"
    assert len(anomaly.facts) == 2
    assert "late --rw x--> w49" in anomaly.facts
    assert any(fact.startswith("w49 --time") for fact in anomaly.facts)


@pytest.mark.parametrize("seed", range(20))
def test_serial_histories_pass_and_swapped_ones_do_not(seed):
    """Locks run one after the other are sound; two swapped writers of a slot are not."""
    draw, told = random.Random(seed), HandMade()
    chains = {slot: [] for slot in "abcd"}
    for number in range(60):
        name, slots = f"l{number}", draw.sample("abcd", draw.randint(1, 4))
        reads = [f"{slot}@{chains[slot][-1] if chains[slot] else ''}" for slot in slots]
        written = draw.sample(slots, draw.randint(0, len(slots)))
        told.lock(name, at=(10 * number, 10 * number + 15), reads=reads, writes=written)
        for slot in written:
            chains[slot].append(name)
    for slot, writers in chains.items():
        told.chain(slot, *writers)
    assert told.rules() == []

    slot = draw.choice([slot for slot, writers in chains.items() if len(writers) > 2])
    at = draw.randrange(len(chains[slot]) - 1)
    writers = chains[slot]
    writers[at], writers[at + 1] = writers[at + 1], writers[at]
    told.chain(slot, *writers)

    assert told.rules()


def test_names_of_cycles_cover_every_kind():
    """A cycle without any edge has no name to go by but the common one."""
    assert name_of([]) == "circular dependency"


def test_set_that_shows_half_of_a_commit_is_told(told):
    """One commit captured both; the set has its datum in one slot and an older one in the other."""
    told.lock("a", writes=["x", "y"]).lock("b", writes=["x", "y"])
    told.chains["x"] = [ChainState("a", "a", 1, 7), ChainState("b", "b", 2, 7)]
    told.chains["y"] = [ChainState("a", "a", 1, 7), ChainState("b", "b", 2, 7)]
    told.lock("whole", captured=[CapturedRead("x", "b", 7), CapturedRead("y", "b", 7)])
    assert told.rules() == []

    told.lock("half", captured=[CapturedRead("x", "b", 7), CapturedRead("y", "a", 7)])
    assert told.rules() == ["a set shows half a commit"]


def test_set_beside_a_view_of_the_same_commit_is_told(told):
    """What a view shows is there, so its other half is not older either."""
    told.lock("a", writes=["y"]).lock("b", writes=["x", "y"])
    told.chain("x", "b")
    told.chains["y"] = [ChainState("a", "a", 1, 7), ChainState("b", "b", 2, 7)]
    told.lock("half", views=["x@b"], captured=[CapturedRead("y", "a", 7)])

    assert told.rules() == ["a set shows half a commit"]


def test_datum_of_another_stamp_is_told(told):
    """A set has nothing in it but its own stamp; what is not retained is no fault."""
    told.lock("a", writes=["x"])
    told.chains["x"] = [ChainState("a", "a", 1, 7)]
    told.lock("gone", captured=[CapturedRead("x", NOTHING, 8)])
    assert told.rules() == []

    told.lock("wrong", captured=[CapturedRead("x", "a", 8)])
    assert told.rules() == ["another stamp was shown"]
