"""Whose request is next: order of each client, turns of all, and what has no room."""

import pytest

from enact_dist.link.zenoh import fairness as module
from enact_dist.link.zenoh.fairness import Turns


def filled(*sent):
    """Return turns with requests such as "a0" waiting, each of one byte."""
    turns = Turns()
    for name in sent:
        assert turns.put(name[0], 1, name)
    return turns


def taken(turns):
    return [turns.take()[1] for _ in range(len(turns))]


def test_turns_keep_the_order_of_one_client():
    """Alone it is served as it asked."""
    assert taken(filled("a0", "a1", "a2")) == ["a0", "a1", "a2"]


def test_turns_serve_one_request_of_each_client_in_rotation():
    """Who has sent one request waits for one of each other client, in whatever order they came."""
    turns = filled("a0", "a1", "a2", "b0", "b1", "c0")

    assert taken(turns) == ["a0", "b0", "c0", "a1", "b1", "a2"]


def test_turns_put_a_client_that_was_just_served_behind_all_others():
    """A client that asks again at once gets no second turn before the others."""
    turns = filled("a0", "b0", "b1")
    first = turns.take()[1]
    turns.put("a", 1, "a1")

    assert [first, *taken(turns)] == ["a0", "b0", "a1", "b1"]


def test_turns_number_requests_as_they_came():
    """Each has the count of those before it, also of those that have gone since."""
    turns = filled("a0", "a1", "b0")
    numbers = [turns.take()[0] for _ in range(2)]
    turns.put("c", 1, "c0")

    assert numbers == [0, 2]
    assert [turns.take()[0] for _ in range(2)] == [1, 3]
    assert turns.put_count == 4


@pytest.mark.parametrize(
    ("bound", "value"), [("OF_ONE_MAX", 3), ("OF_ONE_BYTES_MAX", 30)], ids=["requests", "bytes"]
)
def test_turns_refuse_what_is_too_much_of_one_client_alone(monkeypatch, bound, value):
    """Its fourth request is not taken in, another client's first one is; then there is room."""
    monkeypatch.setattr(module, bound, value)
    turns = Turns()

    took = [turns.put("a", 10, index) for index in range(4)]
    other = turns.put("b", 10, "b0")
    first = turns.take()[1]

    assert (took, other, first) == ([True, True, True, False], True, 0)
    assert turns.put("a", 10, "again")
    assert taken(turns) == ["b0", 1, 2, "again"]


@pytest.mark.parametrize(
    ("bound", "value"), [("OF_ALL_MAX", 3), ("OF_ALL_BYTES_MAX", 30)], ids=["requests", "bytes"]
)
def test_turns_refuse_what_is_too_much_of_all_together(monkeypatch, bound, value):
    """Whoever comes when all is full is not taken in; once one was served there is room."""
    monkeypatch.setattr(module, bound, value)
    turns = Turns()

    took = [turns.put(client, 10, client) for client in "abcd"]
    size = len(turns)
    turns.take()

    assert (took, size) == ([True, True, True, False], 3)
    assert turns.put("d", 10, "d")
    assert taken(turns) == ["b", "c", "d"]


def test_turns_have_room_for_one_request_of_any_size(monkeypatch):
    """Otherwise a client could never send it."""
    monkeypatch.setattr(module, "OF_ONE_BYTES_MAX", 30)
    turns = Turns()

    assert [turns.put("a", 31, "long"), turns.put("a", 1, "short")] == [True, False]


def test_turns_say_when_nothing_waits():
    """After the last one they are as new."""
    turns = filled("a0")
    turns.take()

    assert not turns
    with pytest.raises(IndexError):
        turns.take()
    assert turns.put("a", 1, "a1")
    assert taken(turns) == ["a1"]
