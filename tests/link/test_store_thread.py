"""The store thread writes in order, shares commits, and reports what is kept and nothing else."""

import threading

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

    def write(self, batch):
        self.entered.set()
        assert self.gate.wait(WAIT_S)
        self.store.write(batch)
        self.batches.append(len(batch))

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
