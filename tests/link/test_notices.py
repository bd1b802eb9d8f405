"""The queue of notices: newest win, losses are counted, a waiter always wakes."""

import os
import signal
import socket
import threading

import pytest
from polling import until

from enact_dist.core.protocol.datum import Datum, Slot
from enact_dist.core.protocol.messages import Notice, SlotChange, Survey
from enact_dist.link.notices import DATA_MAX, Interest, NoticeQueue, Skipped
from enact_dist.link.socket.frames import prefixed
from enact_dist.link.socket.line import Connection
from enact_dist.wire.frames import encode_frame


def test_queue_gives_notices_in_order_when_they_are_taken():
    """What was put first comes first; then nothing comes until the time is over."""
    queue = NoticeQueue()
    notices = [Notice("s0", 1, number, ()) for number in (1, 2)]
    for notice in notices:
        queue.put(notice)

    taken = [queue.get(0.0), queue.get(0.0), queue.get(0.0)]

    assert taken == [*notices, None]


def test_what_is_here_is_given_without_a_look_at_the_source(piped):
    """What came with the notice that was taken is here; what still waits in the source is not."""
    queue, far, _ = piped
    far.send(b"xx")

    first = queue.get(30.0)
    far.send(b"x")

    assert [one and one.number for one in (first, queue.get_here(), queue.get_here())] == [
        1,
        2,
        None,
    ]
    assert queue.get(30.0).number == 3
    queue.put(Notice("s1", 1, 1, ()))
    queue.close()
    assert queue.get_here() is None


def test_queue_drops_the_oldest_and_counts_when_nobody_takes_them():
    """A full queue keeps the newest; `dropped` says how many are gone."""
    queue = NoticeQueue(notices_max=3)

    for number in range(1, 11):
        queue.put(Notice("s0", 1, number, ()))

    assert queue.dropped == 7
    assert [queue.get(0.0).number for _ in range(3)] == [8, 9, 10]


def test_queue_ignores_a_notice_that_came_already():
    """Two connections to one shard do not double its notices; a new epoch counts anew."""
    queue = NoticeQueue()

    for epoch, number in ((1, 1), (1, 2), (1, 2), (1, 1), (2, 1)):
        queue.put(Notice("s0", epoch, number, ()))
    queue.put(Notice("s1", 1, 1, ()))

    taken = [queue.get(0.0) for _ in range(4)]
    assert [(n.shard, n.epoch, n.number) for n in taken] == [
        ("s0", 1, 1),
        ("s0", 1, 2),
        ("s0", 2, 1),
        ("s1", 1, 1),
    ]
    assert queue.get(0.0) is None


def test_queue_wakes_a_waiter_when_it_is_closed():
    """`get` without a limit returns None as soon as the feed is closed, and for ever after."""
    queue = NoticeQueue()
    closes = []
    queue.on_close = lambda: closes.append(1)
    taken = []
    waiter = threading.Thread(target=lambda: taken.append(queue.get(None)))
    waiter.start()

    queue.close()
    queue.close()
    waiter.join(30)

    queue.put(Notice("s0", 1, 1, ()))
    assert taken == [None]
    assert queue.get(0.0) is None
    assert closes == [1]


def test_queue_with_an_interest_passes_on_only_the_numbers_of_the_rest():
    """A run of notices of other slots becomes one entry; a number that is missing stays missing."""
    queue = NoticeQueue(Survey(("online",), ("cup/*",), ("count",)))

    for number, entity in ((1, "cup/1"), (2, "tray"), (3, "tray"), (6, "tray"), (7, "cup/2")):
        change = SlotChange(Slot("online", entity, "count"), number, number, False)
        queue.put(Notice("s0", 1, number, (change,)))

    taken = [queue.get(0.0) for _ in range(5)]
    assert [getattr(one, "number", one) for one in taken] == [1, 3, 6, 7, None]
    assert taken[1:3] == [Skipped("s0", 1, 1, 3), Skipped("s0", 1, 5, 6)]


def test_queue_keeps_few_notices_with_their_data():
    """Behind them it only knows what has changed."""
    queue, slot = NoticeQueue(), Slot("online", "cup", "count")
    for number in range(1, DATA_MAX + 3):
        change = SlotChange(slot, number, number, False, 0, Datum(b"t", b"d", 1))
        queue.put(Notice("s0", 1, number, (change,)))

    kept = [queue.get(0.0).changes[0] for _ in range(DATA_MAX + 2)]
    assert [change.version for change in kept] == list(range(1, DATA_MAX + 3))
    assert [change.datum is not None for change in kept] == DATA_MAX * [True] + 2 * [False]


def test_interest_is_in_context_aspect_and_pattern():
    """All three have to fit; of a commit of several slots one is enough."""
    interest = Interest(Survey(("online",), ("cup/*", "tray"), ("count",)))
    fits = Slot("online", "cup/1", "count")
    others = [Slot("other", "cup/1", "count"), Slot("online", "cup", "count"),
              Slot("online", "tray", "mass")]  # fmt: skip

    def covers(*slots):
        return interest.covers(Notice("s0", 1, 1, tuple(SlotChange(s, 1, 1, False) for s in slots)))

    assert covers(*others, fits)
    assert covers(fits._replace(entity="tray"))
    assert not covers(*others)


class Piped:
    """A source that a test feeds through a socket."""

    def __init__(self, near, number=0):
        self.near = near
        self.number = number

    def fileno(self):
        """Return what becomes readable."""
        return self.near.fileno()

    def take_notices(self):
        """Return one notice per byte."""
        some = self.near.recv(100)
        if not some:
            raise EOFError("it has ended")
        self.number += len(some)
        first = self.number - len(some) + 1
        return [Notice("s0", 1, number, ()) for number in range(first, self.number + 1)]


@pytest.fixture
def piped():
    """Return a queue that reads a source, the source's far end, and the reasons of its end."""
    near, far = socket.socketpair()
    queue, ends = NoticeQueue(), []
    with near, far:
        assert queue.read_from(Piped(near), ends.append)
        yield queue, far, ends
        queue.close()


def got_meanwhile(queue, act):
    """Return what a thread that waits without limit gets after `act`."""
    found = []
    waiter = threading.Thread(target=lambda: found.append(queue.get(None)))
    waiter.start()
    until(lambda: queue._polling)
    act()
    waiter.join(60)
    return found[0]


def test_whoever_waits_reads_the_source_itself(piped):
    """No thread stands between; what comes together is taken together and in order."""
    queue, far, _ = piped
    assert queue.get(0.0) is None

    found = got_meanwhile(queue, lambda: far.sendall(b"x"))
    far.sendall(b"xx")

    assert [found.number, queue.get(0.0).number, queue.get(0.0).number] == [1, 2, 3]
    assert queue.get(0.01) is None


@pytest.fixture
def watched():
    """Return a queue that reads the connection to a shard, and the shard's end of it."""
    near, far = socket.socketpair()
    queue = NoticeQueue()
    with near, far:
        assert queue.read_from(Connection("s0", near), lambda _: None)
        yield queue, far
        queue.close()


def framed(number, names=("a",)):
    """Return the bytes of a notice."""
    changes = tuple(SlotChange(Slot("online", name, "mesh"), number, 1, False) for name in names)
    header, payload = encode_frame(Notice("s0", 1, number, changes))
    return prefixed(header, len(payload or b"")) + (payload or b"")


@pytest.mark.parametrize("slots", [1, 4000])
def test_shard_that_stops_in_the_midst_of_a_notice_holds_nobody(watched, slots):
    """Who waits waits as long as asked; what has come whole is there, the rest when it comes."""
    queue, far = watched
    last = framed(3, tuple(f"part/{number}" for number in range(slots)))
    far.sendall(framed(1) + framed(2) + last[: len(last) // 2])
    found = []

    def take():
        found.extend([queue.get(30.0), queue.get(30.0), queue.get(0.05)])

    taker = threading.Thread(target=take, daemon=True)
    taker.start()
    taker.join(60)
    still = taker.is_alive()
    far.sendall(last[len(last) // 2 :])
    taker.join(60)

    assert [one and one.number for one in found] == [1, 2, None]
    assert not still
    assert len(queue.get(30.0).changes) == slots


def test_queue_waits_no_longer_for_a_shard_that_sends_ever_more_of_a_notice(watched):
    """As asked, though something comes each time that it looks."""
    queue, far = watched
    last = framed(1, tuple(f"part/{number}" for number in range(4000)))
    at, waits = 0, 0
    while at < len(last) - 1:
        far.sendall(last[at : at + 1000])
        at, waits = at + 1000, waits + 1
        notice = queue.get(0.0)
        if at < len(last):
            assert notice is None
        else:
            assert notice.number == 1


def test_notice_of_another_thread_wakes_whoever_reads_the_source(piped):
    """A second shard has a thread of its own that fills the same queue."""
    queue, far, _ = piped

    found = got_meanwhile(queue, lambda: queue.put(Notice("s1", 1, 9, ())))
    far.sendall(b"x")

    assert found == Notice("s1", 1, 9, ())
    assert queue.get(1.0).shard == "s0"


def test_close_wakes_whoever_reads_the_source(piped):
    """At once, and nothing is read after it."""
    queue, far, ends = piped

    assert got_meanwhile(queue, queue.close) is None
    far.sendall(b"x")

    assert queue.get(None) is None
    assert ends == []


def test_source_that_ends_is_told_of_once_and_may_be_followed_by_another(piped):
    """Waiting goes on with what there is then."""
    queue, far, ends = piped
    near, other_far = socket.socketpair()
    with near, other_far:
        assert not queue.read_from(Piped(near), ends.append)
        far.close()

        assert queue.get(0.01) is None
        assert [str(error) for error in ends] == ["it has ended"]
        assert queue.read_from(Piped(near, number=5), ends.append)
        other_far.sendall(b"x")

        assert queue.get(1.0).number == 6
        assert len(ends) == 1


def test_feed_in_a_forked_child_waits_for_no_thread_of_its_parent():
    """One that held its mutex at the fork is not there: nothing is got, and it can be closed."""
    queue = NoticeQueue()
    queue.put(Notice("s0", 1, 1, ()))
    with queue._mutex:
        child = os.fork()
        if child == 0:
            signal.alarm(10)
            got = queue.get(None), queue.get_here()
            queue.close()
            os._exit(0 if got == (None, None) else 1)

    assert os.waitpid(child, 0) == (child, 0)
    assert queue.get(0.0).number == 1


def test_number_that_the_shard_has_not_given_hides_nothing():
    """A forged notice takes the numbers up to it; once the shard has spoken, true ones come."""
    queue = NoticeQueue()
    queue.put(Notice("s0", 1, 1 << 62, ()))
    queue.put(Notice("s0", 1, 6, ()))
    queue.not_beyond("s0", 1, 6)
    for number in (6, 7, 8):
        queue.put(Notice("s0", 1, number, ()))

    assert [queue.get(0.0).number for _ in range(3)] == [1 << 62, 7, 8]
    assert queue.get(0.0) is None
