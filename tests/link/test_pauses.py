"""When a session gives signs of life: by a clock of the test's own, in counts."""

import threading
import weakref

import pytest

from enact_dist.core.client.client import Client
from enact_dist.core.protocol.datum import Token
from enact_dist.core.protocol.messages import (
    Acquire,
    Alive,
    Granted,
    GrantLeft,
    Hello,
    Item,
    KeepAlive,
    PlacementMap,
    ShardEntry,
    Welcome,
)
from enact_dist.link.client.locks import CellClient
from enact_dist.link.client.pauses import Pauses, keep_renewing
from enact_dist.link.socket import line as socket_line
from enact_dist.terms import Access

TTL_NS = 2 * 10**9
MINUTE_NS = 60 * 10**9
WRITE = Item(int(Access.WRITE), "online", "cup", "count")


class Clock:
    """The session's clock."""

    ns = 10**12

    def __call__(self):
        return self.ns


class Cell:
    """A carrier to two shards that answer at once, or are away; counts what they are asked."""

    inside = False

    def __init__(self):
        self.asked, self.gone, self.silent = [], set(), set()
        self.grants = ()

    def away(self, shard):
        return shard in self.gone

    def request(self, shard, message, *, timeout_s, **more):
        self.asked.append((shard, type(message)))
        if shard in self.silent:
            return None
        if isinstance(message, Hello):
            entries = (ShardEntry("s0", ()), ShardEntry("s1", ()))
            placement = PlacementMap(1, entries, ())
            return Welcome(shard, 1, True, TTL_NS, 1, 0, placement, ("online",), ())
        if isinstance(message, Acquire):
            token = Token(1, message.count)
            self.grants = (GrantLeft(message.lock, token, message.hold_ns),)
            return Granted(message.lock, token, 1, message.count, message.hold_ns, 1, (), 0)
        if isinstance(message, KeepAlive):
            return Alive(1, message.count, 0, 1, self.grants)
        return None

    def request_all(self, requests, *, timeout_s):
        return [self.request(shard, message, timeout_s=timeout_s) for shard, message in requests]

    def add_endpoints(self, entries):
        pass

    def signs(self, shard):
        """Return how often a shard was sent a sign of life."""
        return self.asked.count((shard, KeepAlive))


@pytest.fixture
def carrier():
    return Cell()


@pytest.fixture
def session(carrier):
    """A session that both shards know."""
    client = Client("a" * 32, ttl_ns=TTL_NS)
    session = CellClient(carrier, client, now_ns=Clock(), keep_alive=False)
    for shard in ("s0", "s1"):
        session.call(shard, client.hello(shard))
    return session


def live(session, duration_ns):
    """Let a session give its signs of life for so long."""
    clock = session._now_ns
    end_ns = clock.ns + duration_ns
    while clock.ns < end_ns:
        clock.ns += int(session.next_renewal_s() * 1e9)
        session.renew()


def test_idle_session_gives_two_signs_of_life_in_a_ttl(session, carrier):
    """It gave four: half of what an idle client cost beside Zenoh's own threads."""
    live(session, MINUTE_NS)

    assert carrier.signs("s0") == carrier.signs("s1") == 2 * MINUTE_NS // TTL_NS


def test_session_with_a_lock_gives_four_until_a_ttl_after_its_end(session, carrier):
    """So that what a lost release has left behind is repaired as soon as ever."""
    lock = session.acquire([WRITE], wait_s=0.0, hold_s=1e3)
    live(session, 10 * TTL_NS)
    assert carrier.signs("s1") == 40
    session.release(lock)
    live(session, TTL_NS)
    assert carrier.signs("s1") == 44
    live(session, 10 * TTL_NS)
    assert carrier.signs("s1") == 64


def test_session_whose_watch_looks_for_missed_notices_gives_four(session, carrier):
    """They tell how many notices there were."""
    for _ in range(40):
        session.renewal.used()
        live(session, TTL_NS // 4)

    assert carrier.signs("s0") == 40


def test_first_lock_ends_a_long_rest_and_the_next_ones_wake_nobody(session, monkeypatch):
    """A renewal that came later than a quarter of a TTL would be one chance less for the lock."""
    hurries = []
    monkeypatch.setattr(session.pauses, "end_long_pause", lambda: hurries.append(1))
    assert session.next_renewal_s() == TTL_NS / 2e9
    for _ in range(3):
        session.release(session.acquire([WRITE], wait_s=0.0, hold_s=1.0))
    assert len(hurries) == 1
    assert session.next_renewal_s() == TTL_NS / 4e9
    session.release(session.acquire([WRITE], wait_s=0.0, hold_s=1.0))
    assert len(hurries) == 1


def test_hurried_renewal_only_looks_how_long_it_may_rest():
    """Nothing is sent for it."""
    pauses, renewed = Pauses(), []

    class Renewed:
        def next_renewal_s(self):
            renewed.append("looks")
            if len(renewed) > 1:
                pauses.end()
            return 1e3

        def renew(self):
            renewed.append("renews")

    here = Renewed()
    renewing = threading.Thread(target=keep_renewing, args=(weakref.ref(here), pauses))
    pauses.end_long_pause()
    renewing.start()
    renewing.join(30)

    assert not renewing.is_alive()
    assert renewed == ["looks", "looks"]


def test_sign_of_life_that_a_shard_answers_wakes_those_who_wait_for_it(session, carrier):
    """Whoever waits need not ask it: one sign of life for all of them finds it again."""
    carrier.gone, carrier.silent = {"s0", "s1"}, {"s0", "s1"}
    live(session, MINUTE_NS)
    assert session.pauses.returns == 0
    carrier.silent = {"s1"}
    live(session, MINUTE_NS)

    assert session.pauses.returns > 0
    asked = carrier.signs("s1")
    assert session.counters["keep_alives_unanswered"] >= asked


def test_shards_that_are_away_are_asked_in_one_round(session, carrier):
    """Each round wakes a thread, which costs more than the question."""
    carrier.gone = carrier.silent = {"s0", "s1"}
    rounds = []
    ask = carrier.request_all

    def counting(requests, *, timeout_s):
        rounds.append({shard for shard, _ in requests})
        return ask(requests, timeout_s=timeout_s)

    carrier.request_all = counting
    live(session, MINUTE_NS)

    assert all(one in ({"s0", "s1"}, set()) for one in rounds)
    assert len(rounds) <= 30


def test_socket_of_a_shard_that_is_away_is_tried_rarely_until_the_shard_returns(monkeypatch):
    """A try wakes a thread twice and leaves a stopped shard a connection to clean up."""
    now_s, tried, away = [1e3], [], [True]
    monkeypatch.setattr(socket_line.time, "monotonic", lambda: now_s[0])
    line = socket_line.SocketLine("s0", "folder", b"", b"", lambda: away[0])

    def refuse():
        tried.append(now_s[0])
        raise OSError("nobody accepts")

    monkeypatch.setattr(line, "_connected", refuse)

    def ask_for(seconds_s):
        tried.clear()
        for _ in range(int(seconds_s * 10)):
            assert line.take() is None
            now_s[0] += 0.1
        return len(tried)

    assert ask_for(60.0) == 6
    line.try_again()
    assert ask_for(0.1) == 1
    away[0] = False
    line.try_again()
    assert ask_for(60.0) >= 12
