"""Slices through a window, over a way that loses, repeats and reorders what it is given."""

import random
import socket
from collections import deque
from types import SimpleNamespace

import pytest

from enact_dist.core.client.plan import Reading
from enact_dist.core.protocol.datum import Datum, LockId, Slot
from enact_dist.core.protocol.messages import EpochChanged, Gone, Refused, Slice, SlotState
from enact_dist.errors import EnactError, LeaseLostError, ProtocolError, ShardUnreachableError
from enact_dist.link.client import transfer
from enact_dist.link.client.fetch import DatumCache, fetch_all
from enact_dist.link.client.transfer import Piece, Transfer
from enact_dist.link.socket.carrier import _Begun
from enact_dist.link.socket.line import Connection, SocketLine

LOCK = LockId("session", 0, 1)
SLICE = 1000


class Way:
    """A client whose shards hold data by slot; `answer` may be replaced to spoil it."""

    def __init__(self, data=(), *, slice_bytes=SLICE):
        self.data = dict(data)
        self.carrier = SimpleNamespace(
            fetch_bytes=slice_bytes,
            endpoint_of=lambda shard: f"tcp/{shard}:1",
            reason_away=lambda _: "",
        )
        self.request_timeout_s = 10.0
        self.asked, self.under_way, self.most_bytes = [], {}, 0
        self.rests, self.counters, self.abandoned = [], {}, 0

    def begin(self, shard, request, *, timeout_s):
        self.asked.append((shard, request))
        key = object()
        self.under_way[key] = getattr(request, "length", 0)
        self.most_bytes = max(self.most_bytes, sum(self.under_way.values()))

        def wait(_into=None):
            del self.under_way[key]
            return self.answer(shard, request)

        def abandon():
            del self.under_way[key]
            self.abandoned += 1

        return SimpleNamespace(wait=wait, abandon=abandon)

    def answer(self, _shard, fetch):
        body = self.data[fetch.slot]
        part = body[fetch.offset : fetch.offset + fetch.length]
        return Slice(
            fetch.slot,
            fetch.version,
            b"\x01",
            7,
            len(body),
            fetch.offset,
            Datum(b"", part, len(part)),
        )

    def rest(self, pause_s):
        self.rests.append(pause_s)

    def count(self, name, amount=1):
        self.counters[name] = self.counters.get(name, 0) + amount


def reading(slot, size, shard="s0", version=1):
    return Reading(shard, 1, SlotState(slot, version, 0, size, None, False, True, ""))


def cloud(name, size, seed=1):
    return Slot("w", name, "cloud"), random.Random(seed).randbytes(size)


@pytest.mark.parametrize("size", [1, SLICE - 1, SLICE, SLICE + 1, 57 * SLICE + 13])
def test_datum_comes_whole_whatever_its_length(size):
    """The slices of one datum make up its bytes, its encoding and its stamp."""
    slot, body = cloud("a", size)
    way = Way({slot: body})

    datum = fetch_all(way, DatumCache(), LOCK, [reading(slot, size)])[slot]

    assert bytes(datum.body) == body
    assert (datum.encoding, datum.stamp_ns, datum.size) == (b"\x01", 7, size)
    assert datum.body.readonly


@pytest.mark.parametrize("seed", range(5))
def test_only_the_slices_that_were_lost_are_asked_again(seed):
    """With 3 of 10 answers lost, each slice is asked once more for each time it was lost."""
    slot, body = cloud("a", 40 * SLICE)
    way, draw = Way({slot: body}), random.Random(seed)
    answer, lost = way.answer, []

    def lose(shard, fetch):
        if draw.random() < 0.3:
            lost.append(fetch.offset)
            return None
        return answer(shard, fetch)

    way.answer = lose
    datum = fetch_all(way, DatumCache(), LOCK, [reading(slot, len(body))])[slot]

    assert bytes(datum.body) == body
    asked = sorted(fetch.offset for _, fetch in way.asked)
    assert asked == sorted([*range(0, len(body), SLICE), *lost])
    assert way.counters == {"slices_repeated": len(lost)}
    assert lost
    assert not way.under_way


def test_window_bounds_what_is_under_way_and_opens_with_answers(monkeypatch):
    """It begins small, opens up to its limit, and never goes beyond it."""
    monkeypatch.setattr(transfer, "FIRST_WINDOW_BYTES", 2 * SLICE)
    way, seen = Way(slice_bytes=SLICE), []
    way.answer = lambda *_: seen.append(sum(way.under_way.values()) + SLICE) or True
    request = SimpleNamespace(length=SLICE)

    Transfer(way, lambda: None, window_bytes=8 * SLICE).run(
        Piece("s0", request, SLICE, lambda _: None) for _ in range(50)
    )

    assert seen[0] == 2 * SLICE
    assert max(seen) == way.most_bytes == 8 * SLICE
    assert seen[-1] == SLICE


def test_window_closes_when_answers_are_lost():
    """After a loss less is under way, and what is left of the window is waited for first."""
    way, seen, lost = Way(slice_bytes=SLICE), [], iter([False] * 30 + [True] * 3)

    def answer(*_):
        seen.append(len(way.under_way) + 1)
        return None if next(lost, False) else True

    way.answer = answer
    request = SimpleNamespace(length=SLICE)
    Transfer(way, lambda: None, window_bytes=8 * SLICE).run(
        Piece("s0", request, SLICE, lambda _: None) for _ in range(60)
    )

    assert seen[:30] == [8] * 30
    assert seen[30:38] == [8, 7, 6, 5, 4, 3, 2, 1]  # three of them lost
    assert seen[38] == 6  # halved three times, and opened by the five that came
    assert max(seen[38:]) == 8


def test_reader_gives_up_when_a_shard_stays_silent():
    """No answer for too long names the shard, and pauses grow meanwhile."""
    slot, body = cloud("a", 10 * SLICE)
    way = Way({slot: body})
    way.request_timeout_s = 0.05
    way.answer = lambda *_: None

    with pytest.raises(ShardUnreachableError, match="tcp/s0:1"):
        fetch_all(way, DatumCache(), LOCK, [reading(slot, len(body))])

    assert way.rests[:3] == [0.02, 0.04, 0.08]
    assert not way.under_way


def test_transfer_ends_once_its_lock_is_lost():
    """After a loss the lock is asked; when it is gone, nothing is asked any more."""
    slot, body = cloud("a", 10 * SLICE)
    way = Way({slot: body})
    answer = way.answer
    way.answer = lambda shard, fetch: None if fetch.offset == 4 * SLICE else answer(shard, fetch)

    def lost():
        raise LeaseLostError("gone", cause="test")

    with pytest.raises(LeaseLostError, match="gone"):
        fetch_all(way, DatumCache(), LOCK, [reading(slot, len(body))], lost)

    assert len(way.asked) == 10
    assert not way.under_way


@pytest.mark.parametrize(
    ("answer", "error", "match"),
    [
        (lambda f: Gone(f.slot, f.version), LeaseLostError, "kept for lock"),
        (lambda _: EpochChanged(2), LeaseLostError, "kept for lock"),
        (lambda _: Refused("overload", "too many"), EnactError, "too many"),
        (lambda f: Slice(f.slot, 2, b"", 0, 5000, f.offset, Datum(b"", bytes(1000), 1000)),
         ProtocolError, "a slice of 1000 bytes"),
        (lambda f: Slice(f.slot, 1, b"", 0, 5000, f.offset, Datum(b"", bytes(9), 9)),
         ProtocolError, "a slice of 9 bytes"),
        (lambda f: Slice(f.slot, 1, b"", 0, 5000, 0, Datum(b"", bytes(1000), 1000)),
         ProtocolError, "at 0 instead of 1000 at 2000"),
    ],
)  # fmt: skip
def test_answer_that_does_not_fit_ends_the_transfer_by_name(answer, error, match):
    """What is under way is abandoned, and nothing of the datum is shown or kept."""
    slot, body = cloud("a", 5 * SLICE)
    way, cache = Way({slot: body}), DatumCache()
    good = way.answer
    way.answer = lambda s, f: answer(f) if f.offset == 2 * SLICE else good(s, f)

    with pytest.raises(error, match=match):
        fetch_all(way, cache, LOCK, [reading(slot, len(body))])

    assert way.abandoned == 2
    assert not way.under_way
    assert cache.version(slot, "s0", 1) == 0


def test_many_data_of_two_shards_travel_through_one_window():
    """Slices of both shards alternate, so neither waits until the other has sent everything."""
    named = {Slot("w", f"a/{i}", "cloud"): random.Random(i).randbytes(2500) for i in range(8)}
    way, cache = Way(named), DatumCache()
    readings = [reading(slot, 2500, f"s{i % 2}") for i, slot in enumerate(named)]

    found = fetch_all(way, cache, LOCK, readings)
    again = fetch_all(way, cache, LOCK, readings)

    assert {slot: bytes(datum.body) for slot, datum in found.items()} == named
    assert [shard for shard, _ in way.asked] == ["s0", "s1"] * 12
    assert all(again[slot] is found[slot] for slot in named)


def test_what_the_cache_knows_is_not_asked():
    """Of a pattern only the data that have changed travel."""
    named = {Slot("w", f"a/{i}", "cloud"): bytes([i]) * 2500 for i in range(4)}
    way, cache = Way(named), DatumCache()
    slots = list(named)
    fetch_all(way, cache, LOCK, [reading(slot, 2500) for slot in slots])
    way.asked.clear()

    fetch_all(
        way, cache, LOCK, [reading(slot, 2500, version=1 + (slot is slots[2])) for slot in slots]
    )

    assert {fetch.slot for _, fetch in way.asked} == {slots[2]}


class Interrupted(deque):
    """A queue at whose edge Ctrl-C comes: after something was taken, or before it was added."""

    def popleft(self):
        super().popleft()
        raise KeyboardInterrupt


class InterruptedSooner(deque):
    """As `Interrupted`, when the third one is added."""

    def append(self, one):
        if len(self) == 2:
            raise KeyboardInterrupt
        super().append(one)


@pytest.mark.parametrize("queue", [Interrupted, InterruptedSooner])
def test_interrupt_between_two_steps_leaves_no_connection_open(queue, monkeypatch):
    """What neither waits nor stands in the queue when Ctrl-C comes is closed all the same."""
    line, far = SocketLine("s0", "x", b"", b"session tester"), []

    def connected():
        near, other = socket.socketpair()
        far.append(other)
        return Connection("s0", near)

    monkeypatch.setattr(line, "_connected", connected)
    way = Way()
    way.begin = lambda *_, **__: _Begun(line, line.take())
    moving = Transfer(way, lambda: None, window_bytes=4 * SLICE)
    moving._under_way = queue()
    try:
        with pytest.raises(KeyboardInterrupt):
            moving.run(Piece("s0", None, SLICE, lambda _: None) for _ in range(9))

        assert len(far) > 2
        for end in far:
            end.settimeout(5)
            assert end.recv(1) == b""
        assert len(line._open) == 0
    finally:
        for end in far:
            end.close()
