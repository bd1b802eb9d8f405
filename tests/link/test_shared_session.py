"""What the threads of one session share, looked at by one while another is changing it."""

import threading
from types import SimpleNamespace

import pytest

from enact_dist import Aspect, Entity, Lock, Write, local
from enact_dist.core.client.client import Client
from enact_dist.core.client.own_commits import Unsettled
from enact_dist.core.client.plan import Phase
from enact_dist.core.client.session import Peer
from enact_dist.core.protocol.datum import Slot
from enact_dist.core.protocol.messages import (
    AspectEntry,
    AwaitStamp,
    Item,
    PlacementMap,
    Reached,
    Register,
    Registered,
    ShardEntry,
    Welcome,
    WorldEntry,
)
from enact_dist.errors import ConfigError, LinkError
from enact_dist.link.client.catalogue import PAUSE_NS, KnownCatalogue
from enact_dist.link.client.session import SessionClient
from enact_dist.link.clock import boottime_ns
from enact_dist.terms import Access

COUNT = AspectEntry("count", "f", "volatile")
ONE_SHARD = PlacementMap(1, (ShardEntry("s0", ()),), ())


class Interrupted:
    """Entries that let somebody look when they are gone through."""

    def __init__(self, entries, look):
        self.entries, self.look = entries, look

    def __iter__(self):
        self.look()
        return iter(self.entries)


def in_another_thread(act):
    thread = threading.Thread(target=act, daemon=True)
    thread.start()
    thread.join(30)
    assert not thread.is_alive()


@pytest.fixture
def session():
    with local(worlds=["online"]) as cell:
        yield cell.world("online").session


# ---------------------------------------------------------------- the catalogue


def test_catalogue_settles_nothing_by_what_is_known_no_more():
    """A lock asks whether its aspects are known while a restarted shard says that they are not."""
    catalogue = KnownCatalogue()
    catalogue.learn("s0", Registered(("online",), (COUNT,)))
    seen = []

    def look():
        seen.append(catalogue.settled((COUNT,), ONE_SHARD))

    catalogue.learn("s0", Registered(("online",), Interrupted((), look)))

    assert seen
    assert all(seen)
    assert not catalogue.settled((COUNT,), ONE_SHARD)


def test_catalogue_shows_a_fork_at_any_moment():
    """Its shard names it again: it is not gone meanwhile."""
    catalogue, seen = KnownCatalogue(), []
    fork = WorldEntry("what_if", "online")
    catalogue.learn("s0", Registered(("online",), (), (fork,)))

    def look():
        seen.append(catalogue.worlds())

    catalogue.learn("s0", Registered(("online",), (), Interrupted((fork,), look)))

    assert [sorted(worlds) for worlds in seen] == [["online", "what_if"]]


def welcome(epoch, *aspects):
    return Welcome("s0", epoch, True, 10**9, 0, 0, ONE_SHARD, ("online",), aspects)


def test_catalogue_of_an_epoch_that_is_over_is_not_taken():
    """A late welcome, or the answer to what was registered before: the shard has forgotten since."""
    catalogue = KnownCatalogue()
    catalogue.learn("s0", welcome(1, COUNT))
    catalogue.learn("s0", welcome(2))
    assert (catalogue.aspects(), catalogue.lapses) == ({}, 1)

    catalogue.learn("s0", welcome(1, COUNT))
    catalogue.learn("s0", Registered(("online",), (COUNT,)), sent_in=1)

    assert (catalogue.aspects(), catalogue.lapses) == ({}, 1)
    catalogue.learn("s0", Registered(("online",), (COUNT,)), sent_in=2)
    assert catalogue.aspects() == {"count": COUNT}


@pytest.mark.parametrize("known", [(), (COUNT,)])
def test_what_was_registered_over_a_restart_is_looked_up_again(known):
    """Until then nobody takes the answer for what the shard knows now, whatever that is."""
    seen = []

    class Restarting(Carrier):
        def request(self, shard, message, *, timeout_s, **more):
            if isinstance(message, Register):
                client._take(shard, client.core.hello(shard), welcome(2))
                return Registered(("online",), (COUNT,))
            seen.append(client.aspect_entries())
            return welcome(2, *known)

    client = client_of(Restarting())
    client._take("s0", client.core.hello("s0"), welcome(1))
    client.register(aspects=(COUNT,))
    assert seen == [{}]
    assert tuple(client.aspect_entries().values()) == known


# ---------------------------------------------------------------- further shards


class Carrier:
    """Connects to shards, or fails as it is told."""

    inside = False
    fetch_bytes = 1 << 20

    def __init__(self, *failures):
        self.failures = list(failures)
        self.tried = 0

    def away(self, shard):
        return False

    def add_endpoints(self, entries):
        self.tried += 1
        if self.failures:
            raise self.failures.pop(0)


class Clock:
    """The session's clock, which stands still."""

    ns = 10**12

    def __call__(self):
        return self.ns


def client_of(carrier, now_ns=boottime_ns):
    client = Client("a" * 32, ttl_ns=10**9)
    return SessionClient(carrier, client, now_ns=now_ns, keep_alive=False)


def hear(client):
    client._take("s0", AwaitStamp(0, 0), Reached(reached=True, stamp_ns=0))


@pytest.mark.parametrize(
    "failure", [LinkError("no session can be opened"), RuntimeError("can't start new thread")]
)
def test_shards_that_could_not_be_connected_are_tried_again(failure, caplog):
    """After a pause: the answers that come meanwhile, of healthy shards, are nobody's error."""
    carrier, clock = Carrier(failure, failure), Clock()
    client = client_of(carrier, clock)
    client.core.learn_placement(ONE_SHARD)

    hear(client)
    hear(client)
    assert carrier.tried == 1
    for tried in (2, 3):
        clock.ns += PAUSE_NS
        hear(client)
        hear(client)
        assert carrier.tried == tried
    clock.ns += PAUSE_NS
    hear(client)

    assert carrier.tried == 3
    assert client.counters == {"connects_failed": 2}
    assert caplog.text.count(str(failure)) == 2


def test_endpoint_that_cannot_be_read_is_told_once(caplog):
    """What a cell's file says wrongly does not stop who needs other shards."""
    carrier, clock = Carrier(ConfigError("no endpoint"), ConfigError("no endpoint")), Clock()
    client = client_of(carrier, clock)
    client.core.learn_placement(ONE_SHARD)

    hear(client)
    clock.ns += PAUSE_NS
    hear(client)

    assert carrier.tried == 1
    assert caplog.text.count("no endpoint") == 1


@pytest.mark.parametrize("failure", [LinkError("no session"), ConfigError("no endpoint")])
def test_commit_stands_though_a_further_shard_cannot_be_connected(monkeypatch, failure):
    """Whoever got an error for it would write once more."""
    tried, count, cup = [], Aspect("count", int), Entity("cup")

    def fail(_):
        tried.append(failure)
        raise failure

    with local(worlds=["online"]) as cell:
        world, client = cell.world("online"), cell._client
        world.init(cup, count, 1)
        request = Write(world, cup, count)
        with Lock(request) as lock:
            lock[request] += 1
            monkeypatch.setattr(client.carrier, "add_endpoints", fail)
            entries = (*client.core.placement.shards, ShardEntry("s1", ("tcp/127.0.0.1:1",)))
            client.core.learn_placement(client.core.placement._replace(version=99, shards=entries))
        assert tried
        with Lock(request) as lock:
            assert lock[request] == 2


def test_shards_are_connected_once_by_two_threads_that_learn_of_them():
    """The other one has its answer while this one compares what it has learned."""
    carrier, compared = Carrier(), []
    client = client_of(carrier)

    class Learned(PlacementMap):
        __slots__ = ()
        __hash__ = PlacementMap.__hash__

        def __ne__(self, other):
            compared.append(other)
            if len(compared) == 1:
                in_another_thread(lambda: hear(client))
            return tuple(self) != tuple(other)

    client.core.learn_placement(Learned(*ONE_SHARD))
    hear(client)

    assert compared
    assert carrier.tried == 1


# ---------------------------------------------------------------- lanes


@pytest.mark.parametrize("attempt", [1, 2])
def test_lane_of_a_lock_that_is_interrupted_as_it_begins_is_given_back_once(
    session, monkeypatch, attempt
):
    """Two threads would have it otherwise; a lock that is asked for anew keeps its lane."""
    client = session.client

    class Begun(list):
        def append(self, lock):
            super().append(lock)
            if len(self) == attempt:
                raise KeyboardInterrupt

    def lose(lock, **_):
        lock.phase = Phase.LOST

    begun = Begun()
    monkeypatch.setattr(client, "_drive", lose)
    item = Item(int(Access.WRITE), "online", "cup", "count")
    with pytest.raises(KeyboardInterrupt):
        client.acquire([item], wait_s=1.0, hold_s=1.0, begun=begun)
    client.release(begun[-1])  # as whoever asked does

    lanes = client._lanes
    assert len(begun) == attempt
    assert sorted(lanes.free) == list(range(lanes._made))


@pytest.mark.parametrize("attempt", [1, 2])
def test_lock_that_is_interrupted_before_it_is_noted_is_no_lock(session, monkeypatch, attempt):
    """Keep-alives would name it for ever: no lost release of its lane would be repaired."""
    client, begun, made = session.client, [], []
    begin = Client.begin

    def interrupted(*arguments, **named):
        made.append(begin(*arguments, **named))
        if len(made) == attempt:
            raise KeyboardInterrupt
        return made[-1]

    def lose(lock, **_):
        lock.lose("on purpose")

    monkeypatch.setattr(client, "_drive", lose)
    monkeypatch.setattr(Client, "begin", interrupted)
    item = Item(int(Access.WRITE), "online", "cup", "count")
    with pytest.raises(KeyboardInterrupt):
        client.acquire([item], wait_s=1.0, hold_s=1.0, begun=begun)

    lanes = client._lanes
    assert (len(made), len(begun)) == (attempt, attempt - 1)
    assert client.core.live_locks() == []
    assert sorted(lanes.free) == list(range(lanes._made))


def test_lock_that_begins_anew_is_noted_before_the_one_before_it_lets_go(session, monkeypatch):
    """Interrupted in between, the lane would be nobody's, and the lock a live one for ever."""
    client = session.client

    class Begun(list):
        def append(self, lock):
            if self:
                raise KeyboardInterrupt
            super().append(lock)

    def lose(lock, **_):
        lock.lose("on purpose")

    monkeypatch.setattr(client, "_drive", lose)
    item = Item(int(Access.WRITE), "online", "cup", "count")
    with pytest.raises(KeyboardInterrupt):
        client.acquire([item], wait_s=1.0, hold_s=1.0, begun=Begun())

    lanes = client._lanes
    assert client.core.live_locks() == []
    assert sorted(lanes.free) == list(range(lanes._made))


# ---------------------------------------------------------------- looked at while it grows


def test_shards_in_use_can_be_listed_while_another_thread_learns_of_one():
    """As a cell that is being closed does."""
    client = Client("a" * 32, ttl_ns=10**9)

    class Met(Peer):
        @property
        def epoch(self):
            client.peer("s1")
            return 1

        @epoch.setter
        def epoch(self, _):
            pass

    client.peers["s0"] = Met()

    assert client.shards_in_use() == ["s0"]


def test_aspect_that_was_used_is_found_while_another_thread_uses_one(session):
    """As a listing does that shows data of a type."""

    class Named(str):
        __slots__ = ()
        __hash__ = str.__hash__

        def __eq__(self, other):
            session.look_up([Aspect(f"other{len(session._entries)}", int)])
            return False

    session.look_up([Aspect("count", int), Aspect("pose", int)])

    assert session.aspect_used(Named("none")) is None


def test_aspects_are_registered_again_while_another_thread_registers_one(session, monkeypatch):
    """After a shard has forgotten them."""
    client, wanted = session.client, []

    class Name(str):
        __slots__ = ()
        __hash__ = str.__hash__

        def __eq__(self, other):
            client.catalogue.wants([COUNT._replace(name="new")])
            return str.__eq__(self, other)

    item = SimpleNamespace(aspect=Name("count"))
    plan = SimpleNamespace(locks=[("shard", (item,))], views=[])
    code = SimpleNamespace(code="unknown_aspect")
    refused = SimpleNamespace(plan=plan, phase=None, refusal=code)
    client.catalogue.wants([COUNT])
    monkeypatch.setattr(client, "register", lambda **named: wanted.append(named["aspects"]))
    monkeypatch.setattr("enact_dist.link.client.locks.Refused", SimpleNamespace)

    assert client._begins_anew(refused, 0)
    assert wanted == [[COUNT]]
    assert {entry.name for entry in client.catalogue.wanted({"count", "new"})} == {"count", "new"}


def test_own_commits_are_noted_while_nobody_settles_others(session, monkeypatch):
    """A note made in the middle of it would be lost, and its commit not shown to its own process."""
    client, owned = session.client, []
    reached = Unsettled.reached

    def noted(unsettled, shard, stamp_ns):
        owned.append(client._mutex._is_owned())
        reached(unsettled, shard, stamp_ns)

    monkeypatch.setattr(Unsettled, "reached", noted)
    (shard,) = client.shards()
    client.core.unsettled.committed(shard, [Slot("online", "cup", "count")], 1)

    session.settle(shard)

    assert owned == [True]
    assert not client.core.unsettled


def test_feed_that_was_closed_is_forgotten(session):
    """A process that watches again and again does not grow."""
    feeds = [session.client.subscribe() for _ in range(3)]
    for feed in feeds:
        feed.close()

    assert not session.client.carrier._feeds
