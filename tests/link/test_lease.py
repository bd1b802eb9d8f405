"""A shard whose lease has ended lets nothing out, and everything in order once it is renewed."""

import time

import pytest

from enact_dist.core.failover.lease import HolderRow, Standby
from enact_dist.core.protocol.messages import Committed, Granted, ListLocks, Locks, Refused
from enact_dist.core.protocol.records import Recovered
from enact_dist.core.shard.shard import Shard
from enact_dist.link import clock
from enact_dist.link import lease as lease_module
from enact_dist.link.clock import SystemClock
from enact_dist.link.daemon.embedded import EmbeddedCarrier
from enact_dist.link.host import ShardHost
from enact_dist.link.lease import HostLease, ShardTakenError


class Holding:
    """A lease that the test renews; a store that keeps all at once."""

    def __init__(self):
        self.now_s = 100.0
        self.lease = HostLease(2.0, lambda: self.now_s)
        self.lease.confirmed(self.now_s)
        self.holding = self
        self.failed = None
        self.copies = 1
        self.waits_s = 0.0
        self.ends = self.tired = False

    def on_failure(self, failed):
        self.failed = failed

    def on_move(self, moves):
        self.moves = moves

    def end_soon(self):
        self.ends = True

    def write(self, batch):
        pass

    def rest(self):
        pass

    def close(self):
        assert self.ends, (
            "the host calls end_soon before it closes a store that may wait for its database"
        )


@pytest.fixture
def holding():
    return Holding()


@pytest.fixture
def host(holding, make_settings):
    clock = SystemClock()
    settings = make_settings(durability="durable")
    now = {"now_ns": clock.monotonic_ns(), "wall_ns": clock.wall_ns()}
    host = ShardHost(Shard(settings, Recovered(epoch=7), **now), store=holding, clock=clock)
    yield host
    host.close()


def peer_of(host, make_peer):
    carrier = EmbeddedCarrier(host, "caller")
    peer = make_peer(
        lambda _, message: carrier.request("s0", message, timeout_s=30), durability="durable"
    )
    peer.hello()
    return peer


def test_a_lease_counts_from_when_a_write_was_sent():
    """Less the drift of two clocks; a late confirmation of an earlier write takes nothing back."""
    now_s = 10.0
    lease = HostLease(2.0, lambda: now_s)
    assert not lease.holds
    sent_s = lease.now_s()
    now_s = 11.5
    lease.confirmed(sent_s)
    now_s = 11.95
    assert lease.holds
    now_s = 11.97
    assert not lease.holds
    lease.confirmed(11.9)
    lease.confirmed(10.5)
    assert lease.lease.until_ns / 1e9 == pytest.approx(11.9 + 1.96)


def test_a_lease_counts_on_while_its_host_is_suspended(monkeypatch):
    """A host that wakes up after a minute is silent, though its monotonic clock has hardly moved."""
    boottime_s, monotonic_ns = 1000.0, 5 * 10**9
    monkeypatch.setattr(lease_module, "boottime_ns", lambda: int(boottime_s * 1e9))
    lease, standby = HostLease(2.0), Standby(2 * 10**9)
    row = HolderRow(epoch=7, batch=1, beat=1, holder="host 1")
    lease.confirmed(lease.now_s())
    assert not standby.is_free(row, monotonic_ns)
    assert lease.holds

    boottime_s += 60.0
    monotonic_ns += 10**6

    assert not lease.holds
    assert lease.left_s == pytest.approx(1.96 - 60.0)
    assert not standby.is_free(row, monotonic_ns)  # it has seen nothing of that minute
    assert clock.boottime_ns.args == (time.CLOCK_BOOTTIME,)


def test_nothing_leaves_a_shard_whose_lease_has_ended(host, holding, make_peer):
    """Neither an answer nor a notice; both come in order after a renewal."""
    peer = peer_of(host, make_peer)
    other = peer_of(host, make_peer)
    granted = peer.acquire("cup")
    assert isinstance(granted, Granted)
    told = []
    host.watch(lambda notice: told.append(type(notice).__name__))
    holding.now_s += 3.0

    host.submit(ListLocks(), lambda answer: told.append(type(answer).__name__))
    host.submit(other.acquire_message("pot"), lambda answer: told.append(type(answer).__name__))
    host.tick()
    assert told == []
    assert host.figures()["silences"] == 1

    holding.lease.confirmed(holding.now_s)
    host.tick()
    assert told == ["Locks", "Granted"]
    assert isinstance(peer.commit(granted, "cup", b"x"), Committed)


def test_a_shard_goes_on_writing_while_it_is_silent(host, holding, make_peer):
    """Else it would have nothing by which a database could confirm that it still holds the shard."""
    peer = peer_of(host, make_peer)
    written = []
    holding.write = written.extend
    granted = peer.acquire("cup")
    holding.now_s += 3.0
    told = []
    peer.call = lambda _, sent: host.submit(sent, told.append)
    peer.commit(granted, "cup", b"x")
    host._store_thread.close()
    assert written
    assert told == []


def test_a_host_whose_shard_was_taken_answers_nothing_more(host, holding):
    """What could still be asked of it is another daemon's."""
    holding.failed(ShardTakenError("taken"))
    told = []
    host.submit(ListLocks(), told.append)
    assert told == []
    assert isinstance(host.failure, ShardTakenError)


def test_data_too_large_for_a_database_are_refused_by_name(host, make_peer, monkeypatch):
    """Before anything is written; the shard goes on."""
    monkeypatch.setattr(lease_module, "DATABASE_BODY_BYTES_MAX", 1000)
    peer = peer_of(host, make_peer)

    refused = peer.write("cup", bytes(1001))

    assert isinstance(refused, Refused)
    assert refused.code == "no_room"
    assert "count" in refused.text
    assert "1001 bytes" in refused.text
    assert isinstance(peer.call("s0", ListLocks()), Locks)
    assert isinstance(peer.write("pot", bytes(1000)), Committed)
