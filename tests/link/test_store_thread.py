"""The store thread writes in order, shares commits, and reports what is kept and nothing else."""

import threading
from functools import partial

import pytest
from store_writer import outcome_record, persist, reopened, slot_record

from enact_dist.errors import StoreError
from enact_dist.link.store.store import open_store
from enact_dist.link.store.thread import REPORTED_MAX, StoreThread

WAIT_S = 20.0


class GatedStore:
    """A real store whose first write waits for a gate; counts batches."""

    def __init__(self, folder):
        self.store, _ = open_store(folder, unix_s=1)
        self.gate = threading.Event()
        self.entered = threading.Event()
        self.batches = []
        self.writers = []
        self.holding = None

    def write(self, batch):
        self.entered.set()
        assert self.gate.wait(WAIT_S)
        self.writers.append(threading.current_thread())
        self.store.write(batch)
        self.batches.append(len(batch))

    @property
    def tired(self):
        return self.store.tired

    def rest(self):
        self.store.rest()


@pytest.fixture
def gated(tmp_path):
    """A gated store in a folder of its own."""
    gated = GatedStore(tmp_path)
    yield gated
    gated.gate.set()
    gated.store.close()


def test_queued_batches_share_one_commit(gated, tmp_path):
    """500 submits behind a write that runs: two commits in all, every ticket once, in order."""
    kept = []
    thread = StoreThread(gated, kept.extend, pytest.fail)
    for version in range(1, 501):
        record = outcome_record(0, version)
        thread.submit(persist(slot_record(f"e{version % 7}", version), record, ticket=version))
        if version == 1:
            assert gated.entered.wait(WAIT_S)
    gated.gate.set()
    thread.close()
    assert kept == list(range(1, 501))
    assert gated.batches == [1, 499]
    gated.store.close()
    found = reopened(tmp_path)
    assert max(record.version for record in found.slots) == 500
    assert found.outcomes == [outcome_record(0, 500)]


def test_large_batch_is_reported_in_parts(gated):
    """A host takes its mutex for each part, so that requests come in between."""
    parts = []
    thread = StoreThread(gated, parts.append, pytest.fail)
    for ticket in range(1, 101):
        thread.submit(persist(slot_record("e", ticket), ticket=ticket))
        if ticket == 1:
            assert gated.entered.wait(WAIT_S)
    gated.gate.set()
    thread.close()
    assert gated.batches == [1, 99]
    assert [ticket for part in parts for ticket in part] == list(range(1, 101))
    assert max(map(len, parts)) == REPORTED_MAX


def test_ticket_zero_is_kept_and_not_reported(gated, tmp_path):
    """A `Persist` that wants no report is written like any other."""
    reports = []
    gated.gate.set()
    thread = StoreThread(gated, reports.append, pytest.fail)
    thread.submit(persist(slot_record("silent", 1), ticket=0))
    thread.close()
    assert reports == []
    gated.store.close()
    assert [record.slot.entity for record in reopened(tmp_path).slots] == ["silent"]


def test_close_writes_what_is_queued_and_takes_no_more(gated):
    """`close` drains, may come twice, and what is submitted later is never reported."""
    kept = []
    thread = StoreThread(gated, kept.extend, pytest.fail)
    for ticket in (1, 2, 3):
        thread.submit(persist(slot_record("a", ticket), ticket=ticket))
    gated.gate.set()
    thread.close()
    thread.submit(persist(slot_record("a", 4), ticket=4))
    thread.close()
    assert kept == [1, 2, 3]


def test_negative_tickets_are_reported(gated):
    """The shard numbers some of its records downwards from -1."""
    kept = []
    gated.gate.set()
    thread = StoreThread(gated, kept.extend, pytest.fail)
    thread.submit(persist(slot_record("a", 1), ticket=-1))
    thread.close()
    assert kept == [-1]


def test_failed_store_is_reported_once_and_acknowledges_nothing(gated):
    """After an error the batch, the queue and everything later stay unreported."""
    kept, failures = [], []
    thread = StoreThread(gated, kept.extend, failures.append)
    thread.submit(persist(slot_record("a", 1), ticket=1))
    assert gated.entered.wait(WAIT_S)
    thread.submit(persist(slot_record("a", 2), ticket=2))
    gated.store.close()
    gated.gate.set()
    thread.close()
    thread.submit(persist(slot_record("a", 3), ticket=3))
    assert kept == []
    (failure,) = failures
    assert isinstance(failure, StoreError)


def test_close_from_the_failure_callback_does_not_hang(gated):
    """A host that closes everything when its store fails is called from the thread itself."""
    ended = threading.Event()

    def end(_):
        thread.close()
        ended.set()

    thread = StoreThread(gated, pytest.fail, end)
    gated.store.close()
    gated.gate.set()
    thread.submit(persist(slot_record("a", 1), ticket=1))
    assert ended.wait(WAIT_S)
    thread.close()


def test_an_interrupt_in_a_write_fails_the_store(gated, monkeypatch):
    """It goes on to the thread that lent itself; nobody waits for records that are not stored."""

    def interrupted(_):
        raise KeyboardInterrupt

    failures = []
    monkeypatch.setattr(gated.store, "write", interrupted)
    gated.gate.set()
    thread = StoreThread(gated, pytest.fail, failures.append)
    with pytest.raises(KeyboardInterrupt):
        lent(thread, 1)
    assert [type(failure) for failure in failures] == [KeyboardInterrupt]
    thread.submit(persist(slot_record("a", 2), ticket=2))
    thread.close()


# ---------------------------------------------------------------- threads that lend themselves


def in_thread(act):
    """Run `act` in a thread, which is returned."""
    thread = threading.Thread(target=act)
    thread.start()
    return thread


def lent(thread, *tickets, size=200):
    """Submit records with these tickets, and write them in the calling thread if it is free."""
    for ticket in tickets:
        record = slot_record("a", ticket, size=size)
        thread.submit(persist(record, ticket=ticket), wake=False)
    thread.write_here()


def test_a_thread_that_lends_itself_writes_and_reports(gated):
    """Two records that one thread has left to itself are one batch, written by that thread."""
    kept = []
    gated.gate.set()
    thread = StoreThread(
        gated, lambda tickets: kept.append((threading.current_thread(), tickets)), pytest.fail
    )
    lender = in_thread(lambda: lent(thread, 1, 2))
    lender.join(WAIT_S)
    assert gated.writers == [lender]
    assert kept == [(lender, [1, 2])]
    thread.close()


def test_what_comes_while_a_thread_writes_is_written_by_the_store_thread(gated):
    """Neither the one that writes nor the one that comes meanwhile is kept for the next batch."""
    kept = []
    thread = StoreThread(gated, kept.extend, pytest.fail)
    first = in_thread(lambda: lent(thread, 1))
    assert gated.entered.wait(WAIT_S)
    second = in_thread(lambda: lent(thread, 2, 3))
    second.join(WAIT_S)
    assert not second.is_alive()
    gated.gate.set()
    first.join(WAIT_S)
    thread.close()
    assert kept == [1, 2, 3]
    assert gated.batches == [1, 2]
    assert gated.writers[0] is first
    assert gated.writers[1] not in {first, second}


def test_a_database_may_take_its_time(gated):
    """Its records are left to the store's thread."""
    kept = threading.Event()
    gated.gate.set()
    gated.holding = object()
    thread = StoreThread(gated, lambda _: kept.set(), pytest.fail)
    in_thread(lambda: lent(thread, 1)).join(WAIT_S)
    assert kept.wait(WAIT_S)
    assert [writer.name for writer in gated.writers] == ["enact-store"]
    thread.close()


def test_close_waits_for_a_thread_that_lends_itself(gated):
    """The store may be closed afterwards: no thread uses it any more."""
    kept = []
    thread = StoreThread(gated, kept.extend, pytest.fail)
    lender = in_thread(lambda: lent(thread, 1))
    assert gated.entered.wait(WAIT_S)
    closed = in_thread(lambda: (thread.close(), kept.append("closed")))
    thread._thread.join(WAIT_S)  # the store's own thread, which has nothing to write
    gated.gate.set()
    lender.join(WAIT_S)
    closed.join(WAIT_S)
    assert kept == [1, "closed"]


def test_a_store_that_fails_in_a_lent_thread_acknowledges_nothing(gated):
    """The failure is reported once, and `close` from there neither hangs nor writes."""
    failures = []

    def end(failure):
        failures.append(failure)
        thread.close()

    thread = StoreThread(gated, pytest.fail, end)
    gated.store.close()
    gated.gate.set()
    in_thread(lambda: lent(thread, 1)).join(WAIT_S)
    in_thread(lambda: lent(thread, 2)).join(WAIT_S)
    (failure,) = failures
    assert isinstance(failure, StoreError)


def test_the_store_thread_that_waited_for_a_lent_one_reports_no_second_failure(gated, until):
    """Once the store has failed, nobody tidies it up either."""
    failures = []
    thread = StoreThread(gated, pytest.fail, failures.append)
    lender = in_thread(lambda: lent(thread, 1))
    assert gated.entered.wait(WAIT_S)
    thread.submit(persist(slot_record("a", 2), ticket=2))
    until(lambda: not thread._wake._waiters)  # the store's thread waits for its turn
    gated.store.close()
    gated.gate.set()
    lender.join(WAIT_S)
    thread.close()
    (failure,) = failures
    assert isinstance(failure, StoreError)


def test_the_store_thread_tidies_up_after_a_lent_one(gated, tmp_path):
    """The answer does not wait for files to be unlinked, and they are."""
    gated.gate.set()
    rested = threading.Event()
    gated.rest = lambda: (gated.store.rest(), rested.set())
    thread = StoreThread(gated, lambda _: None, pytest.fail)
    for version in (1, 2):
        in_thread(partial(lent, thread, version, size=100_000)).join(WAIT_S)
    assert rested.wait(WAIT_S)
    assert len(list((tmp_path / "blobs").iterdir())) == 1
    thread.close()
