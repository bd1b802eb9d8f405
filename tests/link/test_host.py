"""The host: every thread's events in one order, effects done, time kept, failure final."""

import threading

import pytest

from enact_dist.core.protocol.messages import (
    AwaitStamp,
    Committed,
    Granted,
    ListLocks,
    ListSessions,
    Locks,
    Reached,
    Refused,
    Waiting,
)
from enact_dist.core.protocol.records import Recovered
from enact_dist.core.shard.shard import Shard
from enact_dist.errors import StoreError
from enact_dist.link.clock import SystemClock
from enact_dist.link.daemon.embedded import EmbeddedCarrier
from enact_dist.link.host import ShardHost
from enact_dist.link.opening import open_host


class ManualClock:
    """Time that the test sets."""

    def __init__(self):
        self.now_ns = 10**12

    def monotonic_ns(self):
        return self.now_ns

    def wall_ns(self):
        return self.now_ns


class FakeStore:
    """A store whose disk the test holds: writes wait for `may_write`, or fail."""

    holding = None
    tired = False

    def __init__(self, failure=None):
        self.may_write = threading.Event()
        self.begun = 0
        self.batches = []
        self.written = threading.Semaphore(0)
        self.failure = failure
        self.closed = False

    def write(self, batch):
        self.begun += 1
        assert self.may_write.wait(60)
        if self.failure is not None:
            raise self.failure
        self.batches.append(list(batch))
        self.written.release()

    def rest(self):
        pass

    def close(self):
        self.closed = True


@pytest.fixture
def start(make_settings):
    """Start hosts that are closed after the test."""
    hosts = []

    def start_host(store=None, *, clock=None, durability="volatile", on_failure=None):
        clock = clock or SystemClock()
        shard = Shard(
            make_settings(durability=durability),
            Recovered(epoch=7),
            now_ns=clock.monotonic_ns(),
            wall_ns=clock.wall_ns(),
        )
        host = ShardHost(shard, store=store, clock=clock, on_failure=on_failure)
        hosts.append(host)
        return host

    yield start_host
    for host in hosts:
        host.close()


def call_of(host, *, timeout_s=30.0):
    """Return a `call(shard, message)` that waits for the answer."""
    carrier = EmbeddedCarrier(host, "caller")
    return lambda shard, message: carrier.request(shard, message, timeout_s=timeout_s)


def test_host_answers_in_the_calling_thread_when_nothing_has_to_wait(start):
    """An answer that the shard has at once is there before `submit` returns."""
    host = start()
    threads = []

    host.submit(ListLocks(), lambda answer: threads.append((threading.get_ident(), type(answer))))

    assert threads == [(threading.get_ident(), Locks)]


def test_host_answers_a_parked_request_from_the_thread_that_ends_its_wait(start, make_peer):
    """A waiting writer gets its grant in the very call that releases the lock before it."""
    host = start()
    holder, waiter = make_peer(call_of(host)), make_peer(call_of(host))
    holder.hello()
    waiter.hello()
    granted = holder.acquire("cup")
    answers = []
    host.submit(waiter.acquire_message("cup", wait_s=5.0), answers.append)
    assert answers == []

    holder.commit(granted, "cup", b"x")

    assert [type(answer) for answer in answers] == [Granted]


@pytest.mark.parametrize("wait_s", [0.01, 0.2])
def test_host_ends_a_wait_by_itself_when_its_time_is_over(start, make_peer, wait_s):
    """A parked request is answered although no other message comes."""
    host = start()
    holder, waiter = make_peer(call_of(host)), make_peer(call_of(host))
    holder.hello()
    waiter.hello()
    holder.acquire("cup")

    answer = waiter.acquire("cup", wait_s=wait_s)

    assert isinstance(answer, Waiting)


def test_host_expires_a_lease_when_time_passes_without_a_sign_of_life(start, make_peer):
    """Ticks let a silent holder's lock go to the next one; nobody has to call."""
    clock = ManualClock()
    host = start(clock=clock)
    holder, waiter = make_peer(call_of(host)), make_peer(call_of(host))
    holder.hello(ttl_s=2.0)
    waiter.hello(ttl_s=60.0)
    holder.acquire("cup")

    before = waiter.acquire("cup")
    for _ in range(10):
        clock.now_ns += 250_000_000
        host.tick()
    after = waiter.acquire("cup")

    assert isinstance(before, Waiting)
    assert isinstance(after, Granted)


def test_host_takes_what_has_arrived_before_it_lets_time_pass(start, make_peer):
    """A request in an inbox is handled before the tick that would end what it renews."""
    clock = ManualClock()
    host = start(clock=clock)
    peer = make_peer(call_of(host))
    peer.hello()
    order = []
    inbox = [peer.acquire_message("cup")]

    def drain():
        while inbox:
            host.submit(inbox.pop(), lambda answer: order.append(type(answer)))

    host.add_inbox(drain)
    host.tick()

    assert order == [Granted]


def test_host_acknowledges_a_durable_commit_only_after_the_store(start, make_peer, until):
    """No answer leaves while the store still writes; it leaves when the store is done."""
    store = FakeStore()
    store.may_write.set()
    host = start(store, durability="durable")
    peer = make_peer(call_of(host), durability="durable")
    peer.hello()
    granted = peer.acquire("cup")
    store.may_write.clear()
    answered = threading.Event()
    answers = []
    commit, before = [], store.begun
    peer.call = lambda _, message: commit.append(message)
    peer.commit(granted, "cup", b"x")

    host.submit(commit[0], lambda answer: (answers.append(answer), answered.set()))
    until(lambda: store.begun > before)
    early = answered.is_set()
    store.may_write.set()

    assert not early
    assert answered.wait(30)
    assert isinstance(answers[0], Committed)


@pytest.mark.parametrize("answered", [True, False], ids=["answered", "parked"])
def test_a_lent_thread_leaves_nothing_in_the_queue(start, make_peer, monkeypatch, answered):
    """Records of a request that is answered at once are stored without the thread's help."""
    monkeypatch.setattr(ShardHost, "_tick_on", lambda _: None)  # the next tick would see them
    store = FakeStore()
    store.may_write.set()
    host = start(store, durability="durable")
    peer = make_peer(call_of(host), durability="durable")
    peer.hello()
    granted = peer.acquire("cup")
    peer.commit(granted, "cup", b"x")
    granted = peer.acquire("cup")
    while store.written.acquire(blocking=False):
        pass  # what was stored so far
    sent, answers = [], []
    peer.call = lambda _, message: sent.append(message)
    if answered:
        peer.goodbye()
    else:
        peer.commit(granted, "cup", b"y")

    def lend():
        if host.submit(sent[0], answers.append, lends=True):
            host.write_here()

    lender = threading.Thread(target=lend)
    lender.start()
    lender.join(30)

    assert len(answers) == 1
    assert store.written.acquire(timeout=30)


def test_only_a_request_with_records_of_its_own_lends_its_thread(start, make_peer):
    """Who waits for a lock does not wait for a disk that writes what others commit."""
    store = FakeStore()
    store.may_write.set()
    host = start(store, durability="durable")
    holder, waiter, keeper = (make_peer(call_of(host), durability="durable") for _ in range(3))
    for peer in (holder, waiter, keeper):
        peer.hello()
    cup, tray = keeper.acquire("cup"), holder.acquire("tray")
    sent, answers = [], []
    holder.call = lambda _, message: sent.append(message)
    holder.commit(tray, "tray", b"x")
    store.may_write.clear()

    left = [
        host.submit(message, answers.append, lends=True)
        for message in (sent[0], waiter.acquire_message("cup", wait_s=9.0), ListLocks())
    ]
    store.may_write.set()

    assert isinstance(cup, Granted)
    assert left == [True, False, False]
    assert [type(answer) for answer in answers] == [Locks]


def test_host_acknowledges_nothing_when_the_store_fails(start, make_peer):
    """A disk error ends the host: the commit stays without an answer, later requests too."""
    store = FakeStore()
    store.may_write.set()
    failed = threading.Event()
    host = start(store, durability="durable", on_failure=lambda _: failed.set())
    peer = make_peer(call_of(host), durability="durable")
    peer.hello()
    granted = peer.acquire("cup")
    peer.call = call_of(host, timeout_s=0.1)  # nothing will come
    store.failure = StoreError("no space left on /data", path="/data")

    answer = peer.commit(granted, "cup", b"x")

    assert failed.wait(30)
    assert answer is None
    assert host.failure is store.failure
    assert peer.call("s0", ListLocks()) is None


def test_host_publishes_notices_in_order_to_every_watcher_until_it_is_ended(start, make_peer):
    """Each watcher sees each commit once, in the order of their numbers."""
    host = start()
    peer = make_peer(call_of(host))
    peer.hello()
    first, second = [], []
    host.watch(first.append)
    unwatch = host.watch(second.append)

    for number in range(3):
        peer.write("cup", bytes([number]))
    unwatch()
    peer.write("cup", b"last")

    assert [notice.number for notice in first] == [1, 2, 3, 4]
    assert [notice.number for notice in second] == [1, 2, 3]


def test_host_answers_the_parked_and_grants_nothing_when_it_drains(start, make_peer):
    """A drain answers waiting locks and waiting readers; a free lock is not granted any more."""
    host = start()
    holder, waiter = make_peer(call_of(host)), make_peer(call_of(host))
    holder.hello()
    waiter.hello()
    granted = holder.acquire("cup")
    answers = []
    host.submit(waiter.acquire_message("cup", wait_s=50.0), answers.append)
    host.submit(AwaitStamp(2**62, 50_000_000_000, holder.session, holder.epoch), answers.append)

    host.drain()
    idle_at_first = host.wait_idle(0.0)
    ended = threading.Event()
    stopping = threading.Thread(target=lambda: host.wait_idle(10.0) and ended.set())
    stopping.start()
    holder.commit(granted, "cup", b"x")
    stopping.join()
    after = waiter.acquire("tray", wait_s=0.0)

    assert [type(answer) for answer in answers] == [Waiting, Reached]
    assert not idle_at_first
    assert ended.is_set()
    assert isinstance(after, Waiting)


def test_host_refuses_and_counts_when_too_many_requests_wait(start, make_peer, monkeypatch):
    """Parked requests are bounded; one too many is told so at once."""
    monkeypatch.setattr("enact_dist.link.host.PARKED_MAX", 2)
    host = start()
    peer, answers = make_peer(call_of(host)), []
    peer.hello()

    for _ in range(3):
        host.submit(AwaitStamp(2**62, 9_000_000_000, peer.session, peer.epoch), answers.append)

    assert [(type(answer), answer.code) for answer in answers] == [(Refused, "overload")]


def test_host_counts_for_list_sessions(start):
    """What a transport counts is shown among the shard's counters."""
    host = start()

    host.count("frames_refused", 2)
    sessions = call_of(host)("s0", ListSessions())

    assert ("frames_refused", 2) in sessions.counters


def test_host_without_a_folder_gets_a_new_epoch_with_every_start(make_settings):
    """Two starts within one second differ: a grant of the first is never believed in again."""
    hosts = [open_host(make_settings(), None)]
    first = hosts[0].epoch
    while SystemClock().wall_ns() // 1_000_000 <= first:
        pass  # a millisecond at most

    hosts.append(open_host(make_settings(), None))

    assert hosts[1].epoch > first
    for host in hosts:
        host.close()


def test_host_serves_many_threads_without_losing_an_update(start, make_peer):
    """4 threads x 50 increments through locks leave exactly 200."""
    host = start()

    def increment():
        peer = make_peer(call_of(host))
        peer.hello()
        for _ in range(50):
            while not isinstance(granted := peer.acquire("cup", wait_s=5.0), Granted):
                continue
            state = granted.states[0]
            found = int(bytes(state.datum.body)) if state.datum else 0
            assert isinstance(peer.commit(granted, "cup", b"%d" % (found + 1)), Committed)

    threads = [threading.Thread(target=increment) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    peer = make_peer(call_of(host))
    peer.hello()
    assert bytes(peer.acquire("cup").states[0].datum.body) == b"200"


def test_timer_that_fails_is_a_failure_of_the_shard(start):
    """Without it no lease would end: nobody is answered any more, and the daemon is told."""
    failures, told = [], threading.Event()
    host = start(on_failure=lambda failure: (failures.append(failure), told.set()))

    def drain():
        raise ValueError("an inbox that cannot be read")

    host.add_inbox(drain)

    assert told.wait(30)
    assert [str(failure) for failure in failures] == ["an inbox that cannot be read"]
    assert host.ended
