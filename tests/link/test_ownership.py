"""Over either carrier: nobody speaks for another's session, and each message comes on its own key."""

import os
import re
import secrets
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

from enact_dist import Aspect, Durability, Entity, Lock, Write, connect
from enact_dist.core.protocol import messages as m
from enact_dist.core.protocol.datum import Datum, LockId, Position, Slot
from enact_dist.core.shard import on_view, owners
from enact_dist.core.state import sessions
from enact_dist.errors import PermissionDeniedError, ProtocolError
from enact_dist.link.memory import drafts
from enact_dist.link.memory.names import SERIES_MAX
from enact_dist.link.refusals import error_of
from enact_dist.link.socket import service as socket_service
from enact_dist.link.socket.carrier import SocketCarrier
from enact_dist.link.socket.frames import FrameKind, Stream, greeting_of, send_frame
from enact_dist.link.zenoh.access import new_session_id
from enact_dist.link.zenoh.config import MESSAGE_BYTES_MAX, close_session, open_session
from enact_dist.link.zenoh.queries import wait_connected
from enact_dist.wire.frames import decode_frame, encode_frame
from enact_dist.wire.keys import request_key, verb_of
from enact_dist.wire.limits import COMMIT_BYTES_MAX, FRAME_BYTES_MAX

PAGE = Path(__file__).parents[2] / "enact_dist" / "docs" / "security.md"
NOTHING, VOLATILE = Datum(b"", b"", 0), Durability.VOLATILE
both = pytest.mark.parametrize("carry", ["zenoh", "socket"], indirect=True)


def peer_over(carrier, make_peer):
    """Return the session of `carrier`, which has said hello over it."""
    session = getattr(carrier, "behind", carrier)._session
    peer = make_peer(lambda shard, one: carrier.request(shard, one, timeout_s=30), session=session)
    peer.hello()
    return peer


@pytest.fixture
def stranger(endpoint):
    """A bare Zenoh session: `ask(message, identity, verb=…)` gives the answer."""
    opened = []

    def ask(message, identity, *, verb=""):
        if not opened:
            opened.append(open_session(connect=(endpoint,), lease_s=30.0))
        header, payload = encode_frame(message)
        replies = opened[0].get(
            request_key("cell", "s0", verb or verb_of(message), identity),
            attachment=header,
            payload=payload,
            timeout=30.0,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        (reply,) = replies
        return decode_frame(bytes(reply.ok.attachment), bytes(reply.ok.payload))

    yield ask
    for session in opened:
        close_session(session)


@both
def test_stranger_takes_nothing_from_a_session(daemon, carry, make_peer, endpoint, stranger):
    """Its lock stays through release, goodbye and hello under its name, and its commit stands."""
    daemon(endpoint)
    victim = peer_over(carry(endpoint), make_peer)
    granted = victim.acquire("cup")
    forged = (
        m.Release(granted.lock),
        m.Goodbye(victim.session),
        m.Commit(granted.lock, granted.token, (), 0),
        m.Stage(victim.session, f"{victim.session}-1", 0, 9, Datum(b"", b"", 0)),
        m.Hello(victim.session, victim.epoch, 2_000_000_000, "eve", "h", 1, False),
    )
    refused = [stranger(message, "eve@h:1") for message in forged]
    committed = victim.commit(granted, "cup", b"1")

    assert [type(answer) for answer in refused] == [m.Refused] * len(forged)
    assert {answer.code for answer in refused} == {"permission"}
    assert all("tester" in answer.text and "eve@h:1" in answer.text for answer in refused)
    assert isinstance(error_of(refused[0]), PermissionDeniedError)
    assert isinstance(committed, m.Committed)


@both
def test_stranger_takes_nothing_after_a_restart_either(
    daemon, carry, make_peer, endpoint, stranger, tmp_path, until
):
    """Whose a session is lies in the shard's folder."""
    first = daemon(endpoint, folder=tmp_path)
    carrier = carry(endpoint)
    victim = peer_over(carrier, make_peer)
    first.stop(drain_s=0.0)
    daemon(endpoint, folder=tmp_path)
    alive = m.ListSessions()
    until(lambda: carrier.request("s0", alive, timeout_s=0.5), limit_s=30.0)

    hello = m.Hello(victim.session, 0, 2_000_000_000, "eve", "h", 1, False)

    assert isinstance(stranger(hello, "eve@h:1"), m.Refused)
    assert isinstance(stranger(m.Goodbye(victim.session), "eve@h:1"), m.Refused)
    victim.hello()
    victim.hello()  # in the new epoch: the grace is over
    assert isinstance(victim.write("cup", b"1"), m.Committed)


def test_message_on_the_key_of_another_verb_is_refused(daemon, endpoint, stranger):
    """Access rules that look at keys would let it pass as what it is not."""
    shard = daemon(endpoint)

    answer = stranger(m.ListLocks(), "eve@h:1", verb="survey")

    assert isinstance(answer, m.Refused)
    assert answer.text == "a list_locks arrived on the key of a survey"
    assert shard.host._shard.counters["frames_refused"] == 1


def test_decision_from_an_actor_is_refused(daemon, endpoint, stranger):
    """Only the shard that it names may send one."""
    daemon(endpoint)
    finish = m.Finish(LockId("somebody", 0, 1), Position(2**62, "far"))

    assert stranger(finish, "eve@h:1").code == "permission"
    assert isinstance(stranger(finish, "shard.far"), m.Finished)


def test_connection_speaks_for_its_own_session_only(raw, make_peer):
    """Not for that of another connection, of the same user even; decisions do not come this way."""
    from socket_parts import ask

    near, other = raw("mine"), raw("yours")
    hello = m.Hello("yours", 0, 2_000_000_000, "you", "h", 1, False)
    welcome = ask(other, hello)
    forged = [ask(near, m.Goodbye("yours")), ask(near, m.KeepAlive("yours", 1, 1, (), b""))]
    finish = ask(near, m.Finish(LockId("yours", 0, 1), Position(1, "far")))
    sessions = ask(other, m.ListSessions())

    assert isinstance(welcome, m.Welcome)
    assert {answer.code for answer in (*forged, finish)} == {"permission"}
    assert [session.session for session in sessions.sessions] == ["yours"]


def test_connection_in_the_name_of_a_shard_is_refused(raw):
    """Shards call each other over Zenoh, where a certificate proves their name."""
    near = raw(greet=False)
    send_frame(near, greeting_of("mine", "shard.far"), kind=FrameKind.OPEN)

    kind, header, _ = Stream(near).receive()

    assert kind == FrameKind.REFUSED
    assert b"called itself shard.far; shards call each other over Zenoh" in bytes(header)
    actor = raw(greet=False)  # an actor of such a name is none
    send_frame(actor, greeting_of("mine", "shard.far@h:1"), kind=FrameKind.OPEN)
    assert Stream(actor).receive()[0] == FrameKind.OPENED


@both
def test_stranger_uses_up_no_data_that_wait_for_their_commit(
    daemon, carry, make_peer, endpoint, stranger
):
    """A commit that is refused because of who sends it takes no staged data with it."""
    daemon(endpoint)
    victim = peer_over(carry(endpoint), make_peer)
    granted = victim.acquire("cup")
    file, body = f"{victim.session}-1", bytes(100_000)
    slice_ = Datum(b"", body, len(body))
    victim.call("s0", m.Stage(victim.session, file, 0, len(body), slice_))
    named = Datum(b"\x01", b"", len(body), file=file)
    writes = (m.WriteItem(Slot("online", "cup", "count"), named),)
    commit = m.Commit(granted.lock, granted.token, writes, 0)

    refused = stranger(commit, "eve@h:1")

    assert refused.code == "permission"
    assert isinstance(victim.call("s0", commit), m.Committed)


GREETS_AND_ENDS = """
import socket, sys
from enact_dist.link.socket.frames import FrameKind, Stream, greeting_of, send_frame
near = socket.socket(socket.AF_UNIX)
near.connect(sys.argv[1])
send_frame(near, greeting_of(sys.argv[2], "eve@h:1"), kind=FrameKind.OPEN)
kind, text, _ = Stream(near).receive()
print(int(kind), text.decode(), flush=True)
"""


@pytest.mark.carrier("socket")
@pytest.mark.parametrize("carry", ["zenoh"], indirect=True)
def test_process_that_greets_for_a_session_of_zenoh_does_not_end_it_with_its_own(
    daemon, carry, make_peer, endpoint, program
):
    """The end of a process ends its own sessions; nobody opens a socket for another's."""
    shard = daemon(endpoint)
    victim = peer_over(carry(endpoint), make_peer)
    granted = victim.acquire("cup")

    eve = program(GREETS_AND_ENDS, shard._shared.path / "socket", victim.session)
    said, _ = eve.communicate(timeout=30)
    kind, _, text = said.strip().partition(" ")
    assert int(kind) == FrameKind.REFUSED
    assert "eve@h:1" in text
    assert "may not speak for it" in text
    assert isinstance(victim.commit(granted, "cup", b"1"), m.Committed)


KNOWS_ALL_BUT_THE_SECRET = """
import socket, sys
from enact_dist.link.socket.frames import FrameKind, Stream, greeting_of, send_frame
for secret in ("", "0" * 32):
    near = socket.socket(socket.AF_UNIX)
    near.connect(sys.argv[1])
    send_frame(near, greeting_of(sys.argv[2], sys.argv[3], secret), kind=FrameKind.OPEN)
    kind, text, _ = Stream(near).receive()
    print(int(kind), text.decode(), flush=True)
"""


def refused_eve(program, shard, session, identity):
    """Whether a process that knows all that listings show is refused, by name; it has ended."""
    eve = program(KNOWS_ALL_BUT_THE_SECRET, shard._shared.path / "socket", session, identity)
    lines = eve.communicate(timeout=30)[0].splitlines()
    said = f"process {eve.pid} of user {os.geteuid()} does not know the secret of session"
    return [line.startswith(f"{int(FrameKind.REFUSED)} {said}") for line in lines] == [True, True]


@pytest.mark.carrier("socket")
def test_process_that_comes_before_the_owner_neither_ends_nor_bars_its_session(
    daemon, carry, make_peer, endpoint, program
):
    """With its id and its name, where the shard has not met it yet."""
    shard, secret = daemon(endpoint), secrets.token_hex(16)
    session = new_session_id("tester", secret)

    assert refused_eve(program, shard, session, "tester")
    behind = carry(endpoint, session=session)
    victim = peer_over(SocketCarrier(behind, session, "tester", secret, forced=True), make_peer)
    granted = victim.acquire("cup")
    assert refused_eve(program, shard, session, "tester")

    assert isinstance(victim.commit(granted, "cup", b"1"), m.Committed)
    assert "sessions_died" not in shard.host.figures()


@pytest.mark.carrier("socket")
def test_process_neither_ends_nor_bars_a_session_that_has_no_socket_open(
    daemon, endpoint, program, monkeypatch
):
    """A client of the library over Zenoh; then one over the socket, in the same way."""
    shard = daemon(endpoint)
    for way in ("zenoh", "socket"):
        monkeypatch.setenv("ENACT_CARRIER", way)
        with connect(endpoint, actor="victim") as cell:
            count = Write(cell.world("online"), Entity("cup"), Aspect("count", int, VOLATILE))
            with Lock(count) as lock:
                session = cell.actors()[0].session
                assert refused_eve(program, shard, session, shard.host.owner_of(session))
                lock[count] = 1
    assert "sessions_died" not in shard.host.figures()


@both
def test_data_given_up_in_the_name_of_no_session_take_no_place(
    daemon, carry, make_peer, endpoint, stranger
):
    """What a shard remembers of late slices stays that of its clients."""
    shard = daemon(endpoint)
    victim = peer_over(carry(endpoint), make_peer)
    given_up = m.Stage(victim.session, f"{victim.session}-1", 0, 0, NOTHING)
    assert isinstance(victim.call("s0", given_up), m.Staged)
    for number in range(SERIES_MAX + 1):
        file = f"ghost{number}-1"
        assert stranger(m.Stage(f"ghost{number}", file, 0, 0, NOTHING), "eve@h:1").file == file
    late = replace(given_up, total=100_000)

    assert victim.call("s0", late).have == 100_000  # a late copy that no client waits for
    assert shard.host.figures()["payload_drafts"] == 0


RELEASES_ANOTHERS = """
import socket, sys
from enact_dist.core.protocol.datum import LockId
from enact_dist.core.protocol.messages import Release
from enact_dist.link.socket.frames import FrameKind, Stream, greeting_of, send_frame
from enact_dist.wire.frames import decode_frame, encode_frame
near = socket.socket(socket.AF_UNIX)
near.connect(sys.argv[1])
stream = Stream(near)
send_frame(near, greeting_of("e" * 32, sys.argv[3]), kind=FrameKind.OPEN)
stream.receive()
send_frame(near, encode_frame(Release(LockId(sys.argv[2], 0, 1)))[0])
_, header, payload = stream.receive()
print(decode_frame(header, payload).code, flush=True)
"""


@pytest.mark.carrier("socket")
@both
def test_process_that_takes_anothers_name_releases_none_of_its_locks(
    daemon, carry, make_peer, endpoint, program
):
    """The kernel says that it is another process; two sessions of one process may do that."""
    shard = daemon(endpoint)
    victim = peer_over(carry(endpoint), make_peer)
    granted = victim.acquire("cup")

    eve = program(RELEASES_ANOTHERS, shard._shared.path / "socket", victim.session, "tester")
    said, _ = eve.communicate(timeout=30)

    assert said.strip() == "permission"
    assert isinstance(victim.commit(granted, "cup", b"1"), m.Committed)


@both
def test_commit_that_carries_more_than_it_may_is_refused_and_the_lock_stays(
    daemon, carry, make_peer, endpoint
):
    """By name, with what to do; up to the bound it is taken, and beyond it in slices."""
    daemon(endpoint)
    peer = peer_over(carry(endpoint), make_peer)
    granted = peer.acquire("cup")

    refused = peer.commit(granted, "cup", bytes(COMMIT_BYTES_MAX + 1))
    taken = peer.commit(granted, "cup", bytes(COMMIT_BYTES_MAX))
    large = peer.write_in_slices("cup", bytes(COMMIT_BYTES_MAX + 1))

    assert isinstance(refused, m.Refused)
    assert (refused.code, "in slices (Stage)" in refused.text) == ("protocol", True)
    assert isinstance(taken, m.Committed)
    assert isinstance(large, m.Committed)


def test_identity_of_a_commit_is_compared_once(daemon, carry, make_peer, endpoint, monkeypatch):
    """Only one that names data sent ahead of it is looked at before they are taken, too."""
    daemon(endpoint)
    peer = peer_over(carry(endpoint), make_peer)
    kinds = []
    refusal = owners.refusal
    monkeypatch.setattr(
        owners, "refusal", lambda *words: (kinds.append(type(words[0])), refusal(*words))[1]
    )

    assert isinstance(peer.commit(peer.acquire("cup"), "cup", b"1"), m.Committed)

    assert kinds.count(m.Commit) == 1


def test_frame_beyond_the_bound_is_not_kept_and_the_next_one_served(daemon, endpoint, stranger):
    """A client cannot even send one; what somebody else sends Zenoh does not keep."""
    daemon(endpoint)
    assert isinstance(stranger(m.Ping(), "eve@h:1"), m.Pong)
    with pytest.raises(ProtocolError, match="in one message; write fewer at once"):
        slice_ = Datum(b"", bytes(FRAME_BYTES_MAX), FRAME_BYTES_MAX)
        encode_frame(m.Stage("s", "s-1", 0, FRAME_BYTES_MAX, slice_))
    session = open_session(connect=(endpoint,), lease_s=30.0)
    wait_connected(session, 30.0)
    replies = session.get(
        request_key("cell", "s0", "ping", "eve@h:1"),
        attachment=encode_frame(m.Ping())[0],
        payload=bytes(MESSAGE_BYTES_MAX + 1),
        timeout=1.0,
    )
    answered = [reply for reply in replies if reply.ok is not None]
    close_session(session)

    assert not answered
    assert isinstance(stranger(m.Ping(), "eve@h:1"), m.Pong)


def test_page_on_security_says_the_bounds_that_hold():
    """Each figure of its table is that of the code."""
    rows = dict(re.findall(r"^\| ([^|]+) \| ([^|]+) \|", PAGE.read_text("utf-8"), re.MULTILINE))
    held = {
        "sessions of one process": owners.SESSIONS_MAX,
        "sessions of a shard": sessions.SESSIONS_MAX,
        "locks that one process holds or awaits": owners.WAITERS_MAX,
        "socket connections": socket_service.PROCESS_CONNECTIONS_MAX,
        "waiting questions": on_view.OF_A_SESSION_MAX,
        "one message": FRAME_BYTES_MAX >> 20,
        "data sent with their commit": COMMIT_BYTES_MAX >> 20,
    }
    said = {what: int(rows[what].split()[0].replace(",", "")) for what in held}

    assert said == held
    assert f"{socket_service.KEPT_FREE} of {socket_service.CONNECTIONS_MAX:,} are free" in str(rows)
    assert drafts.SHARES == 4
