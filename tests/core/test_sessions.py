"""Sessions: durable before they matter, renewed by what is counted, ended once."""

from __future__ import annotations

from dataclasses import replace

from shard_bench import MS, TTL_NS, S, item, lock_id, slot

from enact_dist.core.client.lease_clock import shortened_ns
from enact_dist.core.protocol.datum import Datum
from enact_dist.core.protocol.messages import (
    Alive,
    AspectEntry,
    AwaitStamp,
    Break,
    Broken,
    Commit,
    Committed,
    EpochChanged,
    Fenced,
    Fetch,
    Gone,
    Goodbye,
    Granted,
    Hello,
    ListLocks,
    ListSessions,
    Reached,
    Refused,
    Register,
    Registered,
    Slice,
    Survey,
    TakeView,
    Viewed,
    Waiting,
    Welcome,
    WriteItem,
    WrongShard,
)
from enact_dist.core.protocol.records import (
    Drain,
    SessionDied,
    SessionEnded,
    SessionSeen,
    Tick,
    WorldRecord,
)
from enact_dist.terms import Access

R, W, V = Access.READ, Access.WRITE, Access.VIEW
ANN, BOB = lock_id("ann"), lock_id("bob")
LARGE = Datum(b"t", b"x" * (64 * 1024 + 1), 64 * 1024 + 1)


def view_request(bench, lock, *items):
    """Return the request for a view without a lock."""
    counter = bench.next_count(lock.session)
    return TakeView(lock, bench.shard.epoch, 1, counter, items, 0)


class TestRenewal:
    def test_everything_that_is_counted_renews(self, bench):
        """A client believes from the newest counter that arrived; the lease must last as long."""
        bench.hello("ann")
        bench.write("ann", 1, "1")
        grant = bench.granted(ANN, item(W))
        bench.wait(TTL_NS // 2)
        bench.ask(view_request(bench, lock_id("ann", 1, 1), item(V)))
        bench.wait(shortened_ns(TTL_NS))

        assert bench.counter("leases_expired") == 0
        assert isinstance(bench.commit(ANN, grant.token, (slot(), "2")), Committed)

    def test_token_that_came_before_its_session_counts(self, bench):
        """A liveliness token may be seen before the first hello."""
        bench.event(SessionSeen("ann", True))
        bench.hello("ann")
        bench.granted(ANN, item(W))
        bench.wait(3 * TTL_NS)

        assert bench.counter("leases_expired") == 0

    def test_keep_alive_of_a_forgotten_session_is_told_the_epoch(self, bench):
        """A session that was forgotten must say hello again, and has no locks."""
        bench.hello("ann")
        bench.wait(6 * TTL_NS)

        assert bench.keep_alive("ann") == EpochChanged(bench.shard.epoch)

    def test_alive_lists_grants_and_what_is_left_of_them(self, bench):
        """The client compares this list with its own."""
        bench.hello("ann")
        grant = bench.granted(ANN, item(W), hold_ns=10 * S)
        bench.wait(S)
        answer = bench.keep_alive("ann")

        assert isinstance(answer, Alive)
        assert [(left.lock, left.token) for left in answer.grants] == [(ANN, grant.token)]
        assert answer.grants[0].hold_left_ns == 9 * S


class TestEnd:
    def test_goodbye_frees_everything_and_is_remembered(self, bench):
        """A session that left is not waited for after a restart."""
        bench.hello("ann", "bob")
        bench.granted(ANN, item(W))
        bench.ask(Goodbye("ann"))

        assert isinstance(bench.acquire(BOB, item(W)), Granted)
        assert [record.session for record in bench.recovered(2).sessions] == ["bob"]

    def test_proven_death_frees_everything_at_once_and_is_remembered(self, bench):
        """Whose process is gone believes in nothing: nobody waits for its lease."""
        bench.hello("ann", "bob")
        grant = bench.granted(ANN, item(W))
        waiting = bench.send(bench.acquire_request(BOB, item(W)))
        bench.event(SessionDied("ann"))

        assert isinstance(bench.answers[waiting], Granted)
        assert isinstance(bench.commit(ANN, grant.token, (slot(), "2")), EpochChanged)
        assert bench.counter("sessions_died") == 1
        assert [record.session for record in bench.recovered(2).sessions] == ["bob"]

    def test_log_names_whose_process_ended_and_what_it_had_locked(self, bench):
        """Ids of sessions and locks tell nobody which actor it was."""
        bench.hello("ann")
        bench.granted(ANN, item(W))
        bench.event(SessionDied("ann"))

        died, taken = bench.stories
        assert died.text.startswith("the process of ann@host pid 1 ended")
        assert taken.text.startswith(f"{ANN} of ann@host pid 1, ")
        assert f"{slot()} (write)" in taken.text

    def test_proven_death_ends_the_grace_that_waits_for_it(self, bench):
        """After a restart nobody waits for a dead process to acknowledge the epoch."""
        bench.hello("ann")
        bench.restart()
        bench.event(SessionDied("ann"))
        bench.hello("bob", known_epoch=bench.shard.epoch)

        assert isinstance(bench.acquire(BOB, item(W)), Granted)

    def test_proven_death_of_a_stranger_changes_nothing(self, bench):
        """A session that said goodbye before its process ended is not ended twice."""
        bench.hello("ann")
        bench.ask(Goodbye("ann"))
        log = list(bench.log)
        bench.event(SessionDied("ann"))

        assert bench.log == log
        assert bench.counter("sessions_died") == 0

    def test_goodbye_before_the_session_is_durable_is_remembered(self, bench):
        """The end follows the beginning into the log, however quick."""
        bench.disk_is_done = False
        bench.send(Hello("ann", 0, TTL_NS, "", "", 0, False))
        bench.ask(Goodbye("ann"))
        bench.finish_disk()

        assert isinstance(bench.log[-1], SessionEnded)
        assert not bench.recovered(2).sessions

    def test_observer_gets_no_record_and_no_lock(self, bench):
        """Who only looks holds nobody up after a restart, and cannot lock."""
        answer = bench.ask(Hello("eve", 0, TTL_NS, "", "", 0, True))

        assert isinstance(answer, Welcome)
        assert not bench.recovered(2).sessions
        assert isinstance(bench.acquire(lock_id("eve"), item(W)), Refused)


class TestCatalogue:
    def test_registration_is_answered_when_it_is_durable(self, bench):
        """What one client was told to exist exists after a crash (simulation seed 3303)."""
        bench.hello("ann")
        bench.disk_is_done = False
        request = Register("ann", ("lab",), (AspectEntry("new", "int", "os"),))
        first, again = bench.send(request), bench.send(request)
        hello = bench.send(Hello("bob", 0, TTL_NS, "", "", 0, True))
        assert bench.answers.keys().isdisjoint((first, again, hello))

        bench.finish_disk()

        assert isinstance(bench.answers[first], Registered)
        assert bench.answers[again] == bench.answers[first]
        assert "lab" in bench.answers[hello].worlds
        assert WorldRecord("lab") in bench.recovered(2).worlds

    def test_refused_registration_leaves_nothing(self, bench):
        """All or none: a type that differs takes the new aspects beside it down."""
        bench.hello("ann")
        wrong = (AspectEntry("new", "int", "os"), AspectEntry("count", "float", "durable"))
        answer = bench.ask(Register("ann", (), wrong))

        assert isinstance(answer, Refused)
        assert "registered with datum type int" in answer.text
        assert "new" not in bench.shard.state.catalogue.aspects

    def test_same_registration_again_is_fine(self, bench):
        """Registering is idempotent; unsaid durability takes what is there."""
        bench.hello("ann")
        answer = bench.ask(Register("ann", ("online",), (AspectEntry("note", "int", ""),)))

        assert isinstance(answer, Registered)
        assert {entry.name: entry.durability for entry in answer.aspects}["note"] == "os"

    def test_world_with_a_wrong_name_is_refused(self, bench):
        """Names are checked where they are made."""
        bench.hello("ann")
        assert isinstance(bench.ask(Register("ann", ("a/b",), ())), Refused)

    def test_request_placed_by_another_map_is_sent_back(self, bench):
        """A client with an older map gets the newer one."""
        bench.hello("ann")
        request = replace(bench.acquire_request(ANN, item(W)), map_version=9)

        assert bench.ask(request) == WrongShard(bench.settings.placement)


class TestData:
    def put_large(self, bench, seq):
        """Write a datum that does not travel with the grant."""
        lock = lock_id("eve", 0, seq)
        grant = bench.granted(lock, item(W))
        body = Datum(b"t", bytes([seq]) * LARGE.size, LARGE.size)
        bench.ask(Commit(lock, grant.token, (WriteItem(slot(), body),), 0))

    def test_large_datum_is_fetched_in_parts(self, bench):
        """A grant names what is large; its parts add up to the whole."""
        bench.hello("ann", "eve")
        self.put_large(bench, 1)
        (state,) = bench.granted(ANN, item(R)).states
        assert (state.large, state.size) == (True, LARGE.size)

        parts = [
            bench.ask(Fetch(ANN, bench.shard.epoch, slot(), 1, offset, 40_000))
            for offset in (0, 40_000)
        ]

        assert all(isinstance(part, Slice) for part in parts)
        assert b"".join(bytes(part.body.body) for part in parts) == b"\1" * LARGE.size

    def test_viewed_datum_stays_fetchable_after_it_moved_on(self, bench):
        """A view shows one moment, also when its data are fetched later."""
        bench.hello("ann", "eve")
        self.put_large(bench, 1)
        bench.granted(ANN, item(W, "other"), item(V))
        self.put_large(bench, 2)

        assert isinstance(bench.ask(Fetch(ANN, bench.shard.epoch, slot(), 1, 0, 10)), Slice)

    def test_viewed_datum_stays_fetchable_when_the_grant_is_given_again(self, bench):
        """A duplicated request must not take away what the first answer named."""
        bench.hello("ann", "eve")
        self.put_large(bench, 1)
        bench.granted(ANN, item(W, "other"), item(V))
        self.put_large(bench, 2)
        bench.granted(ANN, item(W, "other"), item(V))

        assert isinstance(bench.ask(Fetch(ANN, bench.shard.epoch, slot(), 1, 0, 10)), Slice)

    def test_view_without_a_lock_is_pinned_until_its_release(self, bench):
        """The pins of a view go with its id."""
        bench.hello("ann", "eve")
        self.put_large(bench, 1)
        answer = bench.ask(view_request(bench, ANN, item(V)))
        assert isinstance(answer, Viewed)
        self.put_large(bench, 2)
        fetch = Fetch(ANN, bench.shard.epoch, slot(), 1, 0, 10)
        assert isinstance(bench.ask(fetch), Slice)

        bench.keep_alive("ann", view={0: 2})

        assert bench.ask(fetch) == Gone(slot(), 1)

    def test_known_version_is_not_sent_again(self, bench):
        """An unchanged datum travels once."""
        bench.hello("ann", "eve")
        bench.write("eve", 1, "1")
        (state,) = bench.granted(ANN, item(R, known=1)).states

        assert (state.same, state.datum) == (True, None)


class TestPeople:
    def test_locks_tell_who_holds_and_who_waits_for_whom(self, bench):
        """`lock ls` shows holder, mode, and the numbers that a waiter waits for."""
        bench.hello("ann", "bob")
        bench.granted(ANN, item(R))
        bench.acquire(BOB, item(W))
        holders = bench.ask(ListLocks()).holders

        assert [(h.actor, h.granted, h.modes) for h in holders] == [
            ("ann", True, "read"),
            ("bob", False, "write"),
        ]
        assert holders[1].waits_for == (holders[0].number,)

    def test_broken_lock_is_lost_and_audited(self, bench):
        """An operator may take a lock away; its holder is told who and why."""
        bench.hello("ann")
        grant = bench.granted(ANN, item(W))
        (holder,) = bench.ask(ListLocks()).holders
        answer = bench.ask(Break(holder.number, "stuck"))

        assert isinstance(answer, Broken)
        assert answer.found
        fenced = bench.commit(ANN, grant.token, (slot(), "2"))
        assert isinstance(fenced, Fenced)
        assert "stuck" in fenced.cause
        assert bench.ask(Break(holder.number, "again")) == Broken(False, None)

    def test_survey_lists_slots_without_data(self, bench):
        """Looking around moves no data."""
        bench.hello("ann")
        bench.write("ann", 1, "1", to=slot("tray/1"))
        bench.write("ann", 2, "1", to=slot("bench", "note"))

        answer = bench.ask(Survey((), ("tray/*",), ()))

        assert [(state.slot, state.datum, state.size) for state in answer.states] == [
            (slot("tray/1"), None, 1)
        ]

    def test_sessions_tell_what_the_shard_knows(self, bench):
        """`shard ls` shows epoch, sessions, catalogue and counters."""
        bench.hello("ann")
        answer = bench.ask(ListSessions())

        assert (answer.epoch, answer.open, answer.slots) == (1, True, 0)
        assert [info.session for info in answer.sessions] == ["ann"]

    def test_sessions_tell_for_how_long_a_lease_has_been_over(self, bench):
        """A frozen actor is not to be taken for one whose lease ends just now."""
        bench.hello("ann")
        bench.wait(TTL_NS // 4)
        bench.keep_alive("ann")
        bench.wait(3 * TTL_NS)

        (ann,) = bench.ask(ListSessions()).sessions

        assert ann.lease_left_ns == -2 * TTL_NS


class TestWaitingForStamps:
    def test_stamp_is_reached_when_no_older_commit_is_in_flight(self, bench):
        """`wait(position)` returns when everything up to the position is visible."""
        bench.hello("ann")
        grant = bench.granted(ANN, item(W))
        bench.disk_is_done = False
        bench.commit(ANN, grant.token, (slot(), "1"))
        handle = bench.send(AwaitStamp(bench.shard.state.stamps.last_ns, S, "ann", 1))
        assert handle not in bench.answers

        bench.finish_disk()

        assert isinstance(bench.answers[handle], Reached)
        assert bench.answers[handle].reached

    def test_stamp_of_the_future_is_not_reached_in_time(self, bench):
        """The wait ends with its slice, and says that it did not get there."""
        bench.hello("ann")
        handle = bench.send(AwaitStamp(bench.wall_ns + 10 * S, 500 * MS, "ann", 1))
        bench.wait(600 * MS)

        assert not bench.answers[handle].reached


class TestShortestLease:
    def test_short_visit_leaves_no_trace(self, bench):
        """The shard looks at the time as rarely as before, and a pause of 0.3 s is no stall."""
        bench.hello("ann")
        before_ns = bench.shard.next_deadline_ns() - bench.now_ns
        bench.hello("guest", ttl_ns=100 * MS)
        during_ns = bench.shard.next_deadline_ns() - bench.now_ns
        bench.ask(Goodbye("guest"))

        assert bench.shard.next_deadline_ns() - bench.now_ns == before_ns > during_ns
        bench.now_ns += 300 * MS
        bench.event(Tick())
        assert bench.counter("stalls") == 0

    def test_session_that_stays_away_counts_until_it_is_forgotten(self, bench):
        """Its lease may have to end in time; then the longest lease there may be counts again."""
        bench.hello("guest", ttl_ns=100 * MS)
        assert bench.shard.state.shortest_ttl_ns == 100 * MS
        for _ in range(30):
            bench.now_ns += 20 * MS
            bench.event(Tick())
        assert bench.shard.state.shortest_ttl_ns == bench.settings.ttl_ns_max

    def test_shortest_of_those_that_are_here(self, bench):
        """Two of one length count until both have gone."""
        for name, ttl_s in (("a", 4), ("b", 1), ("c", 1), ("d", 3)):
            bench.hello(name, ttl_ns=ttl_s * S)
        found = []
        for name in "bcda":
            bench.ask(Goodbye(name))
            found.append(bench.shard.state.shortest_ttl_ns // S)

        assert found == [1, 3, 4, 60]


class TestDrain:
    def test_draining_shard_answers_the_parked_and_grants_nothing(self, bench):
        """A shard that stops lets nobody wait, and gives no lock that it would take away."""
        bench.hello("ann", "bob")
        grant = bench.granted(ANN, item(W))
        parked = bench.send(bench.acquire_request(BOB, item(W)))
        bench.event(Drain())
        assert isinstance(bench.answers[parked], Waiting)
        assert not bench.shard.idle

        bench.commit(ANN, grant.token, (slot(), "1"))

        assert bench.shard.idle
        assert bench.acquire(BOB, item(W), wait_ns=0) is not None
        assert bench.shard.state.tenures.by_lock[BOB].token is None
