"""One test per cell of the failure table that applies to one writing shard, up to the commit.

Rows are the steps of a lock; columns are what goes wrong there: the client dies, the shard
restarts, a message is lost, a message comes twice or late, the lease ends.
"""

from __future__ import annotations

from math import inf

from failure_parts import ANN, BOB, READ, WRITE, seeded
from shard_bench import MS, TTL_NS, S, lock_id, slot

from enact_dist.core.protocol.messages import (
    Alive,
    Committed,
    EpochChanged,
    Fenced,
    Granted,
    Hello,
    Release,
    Stale,
    Waiting,
    Welcome,
)
from enact_dist.core.protocol.records import SessionSeen, Tick
from enact_dist.core.state.clock import BOUNDS_S


class TestHello:
    def test_dead_client_holds_up_the_next_start_for_one_ttl_only(self, bench):
        """Client dies: its record stays, so a restart waits one TTL for it, then goes on."""
        seeded(bench)
        bench.restart()
        bench.hello("bob", known_epoch=bench.shard.epoch)

        assert bench.acquire(BOB, WRITE) is None
        bench.wait(TTL_NS * 102 // 100, keep=["bob"])

        assert isinstance(bench.acquire(BOB, WRITE), Granted)

    def test_idle_session_is_forgotten_after_four_ttls(self, bench):
        """Client dies: its session is ended after 4 TTLs without a sign of life."""
        bench.hello("ann")
        bench.wait(TTL_NS * 4)
        assert "ann" in bench.shard.state.sessions.by_id
        bench.wait(TTL_NS * 2)

        assert "ann" not in bench.shard.state.sessions.by_id
        assert not bench.recovered(2).sessions

    def test_welcome_waits_until_the_session_is_durable(self, bench):
        """Shard restarts: a session that was welcomed is known after any crash."""
        bench.disk_is_done = False
        first = bench.send(Hello("ann", 0, TTL_NS, "", "", 0, False))
        again = bench.send(Hello("ann", 0, TTL_NS, "", "", 0, False))
        assert bench.answers.keys().isdisjoint((first, again))

        bench.finish_disk()

        assert isinstance(bench.answers[first], Welcome)
        assert isinstance(bench.answers[again], Welcome)
        assert [record.session for record in bench.recovered(2).sessions] == ["ann"]

    def test_lock_is_refused_while_the_session_is_not_durable(self, bench):
        """Shard restarts: no grant may rest on a session that a crash would forget."""
        bench.disk_is_done = False
        bench.send(Hello("ann", 0, TTL_NS, "", "", 0, False))

        assert isinstance(bench.acquire(ANN, WRITE), EpochChanged)

    def test_hello_of_an_old_epoch_does_not_acknowledge_the_new_one(self, bench):
        """Late: only the exact epoch says that older grants are dropped."""
        seeded(bench)
        old = bench.shard.epoch
        bench.restart()
        for known_epoch in (0, old):
            bench.hello("ann", "bob", "eve", known_epoch=known_epoch)

        assert bench.acquire(BOB, WRITE) is None
        assert bench.shard.state.sessions.in_grace(bench.now_ns)

    def test_grace_ends_early_when_all_have_acknowledged(self, bench):
        """Shard restarts with all clients alive: the first grant needs no waiting."""
        seeded(bench)
        bench.restart()
        bench.hello("ann", "bob", "eve", known_epoch=bench.shard.epoch)

        assert isinstance(bench.acquire(BOB, WRITE), Granted)


class TestAcquire:
    def test_waiter_of_a_dead_client_is_dropped(self, bench):
        """Client dies: its place in the queue goes with its lease, before it can be granted."""
        seeded(bench)
        bench.granted(ANN, WRITE)
        bench.acquire(BOB, WRITE)
        bench.acquire(lock_id("eve", 0, 1), WRITE)

        bench.wait(TTL_NS + 200 * MS, keep=["ann", "eve"])
        bench.ask(Release(ANN))

        assert bench.counter("waiters_dropped") == 1
        assert isinstance(bench.acquire(lock_id("eve", 0, 1), WRITE), Granted)

    def test_shard_in_a_new_epoch_asks_for_hello_first(self, bench):
        """Shard restarts: the queue is gone, and an old request is told the epoch."""
        seeded(bench)
        old = bench.shard.epoch
        bench.restart()

        assert bench.acquire(ANN, WRITE, epoch=old) == EpochChanged(bench.shard.epoch)

    def test_same_request_again_keeps_its_place(self, bench):
        """Lost or duplicated: the same lock finds its place in the queue again."""
        seeded(bench)
        bench.granted(ANN, WRITE)
        bench.acquire(BOB, WRITE)
        bench.acquire(lock_id("eve", 0, 1), WRITE)

        first = bench.send(bench.acquire_request(BOB, WRITE))
        second = bench.send(bench.acquire_request(BOB, WRITE))

        assert isinstance(bench.answers[first], Waiting)
        assert second not in bench.answers
        bench.ask(Release(ANN))
        assert isinstance(bench.answers[second], Granted)

    def test_seq_is_granted_once(self, bench):
        """Late: a request that was granted and given back is stale for ever."""
        seeded(bench)
        bench.granted(ANN, WRITE)
        bench.ask(Release(ANN))

        assert bench.acquire(ANN, WRITE) == Stale(ANN, bench.shard.epoch)

    def test_older_seq_of_a_lane_is_stale(self, bench):
        """Late: a request that its thread has left behind is not queued."""
        seeded(bench)
        bench.granted(lock_id("ann", 0, 5), WRITE)

        assert bench.acquire(lock_id("ann", 0, 4), WRITE) == Stale(
            lock_id("ann", 0, 4), bench.shard.epoch
        )

    def test_newer_seq_of_a_lane_ends_the_older_one(self, bench):
        """Lost release: a thread that asks for its next lock has given up the last one."""
        seeded(bench)
        bench.granted(ANN, WRITE)

        assert isinstance(bench.acquire(lock_id("ann", 0, 2), WRITE), Granted)
        assert bench.counter("superseded") == 1


class TestWaiting:
    def test_slice_of_waiting_ends_with_an_answer(self, bench):
        """Lost: no request is parked for longer than it asked, so the client can ask again."""
        seeded(bench)
        bench.granted(ANN, WRITE)
        parked = bench.send(bench.acquire_request(BOB, WRITE, wait_ns=300 * MS))

        bench.wait(400 * MS, keep=["ann", "bob"])

        answer = bench.answers[parked]
        assert isinstance(answer, Waiting)
        assert answer.place == 1
        assert [holder.lock for holder in answer.blockers] == [ANN]

    def test_wait_is_counted_from_the_first_request_to_the_grant(self, bench):
        """However often a waiter asks again; a lock that is free has waited for nothing."""
        bench.hello("ann", "bob", "cem")
        bench.granted(ANN, WRITE)
        bench.acquire(BOB, WRITE)
        bench.acquire(lock_id("cem"), WRITE)  # and is never granted
        bench.wait(1_500 * MS, keep=("ann", "bob", "cem"))
        bench.acquire(BOB, WRITE)
        bench.wait(500 * MS, keep=("ann", "bob", "cem"))
        waited = bench.shard.state.tenures.waited
        assert (sum(waited.counts), waited.sum_s) == (1, 0.0)

        bench.ask(Release(ANN))

        assert waited.sum_s == 2.0
        assert dict(zip((*BOUNDS_S, inf), waited.counts, strict=True)) == {
            **dict.fromkeys((*BOUNDS_S, inf), 0), BOUNDS_S[0]: 1, 2.5: 1
        }  # fmt: skip

    def test_waiter_whose_token_vanished_may_ask_again(self, bench):
        """Client cut off: its place is dropped, and the same lock may be asked for again."""
        seeded(bench)
        bench.granted(ANN, WRITE)
        bench.acquire(BOB, WRITE)

        bench.event(SessionSeen("bob", False))
        bench.ask(Release(ANN))

        assert isinstance(bench.acquire(BOB, WRITE), Granted)


class TestGranted:
    def test_orphan_grant_is_given_again(self, bench):
        """Lost: the same request gets the same grant, with its data."""
        seeded(bench)
        first = bench.granted(ANN, READ)

        again = bench.granted(ANN, READ)

        assert again.token == first.token
        assert again.states[0].datum == first.states[0].datum is not None

    def test_orphan_grant_is_freed_by_the_keep_alive(self, bench):
        """Lost: a client that gave up says what it still wants, and the rest is freed."""
        seeded(bench)
        bench.granted(ANN, WRITE)
        bench.keep_alive("ann", view={0: 2})

        assert bench.counter("orphans_freed") == 1
        assert isinstance(bench.acquire(BOB, WRITE), Granted)

    def test_late_keep_alive_frees_nothing_newer(self, bench):
        """Late: an old view names lower seqs than the thread has now."""
        seeded(bench)
        bench.granted(lock_id("ann", 0, 2), WRITE)
        answer = bench.keep_alive("ann", view={0: 1})

        assert isinstance(answer, Alive)
        assert [grant.lock for grant in answer.grants] == [lock_id("ann", 0, 2)]


class TestHolding:
    def test_dead_holder_is_freed_after_one_ttl(self, bench):
        """Client dies: its lock goes to the next one after a TTL, and not earlier."""
        seeded(bench)
        bench.granted(ANN, WRITE)
        parked = bench.send(bench.acquire_request(BOB, WRITE, wait_ns=900 * MS))
        bench.wait(TTL_NS - 100 * MS, keep=["bob"])
        assert isinstance(bench.answers.get(parked, None), Waiting | None)
        assert bench.acquire(BOB, WRITE) is None

        bench.wait(200 * MS, keep=["bob"])

        assert bench.counter("leases_expired") == 1
        assert isinstance(bench.acquire(BOB, WRITE), Granted)

    def test_lease_ends_exactly_with_its_ttl(self, bench):
        """Lease: at renewal + TTL it has ended; a nanosecond before it has not."""
        seeded(bench)
        bench.granted(ANN, WRITE)
        renewed_ns = bench.now_ns
        bench.wait(TTL_NS - 1)
        assert bench.counter("leases_expired") == 0

        bench.now_ns = renewed_ns + TTL_NS
        bench.event(Tick())

        assert bench.counter("leases_expired") == 1

    def test_lease_lives_on_its_liveliness_token(self, bench):
        """Keep-alives lost (a held interpreter lock): the token alone keeps the lease."""
        seeded(bench)
        bench.event(SessionSeen("ann", True))
        bench.granted(ANN, WRITE)
        bench.wait(10 * TTL_NS)
        assert bench.counter("leases_expired") == 0

        bench.event(SessionSeen("ann", False))
        bench.wait(TTL_NS // 2)

        assert bench.counter("leases_expired") == 1

    def test_keep_alive_renews_the_lease(self, bench):
        """Keep-alives arrive: the lock is held for as long as they do."""
        seeded(bench)
        bench.granted(ANN, WRITE)
        bench.wait(5 * TTL_NS, keep=["ann"])

        assert bench.counter("leases_expired") == 0

    def test_hold_limit_ends_a_lock_that_is_kept_alive(self, bench):
        """Hung holder: nobody holds longer than it asked for, alive or not."""
        seeded(bench)
        grant = bench.granted(ANN, WRITE, hold_ns=S)
        bench.wait(S + 100 * MS, keep=["ann"])

        answer = bench.commit(ANN, grant.token, (slot(), "2"))

        assert isinstance(answer, Fenced)
        assert "longer than its limit of 1 s" in answer.cause
        assert bench.value() == "1"

    def test_restart_ends_all_grants(self, bench):
        """Shard restarts: a grant of the old epoch commits nothing."""
        seeded(bench)
        grant = bench.granted(ANN, WRITE)
        bench.restart()
        bench.hello("ann", "bob", "eve", known_epoch=bench.shard.epoch)

        assert bench.commit(ANN, grant.token, (slot(), "2")) == EpochChanged(bench.shard.epoch)
        assert bench.value() == "1"

    def test_token_of_an_old_epoch_is_refused_though_its_number_returns(self, bench):
        """Shard restarts: the same grant number in a new epoch is another token."""
        seeded(bench)
        old = bench.granted(ANN, WRITE).token
        bench.restart()
        bench.hello("ann", "bob", "eve", known_epoch=bench.shard.epoch)
        new = bench.granted(lock_id("ann", 0, 1), WRITE).token
        while new.number < old.number:
            bench.ask(Release(lock_id("ann", 0, new.number)))
            new = bench.granted(lock_id("ann", 0, new.number + 1), WRITE).token

        assert (new.number, new > old) == (old.number, True)
        answer = bench.commit(lock_id("ann", 0, new.number), old, (slot(), "2"))
        assert isinstance(answer, EpochChanged)

    def test_stalled_shard_takes_no_lease_for_its_own_stall(self, bench):
        """Shard stood still for longer than the TTL: nobody pays for it."""
        seeded(bench)
        bench.granted(ANN, WRITE, hold_ns=3 * S)
        bench.now_ns += 3 * TTL_NS
        bench.event(Tick())

        assert bench.counter("stalls") == 1
        assert bench.counter("leases_expired") == bench.counter("held_too_long") == 0

    def test_resumed_zombie_is_fenced(self, bench):
        """Stopped holder: what it sends after another committed is refused; the value stands."""
        seeded(bench)
        grant = bench.granted(ANN, WRITE)
        bench.wait(3 * TTL_NS, keep=["bob"])
        other = bench.granted(BOB, WRITE)
        assert isinstance(bench.commit(BOB, other.token, (slot(), "2")), Committed)

        answer = bench.commit(ANN, grant.token, (slot(), "3"))

        assert isinstance(answer, Fenced)
        assert "lease" in answer.cause
        assert bench.value() == "2"

    def test_zombie_is_fenced_while_another_holds(self, bench):
        """The fence compares tokens: a lock of the same slot in other hands does not help."""
        seeded(bench)
        grant = bench.granted(ANN, WRITE)
        bench.wait(3 * TTL_NS, keep=["bob"])
        bench.hello("ann")
        bench.granted(BOB, WRITE)

        assert isinstance(bench.commit(ANN, grant.token, (slot(), "3")), Fenced)

    def test_forged_token_is_fenced(self, bench):
        """A live lock with another token is not this grant."""
        seeded(bench)
        grant = bench.granted(ANN, WRITE)

        answer = bench.commit(ANN, grant.token._replace(number=99), (slot(), "2"))

        assert isinstance(answer, Fenced)
        assert bench.value() == "1"
