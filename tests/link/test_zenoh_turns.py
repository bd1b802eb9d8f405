"""A shard over Zenoh serves its clients in turn, each one's requests in their order."""

import threading
from collections import Counter

import pytest
import zenoh

from enact_dist.core.protocol.messages import Hello, ListLocks, Ping
from enact_dist.link.host import TICK_S_MAX
from enact_dist.link.host_figures import STALL_S
from enact_dist.link.zenoh import fairness
from enact_dist.link.zenoh import service as zenoh_service
from enact_dist.link.zenoh.config import close_session, open_session
from enact_dist.wire.frames import encode_frame
from enact_dist.wire.keys import request_key, verb_of

ARRIVED = request_key("cell", "s0", "arrived", "z")


class Sender:
    """Sends requests of several identities over one link, and notes who was answered, in order."""

    def __init__(self, session):
        self.session = session
        self.answered = []
        self.ended = Counter()
        self._changed = threading.Condition()

    def post(self, name, message=None):
        """Send a request of the client `name[0]`; it is noted under the whole name."""
        message = message or ListLocks()
        header, payload = encode_frame(message)

        def answered(reply):
            assert reply.ok is not None
            self.answered.append(name)

        def ended():
            with self._changed:
                self.ended[name] += 1
                self._changed.notify()

        self.session.get(
            request_key("cell", "s0", verb_of(message), name[0]),
            zenoh.handlers.Callback(answered, ended, indirect=False),
            payload=payload or b"",
            attachment=header,
            timeout=60,
        )

    def wait_ended(self, count):
        with self._changed:
            assert self._changed.wait_for(lambda: sum(self.ended.values()) == count, 60)


class Stopped:
    """A shard whose dispatcher stands still in a request of client `x`; a context manager."""

    def __init__(self, shard, sender):
        self.host, self.sender = shard.host, sender
        self._arrived = threading.Event()
        self._queryable = shard._session.declare_queryable(
            ARRIVED, lambda _: self._arrived.set(), complete=True
        )
        self._begun = threading.Event()
        self.submitted = []
        submit = self.host.submit

        def noting(message, reply, identity="", subject=None):
            self._begun.set()
            submit(message, reply, identity)
            self.submitted.append(identity)

        self.host.submit = noting

    def __enter__(self):
        self.host._mutex.acquire()
        self.sender.post("x", Ping())
        assert self._begun.wait(60)
        return self

    def __exit__(self, *_):
        self.go_on()
        self._queryable.undeclare()
        del self.host.submit

    def wait_arrived(self):
        """Wait until all that was sent has come to the shard: a link keeps the order."""
        self.sender.session.get(
            ARRIVED,
            zenoh.handlers.Callback(lambda _: None, indirect=False),
            target=zenoh.QueryTarget.ALL,
            timeout=60,
        )
        assert self._arrived.wait(60)

    def go_on(self):
        if self.host._mutex._is_owned():
            self.host._mutex.release()


@pytest.fixture
def sender(endpoint):
    session = open_session(connect=[endpoint], lease_s=30.0)
    yield Sender(session)
    close_session(session)


@pytest.fixture
def shard(daemon, endpoint):
    return daemon(endpoint)


@pytest.fixture
def stopped(shard, sender):
    while not sender.answered:  # until the link is there
        sender.ended.clear()
        sender.post("w")
        sender.wait_ended(1)
    known = "abcx"
    for name in known:
        sender.post(name, Hello(f"session of {name}", 0, 60 * 10**9, name, "h", 1, True))
    sender.wait_ended(1 + len(known))
    sender.answered.clear()
    sender.ended.clear()
    with Stopped(shard, sender) as found:
        yield found


def names(client, count):
    return [f"{client}{index}" for index in range(count)]


def test_request_is_served_after_one_of_each_other_client_however_many_wait(stopped, sender):
    """Behind 100 requests of each of two clients, the third client's two are among the first."""
    crowd = [*names("a", 100), *names("b", 100)]
    for name in [*crowd, *names("c", 2)]:
        sender.post(name)
    stopped.wait_arrived()
    stopped.go_on()
    sender.wait_ended(203)

    assert sender.answered[:7] == ["x", "a0", "b0", "c0", "a1", "b1", "c1"]
    for client in "ab":
        assert [name for name in sender.answered if name[0] == client] == names(client, 100)


def test_newcomers_of_many_names_delay_a_client_by_one_request(stopped, sender):
    """Of 20 that have no session each waits for those before it, a client for one of them."""
    crowd = [f"{chr(ord('A') + number)}0" for number in range(20)]
    for name in [*crowd, *names("c", 2)]:
        sender.post(name)
    stopped.wait_arrived()
    stopped.go_on()
    sender.wait_ended(23)

    assert sender.answered[:5] == ["x", "A0", "c0", "B0", "c1"]
    assert [name for name in sender.answered if name in crowd] == crowd


def test_tick_lets_no_request_overtake_an_older_one_of_its_client(stopped, sender, monkeypatch):
    """While the dispatcher has one in hand, the timer serves none of those behind it."""
    monkeypatch.setattr(zenoh_service, "DRAIN_S_MAX", 0.02)
    for name in names("x", 20):
        sender.post(name)
    stopped.wait_arrived()

    stopped.host.tick()
    early = list(stopped.submitted)
    stopped.go_on()
    sender.wait_ended(21)

    assert early == []
    assert sender.answered == ["x", *names("x", 20)]


def test_tick_waits_for_what_has_arrived_before_it(stopped, sender, monkeypatch):
    """A renewal that waits behind others in the inbox counts before its lease can end."""
    monkeypatch.setattr(zenoh_service, "DRAIN_S_MAX", 60.0)
    for name in [*names("a", 50), "b0"]:
        sender.post(name)
    stopped.wait_arrived()
    drained = []
    service = [*stopped.host._inboxes][-1].__self__
    timer = threading.Thread(
        target=lambda: (service.drain_inbox(), drained.append(len(stopped.submitted)))
    )

    timer.start()
    while service._drained is None and not drained:
        continue
    stopped.go_on()
    timer.join(60)

    assert drained[0] >= 52


def test_tick_that_waits_for_many_requests_is_no_stall_of_the_shard():
    """Each one would be told as a pause of the process, for as long as too many requests come."""
    assert zenoh_service.DRAIN_S_MAX + 2 * TICK_S_MAX < STALL_S


def test_requests_without_room_are_dropped_counted_and_named(stopped, sender, monkeypatch, caplog):
    """Beyond its share a client stays without an answer, which tells it to ask again."""
    monkeypatch.setattr(fairness, "OF_ONE_MAX", 5)
    for name in [*names("a", 20), "b0"]:
        sender.post(name)
    stopped.wait_arrived()
    stopped.go_on()
    sender.wait_ended(22)

    assert sender.answered == ["x", "a0", "b0", "a1", "a2", "a3", "a4"]
    assert stopped.host.figures()["requests_dropped"] == 15
    assert [r.getMessage() for r in caplog.records if "too many requests from a," in r.getMessage()]
