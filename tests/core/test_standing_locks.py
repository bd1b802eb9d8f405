"""Locks that wait for news: when they enter the queue, what they show, and how their waiting ends."""

from __future__ import annotations

from dataclasses import replace

import pytest
from client_bench import ANSWER, NOTHING, REQUEST, CellBench
from shard_bench import ASPECTS, MS, TTL_NS, S, ShardBench, datum, item, lock_id, slot

from enact_dist.core.client.plan import AwaitedNews, Phase
from enact_dist.core.protocol.messages import (
    NO_PLACE,
    Acquire,
    AspectEntry,
    Commit,
    DatumRead,
    DropWorld,
    Goodbye,
    Granted,
    Hello,
    Refused,
    Register,
    Release,
    Stale,
    Waiting,
    WriteItem,
)
from enact_dist.core.protocol.records import Drain, SessionSeen
from enact_dist.core.shard import owners
from enact_dist.core.state.tenure import shape_of
from enact_dist.terms import Access

IMAGE, MASK = slot("camera", "frame"), slot("camera", "note")
ITEMS = item(Access.VIEW, "camera", "frame"), item(Access.WRITE, "camera", "note")
NOTHING_SEEN = (DatumRead(IMAGE, 0, 0),)


class StandingBench(ShardBench):
    """A shard with a camera, an actor that waits for its images, and another process."""

    def __init__(self) -> None:
        super().__init__()
        self.hello("camera", "worker", "other")
        self.images = 0

    def image(self, text="i"):
        """Commit an image; return what one has seen who has seen it."""
        self.images += 1
        self.put(lock_id("camera", 0, self.images), IMAGE, text)
        return self.seen()

    def seen(self):
        """Return what one has seen who has seen the newest image."""
        content = self.shard.state.slots[IMAGE]
        return (DatumRead(IMAGE, content.version, content.stamp_ns),)

    def put(self, lock, to, text):
        """Commit one datum."""
        granted = self.granted(lock, item(Access.WRITE, to.entity, to.aspect))
        new = datum(text) if text is not None else None
        self.ask(Commit(lock, granted.token, (WriteItem(to, new),), 0))

    def stand(self, lock, after, *, wait_ns=900 * MS):
        """Ask for the mask's lock after what was seen; return the handle of the answer."""
        request = self.acquire_request(lock, *ITEMS, wait_ns=wait_ns)
        return self.send(replace(request, seen=after))


@pytest.fixture
def bench():
    return StandingBench()


class TestNews:
    def test_change_grants_the_parked_lock_with_its_data(self, bench):
        """The answer to the request is the grant: no notice, and no second call."""
        asked = bench.stand(lock_id("worker"), bench.image())
        assert asked not in bench.answers

        bench.image("new")

        granted = bench.answers[asked]
        assert isinstance(granted, Granted)
        (image, _) = granted.states
        assert (image.version, bytes(image.datum.body)) == (2, b"new")
        assert granted.waited_ns == 0
        assert bench.shard.counters["standing_locks_begun"] == 1

    def test_news_between_two_requests_are_found_by_the_next_one(self, bench):
        """The shard compares when the request comes: a change before it is not lost."""
        seen = bench.image()
        bench.image("new")

        asked = bench.stand(lock_id("worker"), seen)

        assert isinstance(bench.answers[asked], Granted)

    def test_first_datum_is_news_and_null_is_none(self, bench):
        """An actor starts with what there is; a deleted datum is nothing to work on."""
        asked = bench.stand(lock_id("worker"), NOTHING_SEEN)
        assert asked not in bench.answers
        seen = bench.image()
        assert isinstance(bench.answers[asked], Granted)
        bench.ask(Release(lock_id("worker")))

        again = bench.stand(lock_id("worker", 0, 2), seen)
        bench.image(None)
        assert again not in bench.answers
        bench.image("back")
        assert isinstance(bench.answers[again], Granted)

    def test_other_slots_are_no_news(self, bench):
        """Only a change of what is named counts."""
        asked = bench.stand(lock_id("worker"), bench.image())

        bench.put(lock_id("other"), slot("robot", "frame"), "x")

        assert asked not in bench.answers

    def test_any_of_several_triggers_is_news(self, bench):
        """A lock may wait for more than one slot."""
        pose = DatumRead(slot("camera", "count"), 0, 0)
        items = *ITEMS, item(Access.VIEW, "camera", "count")
        request = bench.acquire_request(lock_id("worker"), *items)
        asked = bench.send(replace(request, seen=(*bench.image(), pose)))

        bench.put(lock_id("other"), pose.slot, "x")

        assert isinstance(bench.answers[asked], Granted)

    def test_changes_meanwhile_are_one_grant_of_the_newest(self, bench):
        """Level-triggered: what came while the lock was held is one more grant."""
        seen = bench.image()
        for number in range(5):
            newest = bench.image(str(number))
        asked = bench.stand(lock_id("worker"), seen)
        assert bench.answers[asked].states[0].version == 6
        bench.ask(Release(lock_id("worker")))

        again = bench.stand(lock_id("worker", 0, 2), newest)

        assert again not in bench.answers


class TestQueue:
    def test_lock_that_waits_for_news_delays_no_other(self, bench):
        """It has no place in the queue."""
        bench.stand(lock_id("worker"), bench.image())

        granted = bench.acquire(lock_id("other"), item(Access.WRITE, "camera", "note"))

        assert isinstance(granted, Granted)

    def test_it_enters_at_the_end_of_the_queue_and_says_how_long_it_waited(self, bench):
        """First come, first served, from the change on."""
        held = bench.granted(lock_id("other"), item(Access.WRITE, "camera", "note"))
        asked = bench.stand(lock_id("worker"), bench.image())
        bench.wait(300 * MS, keep=["worker", "camera", "other"])
        bench.image("new")
        assert asked not in bench.answers
        bench.wait(200 * MS, keep=["worker", "camera", "other"])

        bench.ask(Commit(lock_id("other"), held.token, (WriteItem(MASK, datum("m")),), 0))

        assert bench.answers[asked].waited_ns == 200 * MS

    def test_slice_that_ends_in_the_queue_says_who_is_in_the_way(self, bench):
        """The place tells a client that its lock is in the queue by now."""
        bench.granted(lock_id("other"), item(Access.WRITE, "camera", "note"))
        asked = bench.stand(lock_id("worker"), bench.image())
        bench.image("new")

        bench.wait(S, keep=["worker", "camera", "other"])

        waiting = bench.answers[asked]
        assert (waiting.place, waiting.blockers[0].actor) == (1, "other")


class TestEnds:
    def test_slice_ends_without_news(self, bench):
        """No longer than asked, and never longer than a slice."""
        asked = bench.stand(lock_id("worker"), bench.image(), wait_ns=200 * MS)
        longest = bench.stand(lock_id("worker", 1), bench.seen(), wait_ns=60 * S)

        bench.wait(300 * MS, keep=["worker"])
        assert bench.answers[asked] == Waiting(lock_id("worker"), 1, NO_PLACE, ())
        assert longest not in bench.answers
        bench.wait(800 * MS, keep=["worker"])
        assert longest in bench.answers

    def test_no_patience_is_answered_at_once(self, bench):
        """With `wait_ns` 0 the shard says what there is."""
        asked = bench.stand(lock_id("worker"), bench.image(), wait_ns=0)

        assert bench.answers[asked].place == NO_PLACE

    def test_copy_of_the_request_takes_the_place_of_the_first(self, bench):
        """Both are answered, once each; the change goes to the newer one."""
        seen = bench.image()
        first, second = (bench.stand(lock_id("worker"), seen) for _ in range(2))
        assert bench.answers[first].place == NO_PLACE

        bench.image("new")

        assert isinstance(bench.answers[second], Granted)

    def test_grant_that_was_lost_is_asked_for_again(self, bench):
        """By the same request, which is not compared anew."""
        seen = bench.image()
        granted = bench.answers[bench.stand(lock_id("worker"), NOTHING_SEEN)]

        again = bench.answers[bench.stand(lock_id("worker"), seen)]

        assert again.token == granted.token

    def test_late_copy_of_an_ended_lock_is_stale(self, bench):
        """It must not take the data for an update that is over."""
        granted = bench.answers[bench.stand(lock_id("worker"), bench.image() and NOTHING_SEEN)]
        bench.ask(Commit(lock_id("worker"), granted.token, (WriteItem(MASK, datum("m")),), 0))

        late = bench.stand(lock_id("worker"), NOTHING_SEEN)

        assert isinstance(bench.answers[late], Stale)

    def test_release_and_the_next_lock_of_the_lane_end_it(self, bench):
        """A client that gives up is granted nothing later."""
        seen = bench.image()
        given_up = bench.stand(lock_id("worker"), seen)
        bench.ask(Release(lock_id("worker")))
        assert bench.answers[given_up].place == NO_PLACE

        older = bench.stand(lock_id("worker", 0, 2), seen)
        newer = bench.stand(lock_id("worker", 0, 3), seen)
        assert bench.answers[older].place == NO_PLACE
        bench.image("new")
        assert bench.answers[newer].lock == lock_id("worker", 0, 3)

    @pytest.mark.parametrize("sign", ["goodbye", "token", "lease"])
    def test_session_that_is_gone_is_granted_nothing(self, bench, sign):
        """A lock is not granted to a process that is dead while living ones want the data."""
        asked = bench.stand(lock_id("worker"), bench.image(), wait_ns=900 * MS)
        if sign == "goodbye":
            bench.ask(Goodbye("worker"))
        elif sign == "token":
            bench.event(SessionSeen("worker", present=True))
            bench.event(SessionSeen("worker", present=False))
        else:
            bench.wait(2 * TTL_NS, keep=["camera", "other"])

        bench.image("new")

        assert bench.answers[asked].place == NO_PLACE
        assert not bench.shard.state.tenures.by_lock

    def test_keep_alive_that_wants_it_no_more_ends_it(self, bench):
        """A lost release leaves nothing parked."""
        asked = bench.stand(lock_id("worker"), bench.image())

        bench.keep_alive("worker", view={0: 2})

        assert bench.answers[asked].place == NO_PLACE

    def test_late_copy_of_a_lock_that_was_given_up_is_stale(self, bench):
        """No client waits for its grant.  An older lock beside a newer one of its lane is stale too."""
        seen = bench.image()
        bench.stand(lock_id("worker", 0, 3), seen)

        older = bench.stand(lock_id("worker", 0, 2), seen)
        bench.ask(Release(lock_id("worker", 0, 3)))
        late = bench.stand(lock_id("worker", 0, 3), seen)

        assert isinstance(bench.answers[older], Stale)
        assert isinstance(bench.answers[late], Stale)

    def test_older_lock_of_the_lane_ends_when_the_news_come(self, bench):
        """Its release was lost, so the newer lock would wait for its own lane."""
        seen = bench.image()
        asked = bench.stand(lock_id("worker", 0, 2), seen)
        tenures = bench.shard.state.tenures
        ghost = bench.acquire_request(lock_id("worker", 0, 1), item(Access.WRITE, "camera", "note"))
        session = bench.shard.state.sessions.by_id["worker"]
        tenures.enqueue(ghost, shape_of(ghost.items), session, now_ns=bench.now_ns, at_once=True)

        bench.image("new")

        assert isinstance(bench.answers[asked], Granted)

    def test_shard_that_drains_answers_all(self, bench):
        """No request is left parked when a shard stops."""
        asked = bench.stand(lock_id("worker"), bench.image())

        bench.event(Drain())

        assert bench.answers[asked].place == NO_PLACE

    def test_what_the_shard_would_refuse_by_now_is_refused_at_the_change(self, bench):
        """The context may be gone, or an aspect may have another type, since the request came."""
        bench.ask(Register("other", ("extra",), ()))
        fork = IMAGE._replace(context="extra")
        gone = bench.acquire_request(
            lock_id("worker", 1),
            ITEMS[0],
            ITEMS[0]._replace(context="extra"),
            ITEMS[1]._replace(context="extra"),
        )
        asked = bench.stand(lock_id("worker"), bench.image())
        dropped = bench.send(replace(gone, seen=(*bench.seen(), DatumRead(fork, 0, 0))))
        bench.ask(DropWorld("other", "extra"))

        bench.image("new")

        assert isinstance(bench.answers[asked], Granted)
        assert isinstance(bench.answers[dropped], Refused)
        assert "extra" in bench.answers[dropped].text


class TestBounds:
    def test_only_data_of_the_lock_are_waited_for(self, bench):
        """A lock is no way to watch other slots."""
        strange = DatumRead(slot("robot", "frame"), 0, 0)

        asked = bench.stand(lock_id("worker"), (*bench.image(), strange))

        assert isinstance(bench.answers[asked], Refused)
        assert "robot" in bench.answers[asked].text

    def test_identity_has_a_share_of_what_may_be_parked(self, bench, monkeypatch):
        """One client cannot fill the shard's list of parked requests."""
        monkeypatch.setattr(owners, "WAITERS_MAX", 2)
        bench.image()
        bench.ask_as("plc@host", Hello("plc", 0, TTL_NS, "plc", "host", 1, False))
        answers = [
            bench.ask_as(
                "plc@host",
                replace(bench.acquire_request(lock_id("plc", lane), *ITEMS), seen=bench.seen()),
            )
            for lane in range(3)
        ]

        assert answers[:2] == [None, None]
        assert isinstance(answers[2], Refused)
        assert "wait for news" in answers[2].text


class TestClient:
    @pytest.fixture
    def cell(self):
        cell = CellBench("s0")
        registers = Register("admin", (), (*ASPECTS, AspectEntry("image", "int", "volatile")))
        cell.shards["s0"].hello("admin")
        cell.shards["s0"].ask(registers)
        return cell

    def stands(self, client, seen=NOTHING_SEEN, *, wait_s=1.0):
        lock = client.begin(*ITEMS, wait_s=wait_s)
        lock.news, lock.slice_ns = AwaitedNews(seen, int(wait_s * S)), 0
        return lock

    def test_waits_for_news_as_long_as_it_takes(self, cell):
        """Its patience begins when it enters the queue."""
        worker, camera = cell.client("worker"), cell.client("camera")
        lock = self.stands(worker)
        for _ in range(200):
            worker.step(lock)
            cell.wait(50 * MS)
            worker.keep_alive()
        assert lock.phase is Phase.ACQUIRING

        image = camera.drive(camera.begin(item(Access.WRITE, "camera", "frame")))
        image.finish({"s0": [WriteItem(IMAGE, datum("i"))]}, give_up_ns=cell.now_ns + S)
        camera.drive(image)

        assert worker.drive(lock).phase is Phase.HELD

    @pytest.mark.parametrize("lost", [REQUEST, ANSWER])
    def test_lost_messages_are_asked_for_again(self, cell, lost):
        """What is lost costs time and no news."""
        worker, camera = cell.client("worker"), cell.client("camera")
        image = camera.drive(camera.begin(item(Access.WRITE, "camera", "frame")))
        image.finish({"s0": [WriteItem(IMAGE, datum("i"))]}, give_up_ns=cell.now_ns + S)
        camera.drive(image)
        left = [3]

        def lose(_shard, request):
            if isinstance(request, Acquire) and left[0]:
                left[0] -= 1
                return lost
            return NOTHING

        worker.lose = lose

        assert worker.drive(self.stands(worker, wait_s=5.0)).phase is Phase.HELD
        assert left == [0]

    def test_gives_up_in_the_queue_after_its_patience(self, cell):
        """The lock names the holder that blocks it, as any lock does."""
        worker, other = cell.client("worker"), cell.client("other")
        held = other.drive(other.begin(item(Access.WRITE, "camera", "frame")))
        held.finish({"s0": [WriteItem(IMAGE, datum("i"))]}, give_up_ns=cell.now_ns + S)
        other.drive(held)
        other.drive(other.begin(item(Access.WRITE, "camera", "note"), lane=1))
        lock = self.stands(worker)

        while lock.phase.busy:
            worker.step(lock)
            cell.wait(50 * MS)
            worker.keep_alive()
            other.keep_alive()

        assert lock.phase is Phase.TIMED_OUT
        assert lock.blockers[0].actor == "other"
