"""Large data ahead of their commit, over a way that loses, repeats and reorders their slices."""

import itertools
import random
from types import SimpleNamespace

import pytest

from enact_dist.core.protocol.datum import Datum, Slot
from enact_dist.core.protocol.messages import EpochChanged, Refused, Stage, Staged, WriteItem
from enact_dist.errors import EnactError, LeaseLostError, NoRoomError, ShardUnreachableError
from enact_dist.link.client import transfer
from enact_dist.link.client.transfer import stage
from enact_dist.link.memory.names import FIRST_STAGED
from enact_dist.link.memory.payload_handler import GAPS_MAX, PayloadHandler

SLICE = 10_000
SESSION = "0123abcd"


class Way:
    """A client whose shards are payload handlers; `carry` may be replaced to spoil what travels."""

    def __init__(self, *shards, bytes_max=1 << 30):
        self.handlers = {shard: PayloadHandler(None, bytes_max) for shard in shards or ("s0",)}
        self.core = SimpleNamespace(session=SESSION)
        self.carrier = SimpleNamespace(
            inside=False,
            fetch_bytes=SLICE,
            endpoint_of=lambda shard: f"tcp/{shard}:1",
            reason_away=lambda _: "",
            request_all=lambda calls, **_: [self.handlers[s].stage(m) for s, m in calls],
        )
        self.request_timeout_s = 10.0
        self.staged_numbers = itertools.count(FIRST_STAGED)
        self.asked, self.counters, self.under_way = [], {}, 0

    def begin(self, shard, request, *, timeout_s):
        self.asked.append((shard, request))
        self.under_way += 1
        answers = []

        def wait(_into=None):
            self.under_way -= 1
            return answers[0] if answers else self.carry(shard, request)

        def abandon():
            self.under_way -= 1

        return SimpleNamespace(wait=wait, abandon=abandon)

    def carry(self, shard, request):
        return self.handlers[shard].stage(request)

    def rest(self, _pause_s):
        pass

    def count(self, name, amount=1):
        self.counters[name] = self.counters.get(name, 0) + amount

    def adopted(self, shard, write):
        """Return the bytes that a commit with this write would find."""
        found = self.handlers[shard]._adopted_by(without_body(write), SESSION)
        return bytes(found.datum.body)


def without_body(write):
    """Return a write as it comes over the wire."""
    datum = write.datum
    return write._replace(datum=Datum(datum.encoding, b"", datum.size, datum.stamp_ns, datum.file))


@pytest.fixture(autouse=True)
def little(monkeypatch):
    """Everything from 64 KiB on travels ahead."""
    monkeypatch.setattr(transfer, "UNSTAGED_BYTES_MAX", 64 << 10)


def write_of(name, size, seed=1):
    body = random.Random(seed).randbytes(size)
    return WriteItem(Slot("w", name, "cloud"), Datum(b"\x01", body, size, 7))


def test_writes_name_what_was_staged_and_keep_the_bytes():
    """What a shard adopts by the name are the bytes, small data beside them stay as they are."""
    way, large, small = Way(), write_of("a", 123_456), write_of("b", 10)

    named = stage(way, {"s0": [large, small]}, lambda: None)["s0"]

    assert named[0].datum.file.startswith(f"{SESSION}-")
    assert named[0].datum.body == large.datum.body  # in case the shard loses it
    assert (named[0].datum.encoding, named[0].datum.stamp_ns) == (b"\x01", 7)
    assert named[1] is small
    assert way.adopted("s0", named[0]) == large.datum.body


def test_small_writes_and_those_that_nothing_carries_stay_with_their_commit():
    """One slice's worth is not staged, nor anything where the shard lives in this process."""
    way, writes = Way(), {"s0": [write_of("a", 40_000), write_of("b", 20_000)]}
    assert stage(way, writes, lambda: None) == writes
    way.carrier.inside = True
    large = {"s0": [write_of("a", 400_000)]}
    assert stage(way, large, lambda: None) == large
    assert not way.asked


@pytest.mark.parametrize("seed", range(8))
def test_slices_that_are_lost_doubled_late_or_out_of_order_make_the_same_bytes(seed):
    """Requests and answers get lost, copies come later, also after their draft was adopted."""
    way, draw = Way("s0", "s1"), random.Random(seed)
    writes = {
        shard: [write_of(f"{shard}/{i}", 90_000 + 7_777 * i, seed=i) for i in range(3)]
        for shard in way.handlers
    }
    late = []
    carry = way.carry

    def spoil(shard, request):
        kind = draw.random()
        if kind < 0.15:
            return None  # lost on its way there
        if kind < 0.3:
            carry(shard, request)
            return None  # its answer lost
        if kind < 0.5:
            late.append((shard, request))
        if late and kind > 0.8:
            carry(*late[draw.randrange(len(late))])
        return carry(shard, request)

    way.carry = spoil
    named = stage(way, writes, lambda: None)

    found = {s: [way.adopted(s, write) for write in each] for s, each in named.items()}
    for shard, request in late:
        assert isinstance(carry(shard, request), Staged)
    assert found == {s: [w.datum.body for w in each] for s, each in writes.items()}
    assert way.counters["slices_repeated"] == len(way.asked) - len(
        {(shard, message.file, message.offset) for shard, message in way.asked}
    )


def test_slices_of_two_shards_alternate():
    """Neither shard of a commit waits until the other has had everything."""
    way = Way("s0", "s1")
    stage(way, {"s0": [write_of("a", 100_000)], "s1": [write_of("b", 100_000)]}, lambda: None)
    assert [shard for shard, _ in way.asked] == ["s0", "s1"] * 10


def test_shard_without_room_refuses_by_name_and_forgets_what_came():
    """Over the cap the error names it, and the drafts of this commit are gone at both shards."""
    way = Way("s0", "s1")
    way.handlers["s1"] = PayloadHandler(None, 150_000)
    writes = {"s0": [write_of("a", 100_000)], "s1": [write_of("b", 200_000)]}

    with pytest.raises(NoRoomError, match="of at most 150000"):
        stage(way, writes, lambda: None)

    assert [handler.figures()["payload_drafts"] for handler in way.handlers.values()] == [0, 0]
    assert way.under_way == 0


def test_restart_of_a_shard_ends_the_transfer_by_name():
    """A new start of the shard knows no session: the lock is lost, the error says so."""
    way = Way()
    carry, seen = way.carry, []

    def restart(shard, request):
        seen.append(request)
        return carry(shard, request) if len(seen) < 5 else EpochChanged(2)

    way.carry = restart
    with pytest.raises(LeaseLostError, match="s0 has restarted") as caught:
        stage(way, {"s0": [write_of("a", 300_000)]}, lambda: None)
    assert caught.value.cause == "its shard restarted"
    assert way.under_way == 0


def test_lock_that_is_lost_ends_the_transfer_after_a_loss():
    """Nobody sends 100 MB for a lock that is gone; what has come is given up."""
    way = Way()
    carry = way.carry
    way.carry = lambda s, m: carry(s, m) if m.offset < 50_000 else None

    def lost():
        raise LeaseLostError("gone", cause="test")

    with pytest.raises(LeaseLostError, match="gone"):
        stage(way, {"s0": [write_of("a", 300_000)]}, lost)
    assert way.handlers["s0"].figures()["payload_drafts"] == 0


def test_silent_shard_is_named():
    """No answer for too long is an error with the shard's endpoint."""
    way = Way()
    way.request_timeout_s = 0.0
    way.carry = lambda *_: None
    with pytest.raises(ShardUnreachableError, match="tcp/s0:1"):
        stage(way, {"s0": [write_of("a", 100_000)]}, lambda: None)


@pytest.mark.parametrize("answer", [Refused("protocol", "nonsense"), Staged("other-1", 5, False)])
def test_answer_that_does_not_fit_is_an_error(answer):
    """Neither a refusal nor the answer to something else passes for a slice that has come."""
    way = Way()
    way.carry = lambda *_: answer
    with pytest.raises(EnactError, match=r"nonsense|answered with a Staged"):
        stage(way, {"s0": [write_of("a", 100_000)]}, lambda: None)


def slice_of(offset, part, total=200_000, file=f"{SESSION}-1"):
    return Stage(SESSION, file, offset, total, Datum(b"", part, len(part)))


def test_handler_says_how_much_has_come_without_a_hole():
    """`have` is where the first hole begins; a draft with a hole is not adopted."""
    handler = PayloadHandler(None, 1 << 30)
    piece = bytes(range(100)) * 500
    have = [handler.stage(slice_of(at, piece)).have for at in (50_000, 150_000, 0, 0, 100_000)]

    assert have == [0, 0, 100_000, 100_000, 200_000]


def test_handler_adopts_no_draft_with_a_hole():
    """A commit that names it is told that the bytes are not there."""
    handler = PayloadHandler(None, 1 << 30)
    handler.stage(slice_of(0, bytes(50_000)))
    handler.stage(slice_of(100_000, bytes(100_000)))
    write = WriteItem(Slot("w", "a", "b"), Datum(b"", b"", 200_000, 0, f"{SESSION}-1"))

    assert handler._adopted_by(write, SESSION) is write


def test_handler_keeps_no_endless_list_of_holes():
    """A client that leaves a hole before each slice is refused, and the memory of it is bounded."""
    handler = PayloadHandler(None, 1 << 30)
    answers = [handler.stage(slice_of(2 * at + 1, b"x")) for at in range(GAPS_MAX + 1)]

    assert isinstance(answers[-2], Staged)
    assert isinstance(answers[-1], Refused)
