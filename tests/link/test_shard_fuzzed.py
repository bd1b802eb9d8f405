"""Bytes that nobody should send, as raw queries to a live shard: refused, counted, and nobody hurt."""

import os
import random
import secrets
import sys
import threading
from pathlib import Path

import pytest
import zenoh

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.core.protocol import messages as m
from enact_dist.core.protocol.datum import Datum, LockId, Token
from enact_dist.errors import ProtocolError
from enact_dist.link.zenoh.config import close_session, open_session
from enact_dist.wire.frames import decode_frame, encode_frame
from enact_dist.wire.keys import request_key, verb_of
from enact_dist.wire.limits import FRAME_VERSION

sys.path.insert(0, str(Path(__file__).parents[1] / "wire"))
from fuzz.fuzzer import mutated
from fuzz.targets import join, split
from wire_samples import CLASSES, sample

QUERIES = int(os.environ.get("ENACT_FUZZ_QUERIES", "1500"))
AT_ONCE = 25
COUNT = Aspect("count", int)
BY_HAND = {m.Break, m.ForceAbort}
"""What only an operator sends, and what then really takes locks away."""


@pytest.fixture
def raw(endpoint, until):
    """A Zenoh session without any of our code: `ask(header, payload)` gives all its answers."""
    opened = []

    def ask(*frames):
        if not opened:
            opened.append(open_session(connect=(endpoint,), lease_s=30.0))
            ping, key = encode_frame(m.Ping())[0], request_key("cell", "s0", "ping", "fuzz")
            # The shard's queryable becomes known here some time after the connection.
            until(lambda: [*opened[0].get(key, attachment=ping, timeout=1.0)])
        sent = [
            opened[0].get(
                request_key("cell", "s0", verb(header, payload), "fuzz"),
                attachment=header,
                payload=payload,
                timeout=10.0,
                consolidation=zenoh.ConsolidationMode.NONE,
            )
            for header, payload in frames
        ]
        return [[(reply.ok.attachment, reply.ok.payload) for reply in replies] for replies in sent]

    yield ask
    for session in opened:
        close_session(session)


def verb(header, payload):
    """Return the verb of the message that these bytes are; of what is none it does not matter."""
    kind = kind_of(header, payload)
    return verb_of(object.__new__(kind)) if kind in m.Request.__args__ else "hello"


def answer_of(replies):
    """Return the one answer among the replies to a query."""
    ((header, payload),) = replies
    return decode_frame(bytes(header), bytes(payload))


class Neighbour(threading.Thread):
    """A well-behaved client that counts one datum up without pause."""

    def __init__(self, endpoint):
        super().__init__(daemon=True)
        self.endpoint, self.ending, self.written, self.failure = (
            endpoint,
            threading.Event(),
            0,
            None,
        )

    def run(self):
        try:
            with connect(self.endpoint) as cell:
                request = Write(cell.world("online"), Entity("tray"), COUNT)
                while not self.ending.is_set():
                    with Lock(request, wait_s=10.0) as lock:
                        assert lock.get(request, 0) == self.written
                        lock[request] = self.written + 1
                    self.written += 1
        except BaseException as failure:
            self.failure = failure


def test_shard_refuses_rubbish_and_serves_its_neighbour(daemon, endpoint, raw, until):
    """Spoilt requests: each is answered, each refusal is counted, a client beside goes on."""
    seed = int(os.environ.get("ENACT_FUZZ_SEED", secrets.randbelow(10**6)))
    rng = random.Random(seed)
    shard = daemon(endpoint)
    neighbour = Neighbour(endpoint)
    neighbour.start()
    requests = [cls for cls in CLASSES if cls in m.Request.__args__ and cls not in BY_HAND]
    valid = [
        join(*(part or b"" for part in encode_frame(sample(cls, rng))))
        for cls in requests
        for _ in range(3)
    ]

    refused = others = 0
    for _ in range(QUERIES // AT_ONCE):
        spoilt = [mutated(rng.choice(valid), valid, rng)[:4096] for _ in range(AT_ONCE)]
        spoilt += [rng.randbytes(rng.randrange(60))]
        frames = [split(one, 2) for one in spoilt]
        kinds = [kind_of(*frame) for frame in frames]
        frames = [frame for frame, kind in zip(frames, kinds, strict=True) if kind not in BY_HAND]
        for frame, replies in zip(frames, raw(*frames), strict=True):
            assert len(replies) == 1, (seed, frame, replies)
            answer = answer_of(replies)
            is_request = kind_of(*frame) in m.Request.__args__
            refused += not is_request
            others += is_request
            unread = type(answer) is m.Refused and answer.code == "protocol"
            assert unread or is_request, (seed, frame, answer)
    until(lambda: neighbour.written > 20 or neighbour.failure, limit_s=60.0)
    neighbour.ending.set()
    neighbour.join(60)

    counters = shard.host._shard.counters
    assert neighbour.failure is None, (seed, neighbour.failure)
    assert counters["frames_refused"] == refused
    assert refused > QUERIES / 3
    assert others > 20
    assert shard.failure is None


def kind_of(header, payload):
    """Return the class of the message that these bytes are, None where they are none."""
    try:
        return type(decode_frame(header, payload))
    except ProtocolError:
        return None


def test_shard_hears_on_after_a_frame_that_breaks_the_decoder(daemon, endpoint, raw, monkeypatch):
    """Whatever leaves the decoder: the query is refused and the next one served."""
    shard = daemon(endpoint)

    def broken(header, payload):
        if header == b"breaks":
            raise RecursionError("nested without end")
        return decode_frame(header, payload)

    monkeypatch.setattr("enact_dist.link.zenoh.service.decode_request", broken)
    refused, answered = raw((b"breaks", b""), (encode_frame(m.ListLocks())[0], b""))

    assert answer_of(refused) == m.Refused("protocol", "nested without end")
    assert type(answer_of(answered)) is m.Locks
    assert shard.host._shard.counters["frames_refused"] == 1


def test_shard_hears_on_after_a_request_that_fails_before_the_core(
    daemon, endpoint, raw, monkeypatch
):
    """What the system refuses to one commit is no answer to it, and the next client gets his."""
    shard = daemon(endpoint)

    def fails(*_):
        raise OSError("the folder is gone")

    monkeypatch.setattr("enact_dist.link.host.names_payloads", fails)
    commit = encode_frame(m.Commit(LockId("session", 0, 1), Token(1, 1), (), 0))[0]
    *unanswered, answered = raw(*[(commit, b"")] * 3, (encode_frame(m.ListLocks())[0], b""))

    assert unanswered == [[]] * 3
    assert type(answer_of(answered)) is m.Locks
    assert shard.failure is None


def test_slices_that_wait_for_their_place_are_bounded(daemon, endpoint, raw, monkeypatch):
    """While one waits for room, those beyond the limit are dropped, counted, and asked again."""
    monkeypatch.setattr("enact_dist.link.zenoh.service.STAGED_BYTES_MAX", 100_000)
    shard, full = daemon(endpoint), threading.Event()
    take, count = shard.host._stage, shard.host.count

    def take_later(message, reply, identity, subject=None):
        full.wait(10)
        take(message, reply, identity, subject)

    def note(name, amount=1):
        count(name, amount)
        if shard.host._shard.counters.get("slices_dropped") == 3:
            full.set()

    monkeypatch.setattr(shard.host, "_stage", take_later)
    monkeypatch.setattr(shard.host, "count", note)
    stage = m.Stage("session", "session-1", 0, 80_000, Datum(b"", bytes(40_000), 40_000))
    replies = raw(*[encode_frame(stage)] * 5)

    assert full.is_set()
    assert [len(each) for each in replies] == [1, 1, 0, 0, 0]
    # Room is given back just after an answer is sent: asked at once, one may find none yet.
    again = ([len(each) for each in raw(*[encode_frame(stage)] * 2)] for _ in range(100))
    assert [1, 1] in again


@pytest.mark.parametrize("other", [FRAME_VERSION - 1, FRAME_VERSION + 1])
def test_client_of_another_version_is_refused_with_both_versions(daemon, endpoint, raw, other):
    """The shard says what came and what it speaks, whatever the rest of the frame is."""
    daemon(endpoint)
    header, _ = encode_frame(m.ListLocks())

    (replies,) = raw((header[:1] + bytes([other]) + header[2:], b""))

    answer = answer_of(replies)
    assert (type(answer), answer.code) == (m.Refused, "protocol")
    assert f"version {other} came; this side speaks {FRAME_VERSION}" in answer.text


CLIENT = """
import sys
from enact_dist.wire import frames
frames.FRAME_VERSION -= 1
frames._VERSION = bytes((frames.FRAME_VERSION,))
from enact_dist import connect
connect(sys.argv[1])
"""


def test_program_of_another_release_is_told_both_versions(daemon, endpoint, program):
    """What its user reads is a named error with both versions and the remedy."""
    daemon(endpoint)

    client = program(CLIENT, endpoint)

    _, said = client.communicate(timeout=180)
    assert client.returncode == 1
    assert "ProtocolError" in said
    assert f"version {FRAME_VERSION} came; this side speaks {FRAME_VERSION - 1}" in said
    assert "run the same release of enact-dist on all hosts" in said
