"""Who connects to a shard over Zenoh reaches that shard, and through it nobody else."""

import contextlib
import json
import queue
import socket

import pytest
import zenoh

from enact_dist.core.protocol import messages as m
from enact_dist.link.zenoh.config import (
    ACCEPT_PENDING,
    close_session,
    listening_settings,
    open_session,
    session_config,
)
from enact_dist.link.zenoh.discovery import find_shards
from enact_dist.link.zenoh.endpoints import split_endpoint
from enact_dist.wire.frames import decode_frame, encode_frame
from enact_dist.wire.keys import notice_key, queryable_key, token_key

MODES = ("client", "peer", "router")


@pytest.fixture
def stranger(endpoint):
    """Open a bare session of a mode that is connected to the shard; closed after the test."""
    with contextlib.ExitStack() as opened:

        def connect(mode):
            settings = session_config(connect=(endpoint,), lease_s=30.0)
            settings.insert_json5("mode", json.dumps(mode))
            session = zenoh.open(settings)
            opened.callback(session.close)
            return session

        yield connect


@pytest.mark.parametrize("mode", MODES)
def test_stranger_neither_answers_nor_hears_nor_forges(
    daemon, carry, make_peer, endpoint, stranger, mode, until
):
    """Its queryable gets no request, its subscriptions no commit; its notices reach no watcher."""
    shard = daemon(endpoint)
    carrier, watcher = carry(endpoint), carry(endpoint)
    peer = make_peer(
        lambda name, one: carrier.request(name, one, timeout_s=30), session=carrier._session
    )
    foreign = stranger(mode)
    asked, spied = queue.SimpleQueue(), queue.SimpleQueue()
    answering = foreign.declare_queryable(
        queryable_key("cell", "s0"), lambda query: asked.put(str(query.key_expr)), complete=True
    )
    spying = [
        foreign.declare_subscriber("**", lambda sample: spied.put(str(sample.key_expr))),
        foreign.liveliness().declare_subscriber(
            token_key("cell", "*", "*"),
            lambda sample: spied.put(str(sample.key_expr)),
            history=True,
        ),
    ]
    tokens = [foreign.liveliness().declare_token(token_key("cell", "tester", "forged"))]
    feed = watcher.subscribe()
    until(lambda: shard._service._publisher.matching_status.matching)
    peer.hello()
    header, payload = encode_frame(m.Notice("s0", shard.host.epoch, 2**62, ()))
    for _ in range(20):
        foreign.put(notice_key("cell", "s0"), payload or b"", attachment=header)
        assert isinstance(peer.write("cup", b"1"), m.Committed)
    numbers = [feed.get(30).number for _ in range(20)]
    for each in (answering, *spying, *tokens):
        each.undeclare()

    assert numbers == list(range(1, 21))
    assert asked.empty()
    while not spied.empty():  # its own token it sees itself
        assert spied.get() == token_key("cell", "tester", "forged")
    assert {"s0"} == {found.shard for found in find_shards((endpoint,), timeout_s=30)}


def test_several_verbs_or_shards_at_once_never_reach_the_shard(daemon, endpoint, stranger, until):
    """A wildcard would let one query pass as many; a ping alone may ask whoever is there."""
    shard = daemon(endpoint)
    foreign = stranger("peer")
    header, _ = encode_frame(m.ListLocks())

    def ask(key, header=header):
        return [*foreign.get(key, attachment=header, timeout=10.0)]

    until(lambda: ask("enact/*/*/ping/me", encode_frame(m.Ping())[0]))
    submitted = []
    shard._service._submit = lambda message, call, _: (submitted.append(message), call.drop())
    keys = ("**", "enact/**", "enact/cell/s0/**", "enact/cell/*/list_locks/me", "enact/cell/**/me")

    assert [ask(key) for key in keys] == [[]] * len(keys)
    assert not submitted
    assert "frames_refused" not in shard.host._shard.counters


def test_older_release_learns_which_version_is_spoken(daemon, endpoint, stranger, until):
    """Its question who is there is answered with a refusal, so it finds whom to ask on."""
    daemon(endpoint)
    foreign = stranger("peer")
    header = encode_frame(m.AwaitStamp(0, 0))[0]
    old = header[:1] + bytes([6]) + header[2:]

    (reply,) = until(
        lambda: [*foreign.get("enact/*/*/await_stamp/anyone", attachment=old, timeout=10.0)]
    )

    assert str(reply.ok.key_expr) == "enact/cell/s0/await_stamp/anyone"
    assert "a frame of version 6 came" in decode_frame(bytes(reply.ok.attachment)).text


def test_silent_connections_keep_nobody_out(daemon, endpoint, carry):
    """Three hundred that never greet leave room for who does; Zenoh's own limit is a hundred."""
    daemon(endpoint)
    _, host, port = split_endpoint(endpoint)
    with contextlib.ExitStack() as silent:
        for _ in range(300):
            silent.enter_context(socket.create_connection((host, int(port))))

        answer = carry(endpoint).request("s0", m.Ping(), timeout_s=30)

    assert isinstance(answer, m.Pong)
    assert ACCEPT_PENDING > 300


def test_rules_belong_to_a_listening_session_only(endpoint):
    """They name the shard's own keys; Zenoh takes them for any names of cell and shard."""
    other = open_session(
        listen=(endpoint,), lease_s=1.0, more=listening_settings("cell.of-two", "left-1")
    )
    close_session(other)
    rules = listening_settings("cell", "s0")["access_control"]["rules"]
    allowed = {rule["id"]: rule["key_exprs"] for rule in rules}

    assert allowed == {
        "ask": ["enact/*/*/ping/*", "enact/*/*/await_stamp/*"],
        "requests": ["enact/cell/s0/*/*"],
        "tokens": ["enact/cell/@sessions/*/*"],
        "watch": ["enact/cell/@notices/*"],
        "answers": ["enact/cell/s0/**", "enact/*/*/ping/*", "enact/*/*/await_stamp/*"],
        "notices": ["enact/cell/@notices/s0"],
        "see": ["enact/cell/@sessions/*/*"],
    }
