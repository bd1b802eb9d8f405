"""How a lock ends with its writes: whom it asks for what, and when it decides."""

from __future__ import annotations

import pytest
from shard_bench import datum, lock_id, slot

from enact_dist.core.client.finishing import Finishing, tokens_of
from enact_dist.core.client.plan import Part
from enact_dist.core.protocol.datum import Token
from enact_dist.core.protocol.messages import (
    Commit,
    Prepare,
    Prepared,
    SlotVersion,
    Validate,
    WriteItem,
)

LOCK = lock_id("ann")
TOKENS = {"a": Token(1, 5), "b": Token(2, 6), "c": Token(3, 7), "d": Token(4, 0)}
WRITE = (WriteItem(slot(), datum()),)
EXPECT = (SlotVersion(slot("other"), 3),)


def finishing(
    *writing: str, expects: dict[str, tuple[SlotVersion, ...]] | None = None
) -> Finishing:
    """Return the end of a lock that has all four shards and writes on some."""
    return Finishing(LOCK, TOKENS, dict.fromkeys(writing, WRITE), expects or {})


def test_lowest_writing_shard_decides():
    """Whatever the order in which the writes were named."""
    assert finishing("c", "b").primary == "b"


def test_without_writes_nobody_decides_and_everybody_validates():
    """A lock that only reads is confirmed everywhere."""
    end = finishing()

    assert end.primary == ""
    assert [(shard, type(request)) for shard, request in end.votes_to_ask(0)] == [
        (shard, Validate) for shard in TOKENS
    ]


def test_other_writers_prepare_and_the_rest_validates():
    """Each with its own grant; whoever prepares learns whom to ask, and by which grant."""
    votes = dict(finishing("b", "c").votes_to_ask(99))

    assert votes == {
        "a": Validate(LOCK, TOKENS["a"]),
        "c": Prepare(LOCK, TOKENS["c"], WRITE, 99, (), "b", TOKENS["b"]),
        "d": Validate(LOCK, TOKENS["d"]),
    }


def test_expectations_travel_to_their_shards():
    """With the vote, or with the commit itself where that is decided."""
    end = finishing("b", "c", expects=dict.fromkeys("bcd", EXPECT))
    votes = dict(end.votes_to_ask(0))

    assert (votes["a"].expects, votes["c"].expects, votes["d"].expects) == ((), EXPECT, EXPECT)
    assert end.commit(0, None, 0).expects == EXPECT


def test_only_who_has_not_answered_is_asked_again():
    """A lost answer costs one more call, not all."""
    end = finishing("b")
    del end.left["a"]

    assert [shard for shard, _ in end.votes_to_ask(0)] == ["c", "d"]


def test_commit_names_its_participants_and_comes_after_their_promises():
    """Its stamp must be the largest: views of other shards rely on it."""
    end = finishing("a", "b", "c")
    end.prepared = {"c": Prepared(LOCK, 70, ()), "b": Prepared(LOCK, 90, ())}

    assert end.commit(80, None, 0) == Commit(LOCK, TOKENS["a"], WRITE, 90, (), ("b", "c"))
    assert end.commit(100, None, 0).seen_stamp_ns == 100
    assert end.token == TOKENS["a"]


def test_commit_on_one_shard_alone_has_no_participants():
    """It decides by itself, in one step."""
    assert finishing("b").commit(5, None, 0) == Commit(LOCK, TOKENS["b"], WRITE, 5)


def test_where_something_is_only_expected_the_epoch_stands_for_a_grant():
    """A grant there comes before it, as it says more."""
    parts = [Part("a", (), Token(1, 5)), Part("b", ())]

    tokens = tokens_of(parts, {"a": 9, "d": 4})

    assert tokens == {"a": Token(1, 5), "d": Token(4, 0)}


@pytest.mark.parametrize(
    ("epoch", "recorded", "prepared", "known_in"),
    [
        (7, (), False, 7),
        (7, ("other",), False, 7),
        (7, ("count", "other"), False, 0),
        (7, (), True, 0),
        (1_700_000_000_000, ("count",), False, 1_700_000_000_000),
        (1_700_000_000_000, ("count",), True, 1_700_000_000_000),
    ],
)
def test_outcome_outlives_a_restart_if_the_shard_has_recorded_it(
    epoch, recorded, prepared, known_in
):
    """As data that are not volatile, or as a decision; and only if the shard has a folder."""
    end = Finishing(LOCK, {**TOKENS, "a": Token(epoch, 5)}, {"a": WRITE, "b": WRITE}, {})
    end.recorded, end.sent = frozenset(recorded), True
    if prepared:
        end.prepared = {"b": Prepared(LOCK, 90, ())}
    end.note_who_knows()

    assert end.known_in == known_in
