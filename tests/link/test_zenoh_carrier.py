"""Requests, answers, notices and tokens between processes, over Zenoh and over sockets."""

import os
import queue
import threading
import time

import pytest
from parked_parts import parked

from enact_dist.core.protocol.messages import (
    Committed,
    Fetch,
    ListLocks,
    ListSessions,
    Locks,
    Reached,
    ShardEntry,
    Slice,
)
from enact_dist.errors import (
    ConfigError,
    LinkError,
    MisuseError,
    ProtocolError,
    ShardUnreachableError,
)
from enact_dist.link.zenoh import carrier as zenoh_carrier
from enact_dist.link.zenoh import config as zenoh_config
from enact_dist.link.zenoh.config import close_session, open_session
from enact_dist.wire.frames import encode_frame

both = pytest.mark.parametrize("carry", ["zenoh", "socket"], indirect=True)
"""What every carrier between processes has to do."""


def speak(carrier, make_peer, **options):
    """Return the session of `carrier`, which has said hello over it."""
    options = {"session": getattr(carrier, "behind", carrier)._session, **options}
    peer = make_peer(
        lambda shard, message: carrier.request(shard, message, timeout_s=30), **options
    )
    peer.hello()
    return peer


@both
def test_carrier_brings_an_answer_from_a_shard(daemon, carry, endpoint):
    """A request travels to the daemon and its answer back."""
    daemon(endpoint)

    answer = carry(endpoint).request("s0", ListLocks(), timeout_s=30)

    assert isinstance(answer, Locks)


@both
def test_carrier_keeps_many_calls_in_flight_at_once(daemon, carry, endpoint):
    """100 parked calls and one quick one are under way together; the quick one comes at once."""
    daemon(endpoint)
    carrier = carry(endpoint)
    waiting = [("s0", parked(carrier, 2.0))] * 100  # 200 s one by one
    started_s = time.monotonic()

    answers = carrier.request_all([*waiting, ("s0", ListLocks())], timeout_s=100)

    assert [type(answer) for answer in answers] == [*[Reached] * 100, Locks]
    assert time.monotonic() - started_s < 100.0


@both
def test_carrier_says_unknown_when_an_answer_takes_too_long(daemon, carry, endpoint):
    """A call that is parked for longer than its caller waits returns None."""
    daemon(endpoint)

    carrier = carry(endpoint)

    answer = carrier.request("s0", parked(carrier, 5.0), timeout_s=0.1)

    assert answer is None


@both
def test_carrier_says_unknown_at_once_when_the_shard_is_away(daemon, carry, endpoint):
    """A request to a shard that is not there returns None well before its time is over."""
    daemon(endpoint)
    carrier = carry(endpoint)
    started_s = time.monotonic()

    answer = carrier.request("s9", ListLocks(), timeout_s=600)

    assert answer is None
    assert time.monotonic() - started_s < 30


def test_carrier_names_the_endpoint_when_nobody_is_there(carry, endpoint):
    """Opening a carrier to a dead endpoint is an error that names it, not an empty answer."""
    with pytest.raises(ShardUnreachableError, match=endpoint) as caught:
        carry(endpoint, connect_s=0.2)

    assert caught.value.endpoint == endpoint


@both
def test_carrier_moves_large_data_in_slices_byte_for_byte(daemon, carry, make_peer, endpoint):
    """9 MB written in one commit come back in slices of the carrier's size, the same bytes."""
    daemon(endpoint)
    carrier = carry(endpoint)
    peer = speak(carrier, make_peer)
    body = os.urandom(9_000_000)
    assert isinstance(peer.write_in_slices("cup", body), Committed)

    granted = peer.acquire("cup")
    state = granted.states[0]
    fetches = [
        (
            "s0",
            Fetch(granted.lock, peer.epoch, state.slot, state.version, start, carrier.fetch_bytes),
        )
        for start in range(0, len(body), carrier.fetch_bytes)
    ]
    slices = carrier.request_all(fetches, timeout_s=10)
    for index, fetch in enumerate(fetches):  # a busy link may drop a slice, which says nothing
        for _ in range(5):
            slices[index] = slices[index] or carrier.request(*fetch, timeout_s=10)

    assert state.large
    assert all(isinstance(part, Slice) for part in slices)
    assert b"".join(bytes(part.body.body) for part in slices) == body


@both
def test_carrier_brings_notices_of_every_commit_in_order(daemon, carry, make_peer, endpoint):
    """A feed has each commit of another client once, numbered without a gap."""
    daemon(endpoint)
    feed = carry(endpoint).subscribe()
    writer = speak(carry(endpoint), make_peer)
    while (first := feed.get(0.05)) is None:
        writer.write("probe", b"0")

    for number in range(50):
        writer.write("cup", b"%d" % number)
    numbers = [first.number]
    while len(numbers) < 51:
        numbers.append(feed.get(5).number)

    assert first.shard == "s0"
    assert numbers == list(range(first.number, first.number + 51))


@both
def test_carrier_holds_its_token_while_it_is_open(daemon, carry, make_peer, endpoint, until):
    """The shard sees the session's token soon after the start and no more after the end."""
    daemon(endpoint)
    mine, watcher = carry(endpoint, session="mine"), carry(endpoint)
    speak(mine, make_peer, session="mine")

    def present():
        sessions = watcher.request("s0", ListSessions(), timeout_s=30).sessions
        return {info.session: info.token_present for info in sessions}["mine"]

    until(present)
    mine.close()

    until(lambda: not present())


@both
def test_carrier_reaches_further_shards_when_it_learns_of_them(
    daemon, carry, endpoint, free, until
):
    """A shard known by its advertised endpoint only is reached, and sees the token.

    Right after the connection its queryable may not be known yet: None, which means "ask again".
    """
    second = free()
    daemon(endpoint)
    daemon(second, "s1")
    carrier = carry(endpoint)
    assert carrier.request("s1", ListLocks(), timeout_s=5) is None

    carrier.add_endpoints([ShardEntry("s0", (endpoint,)), ShardEntry("s1", (second,))])

    asked = [("s0", ListLocks()), ("s1", ListLocks())]
    answers = until(
        lambda: None not in (found := carrier.request_all(asked, timeout_s=30)) and found
    )
    assert [type(answer) for answer in answers] == [Locks, Locks]
    assert carrier.endpoint_of("s1") == second


@both
def test_shards_that_cannot_be_connected_stop_no_other(daemon, carry, endpoint, free, monkeypatch):
    """Each is named; only where all have endpoints that cannot be read is that the error."""
    wrong = {name: (free(),) for name in ("s1", "s3")}
    second = free()
    daemon(endpoint)
    daemon(second, "s2")
    carrier = carry(endpoint)
    errors = {wrong["s1"]: ConfigError("no endpoint"), wrong["s3"]: LinkError("no session")}

    def opened(*, connect, **settings):
        if connect in errors:
            raise errors[connect]
        return open_session(connect=connect, **settings)

    monkeypatch.setattr(zenoh_carrier, "open_session", opened)
    entries = [ShardEntry(name, wrong.get(name, (second,))) for name in ("s1", "s2", "s3")]
    with pytest.raises(LinkError, match="shard s1: no endpoint; shard s3: no session"):
        carrier.add_endpoints(entries)

    assert isinstance(carrier.request("s2", ListLocks(), timeout_s=30), Locks)
    errors[wrong["s3"]] = ConfigError("nor here")
    with pytest.raises(ConfigError, match="shard s1: no endpoint; shard s3: nor here"):
        carrier.add_endpoints(entries)
    with pytest.raises(ConfigError, match=r"^no endpoint$"):
        carrier.add_endpoints(entries[:2])


def test_carrier_that_is_closed_while_it_connects_leaves_nothing_open(
    daemon, carry, endpoint, free, monkeypatch
):
    """The token of a session that was left open would show its client as present."""
    daemon(endpoint)
    before = list(zenoh_config._open_sessions)
    carrier = carry(endpoint)

    def opened_late(**settings):
        session = open_session(**settings)
        carrier.close()
        return session

    monkeypatch.setattr(zenoh_carrier, "open_session", opened_late)
    monkeypatch.setattr(zenoh_carrier, "REACH_S", 0.01)
    with pytest.raises(MisuseError):
        carrier.add_endpoints([ShardEntry("s1", (free(),))])

    assert zenoh_config._open_sessions == before


@both
def test_carrier_feeds_notices_of_shards_that_it_learns_of_later(
    daemon, carry, make_peer, endpoint, free, until
):
    """A feed opened before a shard was known has its notices too; its threads end with it."""
    second = free()
    daemon(endpoint)
    daemon(second, "s1")
    carrier = carry(endpoint)
    feed = carrier.subscribe()
    carrier.add_endpoints([ShardEntry("s1", (second,))])
    peer = speak(carrier, make_peer, shard="s1")

    notice = until(lambda: peer.write("cup", b"1") and feed.get(0.05))
    feed.close()

    assert notice.shard == "s1"
    assert "enact-notices" not in {thread.name for thread in threading.enumerate()}


def test_carrier_tells_when_a_shard_comes_into_reach_again(daemon, carry, endpoint):
    """Whoever waits for a restarted shard hears of it at once; the watching ends with the carrier."""
    running = daemon(endpoint)
    carrier = carry(endpoint)
    came = queue.Queue()
    carrier.on_reconnect(came.put)
    carrier.add_endpoints([ShardEntry("s0", (endpoint,))])
    assert came.get(timeout=30) == "s0"

    running.stop()
    daemon(endpoint)

    answer = None
    while answer is None:  # what it hears of the going may come as a return, once
        assert came.get(timeout=30) == "s0"
        answer = carrier.request("s0", ListLocks(), timeout_s=30)
    assert isinstance(answer, Locks)
    carrier.close()
    assert "enact-presence" not in {thread.name for thread in threading.enumerate()}


def test_shard_whose_watch_could_not_begin_is_watched_when_it_is_added_again(
    daemon, carry, endpoint, monkeypatch
):
    """There was no thread for it; its link stays."""
    daemon(endpoint)
    carrier, came = carry(endpoint), queue.Queue()
    carrier.on_reconnect(came.put)

    def refused(*_):
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patched:
        patched.setattr(zenoh_carrier, "ShardPresence", refused)
        with pytest.raises(RuntimeError):
            carrier.add_endpoints([ShardEntry("s0", (endpoint,))])
    carrier.add_endpoints([ShardEntry("s0", (endpoint,))])

    assert came.get(timeout=30) == "s0"


@both
def test_carrier_keeps_its_link_when_a_shard_advertises_another_address(daemon, carry, endpoint):
    """A shard in reach stays reached although its advertised endpoint leads nowhere from here."""
    daemon(endpoint)
    carrier = carry(endpoint)

    carrier.add_endpoints([ShardEntry("s0", ("tcp/127.0.0.1:1",))])

    assert isinstance(carrier.request("s0", ListLocks(), timeout_s=30), Locks)


@both
def test_carrier_reconnects_by_itself_when_a_shard_comes_back(daemon, carry, endpoint, until):
    """After a restart at the same endpoint calls are answered again, by the new epoch."""
    before = daemon(endpoint)
    carrier = carry(endpoint)
    old = carrier.request("s0", ListLocks(), timeout_s=30)
    before.stop(drain_s=0.0)
    assert carrier.request("s0", ListLocks(), timeout_s=1) is None

    daemon(endpoint)

    new = until(lambda: carrier.request("s0", ListLocks(), timeout_s=1))
    assert new.epoch > old.epoch


@both
def test_carrier_wakes_pending_calls_when_it_is_closed(daemon, carry, endpoint):
    """A thread that waits for an answer gets None when another thread closes the carrier."""
    daemon(endpoint)
    carrier = carry(endpoint)
    answers = []
    begun = carrier.begin("s0", parked(carrier, 60.0), timeout_s=60)
    waiting = threading.Thread(target=lambda: answers.append(begun.wait()))
    waiting.start()
    feed = carrier.subscribe()

    carrier.close()
    waiting.join(30)

    assert answers == [None]
    assert feed.get(None) is None
    with pytest.raises(MisuseError, match="closed"):
        carrier.request("s0", ListLocks(), timeout_s=1)


# ---------------------------------------------------------------- a peer that misbehaves


@pytest.fixture
def impostor(endpoint):
    """A queryable of the test's own in place of a shard: `impostor(reply)`."""
    session = open_session(listen=[endpoint], lease_s=1.0)

    def serve(reply):
        session.declare_queryable("enact/cell/s0/*/*", reply, complete=True)

    yield serve
    close_session(session)


def test_carrier_raises_when_an_answer_cannot_be_read(impostor, carry, endpoint):
    """Garbage in place of an answer is a protocol error, not a crash and not an answer."""
    impostor(lambda query: query.reply(query.key_expr, b"", attachment=b"\xff\x00garbage"))

    with pytest.raises(ProtocolError):
        carry(endpoint).request("s0", ListLocks(), timeout_s=30)


def test_carrier_raises_when_a_request_comes_back_as_answer(impostor, carry, endpoint):
    """A frame that is no answer is refused by name."""
    impostor(
        lambda query: query.reply(query.key_expr, b"", attachment=encode_frame(ListLocks())[0])
    )

    with pytest.raises(ProtocolError, match="ListLocks"):
        carry(endpoint).request("s0", ListLocks(), timeout_s=30)


def test_carrier_raises_when_two_daemons_answer_one_request(impostor, carry, endpoint, until):
    """A second reply to a query is an alarm: two daemons serve one name."""
    header = encode_frame(Locks(1, ()))[0]

    def twice(query):
        query.reply(query.key_expr, b"", attachment=header)
        query.reply(query.key_expr, b"", attachment=header)

    impostor(twice)
    carrier = carry(endpoint)

    def alarmed():
        try:
            carrier.request("s0", ListLocks(), timeout_s=30)
        except ProtocolError as error:
            return str(error)
        return ""

    assert "two daemons" in until(alarmed)


def test_connection_for_large_data_is_awaited_no_longer_than_that_for_calls(
    daemon, endpoint, monkeypatch
):
    """Whoever has little patience closes as soon while either is under way."""
    daemon(endpoint)
    waits_s = []

    def noted(*, open_s=None, **options):
        waits_s.append(open_s)
        return open_session(open_s=open_s, **options)

    monkeypatch.setattr(zenoh_carrier, "open_session", noted)
    carrier = zenoh_carrier.ZenohCarrier("cell", "me", "me", [endpoint], ttl_s=2.0, open_s=1.5)
    carrier._links[0].bulk()
    carrier.close()

    assert waits_s == [1.5, 1.5]
