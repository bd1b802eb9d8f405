"""Who sends: small answers here and now, anything beyond from the client's own thread."""

import threading
from collections import Counter

import pytest

from enact_dist.core.protocol.messages import Registered
from enact_dist.link.answers import size_of
from enact_dist.link.zenoh import fairness as module
from enact_dist.link.zenoh.fairness import (
    OUTSTANDING_BYTES_MAX,
    QUEUED_ANSWERS_MAX,
    Senders,
)


class FakeParcel:
    """An answer that notes who sent it, and that the test may hold up."""

    def __init__(self, size=0, gate=None):
        self.size = size
        self.gate = gate
        self.thread = None
        self.begun = threading.Event()
        self.done = threading.Event()
        self.dropped = False

    def send(self):
        self.thread = threading.get_ident()
        self.begun.set()
        if self.gate is not None:
            assert self.gate.wait(60)
        self.done.set()

    def drop(self):
        self.dropped = True
        self.done.set()


@pytest.fixture
def counts():
    return Counter()


@pytest.fixture
def senders(counts):
    made = Senders(lambda name, amount: counts.update({name: amount}))
    yield made
    made.close()


def test_senders_send_in_the_calling_thread_while_little_is_outstanding(senders):
    """A small answer wakes no other thread."""
    parcel = FakeParcel(100)

    senders.send("a", parcel)

    assert parcel.thread == threading.get_ident()


def test_senders_leave_a_large_answer_to_a_thread_of_the_client(senders):
    """An answer of 64 KiB is sent elsewhere, and the caller does not wait for it."""
    gate = threading.Event()
    large = FakeParcel(OUTSTANDING_BYTES_MAX, gate)

    senders.send("a", large)
    assert large.begun.wait(30)
    gate.set()

    assert large.done.wait(30)
    assert large.thread != threading.get_ident()


def test_senders_keep_others_free_when_one_client_does_not_read(senders):
    """While one client's answer is stuck, the answers of another leave at once."""
    gate = threading.Event()
    senders.send("stuck", FakeParcel(OUTSTANDING_BYTES_MAX, gate))
    other = FakeParcel(100)

    senders.send("other", other)

    assert other.thread == threading.get_ident()
    gate.set()


def test_senders_keep_the_order_of_one_client_while_its_sender_works(senders):
    """A small answer after a stuck large one waits behind it."""
    gate = threading.Event()
    large, small = FakeParcel(OUTSTANDING_BYTES_MAX, gate), FakeParcel(10)
    senders.send("a", large)
    assert large.begun.wait(30)
    senders.new_burst()
    senders.heard("a")

    senders.send("a", small)
    early = small.begun.is_set()
    gate.set()

    assert not early
    assert small.done.wait(30)
    assert small.thread == large.thread


def test_senders_count_small_answers_together_until_the_client_is_heard_again(senders):
    """Many small answers to requests of one burst end up with the client's own sender."""
    size = OUTSTANDING_BYTES_MAX // 4
    burst = [FakeParcel(size) for _ in range(4)]

    for parcel in burst:
        senders.heard("a")
        senders.send("a", parcel)
    assert all(parcel.done.wait(30) for parcel in burst)
    senders.new_burst()
    senders.heard("a")
    later = FakeParcel(size)
    senders.send("a", later)
    assert later.done.wait(30)

    here = threading.get_ident()
    assert [parcel.thread == here for parcel in burst] == [True, True, True, False]


def test_senders_take_a_request_that_has_waited_for_no_proof_of_what_was_sent_since(senders):
    """A request of an earlier burst than the last one heard proves nothing of what came after."""
    size = OUTSTANDING_BYTES_MAX // 2
    came, _ = senders.burst, senders.send("a", FakeParcel(1))
    senders.new_burst()
    senders.heard("a", senders.burst)
    senders.send("a", FakeParcel(size))
    late, early = FakeParcel(size), FakeParcel(size)

    senders.heard("a", came)
    senders.send("a", late)
    assert late.done.wait(30)
    senders.new_burst()
    senders.heard("a", senders.burst)
    senders.send("a", early)
    assert early.done.wait(30)

    assert late.thread != threading.get_ident()


def test_answers_with_a_long_catalogue_are_left_to_the_senders():
    """A client that does not read its welcome must not keep the dispatcher waiting."""
    names = tuple(f"world{index}" for index in range(4096))

    assert size_of(Registered(names, (), 0)) > OUTSTANDING_BYTES_MAX


def test_senders_drop_and_count_what_is_too_much_for_one_client(senders, counts):
    """Beyond its queue a client's answers are dropped, by name; nothing else is."""
    gate = threading.Event()
    first = FakeParcel(OUTSTANDING_BYTES_MAX, gate)
    senders.send("a", first)
    assert first.begun.wait(30)

    parcels = [FakeParcel(OUTSTANDING_BYTES_MAX) for _ in range(QUEUED_ANSWERS_MAX + 5)]
    for parcel in parcels:
        senders.send("a", parcel)
    dropped = sum(parcel.dropped for parcel in parcels)
    gate.set()

    assert dropped == 5
    assert counts == {"answers_dropped": 5}
    assert all(parcel.done.wait(30) for parcel in parcels)


def test_senders_let_an_idle_thread_go_and_start_another_when_needed(senders, monkeypatch):
    """A client that fetched once costs no thread afterwards, and is served again."""
    monkeypatch.setattr(module, "IDLE_S", 0.01)
    before = set(threading.enumerate())
    first = FakeParcel(OUTSTANDING_BYTES_MAX)
    senders.send("a", first)
    assert first.done.wait(30)
    for thread in set(threading.enumerate()) - before:
        thread.join(30)

    second = FakeParcel(OUTSTANDING_BYTES_MAX)
    senders.send("a", second)

    assert second.done.wait(30)
    assert second.thread != threading.get_ident()


def test_senders_drop_what_waits_when_they_are_closed(senders):
    """After `close` nothing is sent by threads; answers in the queue are given up."""
    gate = threading.Event()
    stuck, waiting = (FakeParcel(OUTSTANDING_BYTES_MAX, gate) for _ in range(2))
    senders.send("a", stuck)
    assert stuck.begun.wait(30)
    senders.send("a", waiting)

    senders.close()
    after = FakeParcel(OUTSTANDING_BYTES_MAX)
    senders.send("b", after)
    gate.set()

    assert waiting.dropped
    assert after.dropped


def test_senders_drop_a_large_answer_where_no_thread_can_be_started(senders, counts, monkeypatch):
    """At the system's limit of threads one answer is lost and counted; the shard lives."""

    def refused(_):
        raise RuntimeError("can't start new thread")

    large, small = FakeParcel(OUTSTANDING_BYTES_MAX), FakeParcel(100)
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", refused)
        senders.send("a", large)
    senders.send("b", small)
    later = FakeParcel(OUTSTANDING_BYTES_MAX)
    senders.send("a", later)

    assert large.dropped
    assert counts["answers_dropped"] == 1
    assert small.thread == threading.get_ident()
    assert later.done.wait(30)
    assert not later.dropped
    assert senders._senders == 1


def test_sender_goes_on_after_an_answer_that_cannot_be_sent(senders):
    """Whatever is wrong with it: the client's later answers leave all the same."""

    class Broken(FakeParcel):
        def send(self):
            super().send()
            raise ValueError("cannot be encoded")

    gate = threading.Event()
    senders.send("a", Broken(OUTSTANDING_BYTES_MAX, gate))
    later = FakeParcel(100)
    senders.send("a", later)
    gate.set()

    assert later.done.wait(30)
    assert not later.dropped
