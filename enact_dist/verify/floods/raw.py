"""Any message to any shard: the protocol spoken without a client around it.

`RawZenoh` and `RawSocket` send what they are given, keep no rule and believe nothing; what comes
back is counted by name in `tally`: the code of a refusal, else the class of the answer, or one of
`SILENT` and `ENDED`.
"""

from __future__ import annotations

import contextlib
import json
import secrets
import socket
import threading
import time
from collections import Counter
from typing import TYPE_CHECKING, Final

import zenoh

from enact_dist.core.protocol.messages import Answer, Hello, Refused, Request, Welcome
from enact_dist.errors import LinkError, ProtocolError
from enact_dist.link.memory.shared_folder import open_shared
from enact_dist.link.socket.frames import FrameKind, Stream, greeting_of, send_frame, wait_at_most
from enact_dist.link.socket.service import SOCKET_NAME
from enact_dist.link.zenoh.config import session_config
from enact_dist.wire.frames import decode_frame, encode_frame
from enact_dist.wire.keys import request_key, verb_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.config.types import CellConfig
    from enact_dist.link.zenoh.tls import KeyFiles

ACTOR: Final = "attacker"
SILENT: Final = "no answer"
"""Nothing came: lost, dropped, or still waiting when its time was over."""
ENDED: Final = "connection ended"
WINDOW: Final = 32
"""Requests under way at once: an attacker gains nothing by waiting for each answer."""
ANSWER_S: Final = 3.0
PARKED_S: Final = 60.0
CONNECT_S: Final = 20.0
LEASE_S: Final = 10.0
TTL_NS: Final = 30_000_000_000
"""Lease of the attacker's sessions."""


def hello(session: str, epoch: int = 0, *, actor: str = ACTOR) -> Hello:
    """Return the message that opens a session, or with the shard's epoch acknowledges it."""
    return Hello(session, epoch, TTL_NS, actor, "host", 1, False)


def fresh_session() -> str:
    """Return an identity that no session has."""
    return secrets.token_hex(16)


class RawZenoh:
    """A Zenoh session that sends any message on any key; a context manager.

    Args:
        config: The cell.
        mode: Of the session; a client of this project is a "peer".
        keys: The attacker's key, in a cell with keys.
    """

    def __init__(
        self, config: CellConfig, *, mode: str = "peer", keys: KeyFiles | None = None
    ) -> None:
        self.tally: Counter[str] = Counter()
        self._config = config
        endpoints = [e for shard in config.placement_map().shards for e in shard.endpoints]
        settings = session_config(connect=endpoints, lease_s=LEASE_S, keys=keys)
        settings.insert_json5("mode", json.dumps(mode))
        self.session = zenoh.open(settings)
        self._window = threading.Semaphore(WINDOW)

    def __enter__(self) -> RawZenoh:
        return self

    def __exit__(self, *_: object) -> None:
        self.session.close()  # type: ignore[no-untyped-call]  # as Zenoh's stub has it

    def key(self, shard: str, verb: str, actor: str = ACTOR) -> str:
        """Return the key of a request."""
        return request_key(self._config.name, shard, verb, actor)

    def welcome(
        self, shard: str, session: str, *, identity: str = ACTOR, actor: str = ACTOR
    ) -> Welcome:
        """Open a session under an identity; wait until the shard can be reached.

        Raises:
            LinkError: It stayed without an answer.
        """
        end_s = time.monotonic() + CONNECT_S
        while time.monotonic() < end_s:
            greeting = hello(session, actor=actor)
            answer = self.ask(shard, greeting, actor=identity, timeout_s=ANSWER_S)
            if isinstance(answer, Welcome):
                self.ask(shard, hello(session, answer.epoch, actor=actor), actor=identity)
                return answer
            time.sleep(0.05)
        raise LinkError(f"shard {shard} does not welcome the attacker")

    def ask(
        self,
        shard: str,
        message: Request,
        *,
        actor: str = ACTOR,
        timeout_s: float = ANSWER_S,
    ) -> Answer | None:
        """Send a message and return its answer; None if none came."""
        header, payload = encode_frame(message)
        replies = self.session.get(
            self.key(shard, verb_of(message), actor),
            payload=payload or b"",
            attachment=header,
            timeout=timeout_s,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        answers = [answer for reply in replies if (answer := _read(reply)) is not None]
        self._count(answers)
        return answers[0] if answers else None

    def post(
        self, shard: str, message: Request, *, actor: str = ACTOR, parked: bool = False
    ) -> None:
        """Send a message; wait for no answer, but while `WINDOW` others are under way.

        Args:
            shard: Where to.
            message: What to send.
            actor: The identity in its key.
            parked: It takes no place in the window: its answer may take `PARKED_S`.
        """
        header, payload = encode_frame(message)
        key = self.key(shard, verb_of(message), actor)
        self.post_frame(key, header, payload or b"", parked=parked)

    def post_frame(
        self,
        key: str,
        header: bytes,
        payload: bytes,
        *,
        parked: bool = False,
    ) -> None:
        """Send bytes on a key as `post` does."""
        answers: list[Answer] = []

        def ended() -> None:
            self._count(answers)
            if not parked:
                self._window.release()

        if not parked:
            self._window.acquire()
        self.session.get(
            key,
            zenoh.handlers.Callback(_into(answers), ended, indirect=False),
            payload=payload,
            attachment=header,
            timeout=PARKED_S if parked else ANSWER_S,
            consolidation=zenoh.ConsolidationMode.NONE,
        )

    def drain(self) -> None:
        """Wait until nothing of the window is under way."""
        for _ in range(WINDOW):
            self._window.acquire()
        self._window.release(WINDOW)

    def _count(self, answers: list[Answer]) -> None:
        for answer in answers:
            self.tally[word_of(answer)] += 1
        if not answers:
            self.tally[SILENT] += 1


def _into(answers: list[Answer]) -> Callable[[zenoh.Reply], None]:
    def take(reply: zenoh.Reply) -> None:
        answer = _read(reply)
        if answer is not None:
            answers.append(answer)

    return take


def _read(reply: zenoh.Reply) -> Answer | None:
    if reply.ok is None:
        return None
    with contextlib.suppress(ProtocolError):
        answer: Answer = decode_frame(  # type: ignore[assignment]  # whatever it is, it is counted
            bytes(reply.ok.attachment or b""), bytes(reply.ok.payload)
        )
        return answer
    return None


def word_of(answer: object) -> str:
    """Return under which word an answer is counted."""
    return answer.code if isinstance(answer, Refused) else type(answer).__name__


class RawSocket:
    """One connection to a shard's Unix socket; a context manager.

    Args:
        welcome: What the shard has said to a hello over Zenoh: it names the folder.
        tally: Where answers are counted.
        session: The session that the connection names in its greeting; empty: it sends no greeting.

    Raises:
        LinkError: The shard shares no folder with this process.
        OSError: The socket takes no connection.
    """

    def __init__(self, welcome: Welcome, tally: Counter[str], session: str = "") -> None:
        self._tally = tally
        folder = open_shared(welcome.shared, welcome.shared_nonce)
        self.connected = socket.socket(socket.AF_UNIX)
        try:
            self.connected.settimeout(None)
            wait_at_most(self.connected, socket.SO_RCVTIMEO, ANSWER_S)
            wait_at_most(self.connected, socket.SO_SNDTIMEO, ANSWER_S)
            self.connected.connect(folder.address(SOCKET_NAME))
        except OSError:
            self.connected.close()
            raise
        finally:
            folder.close()
        self._stream = Stream(self.connected)
        self.opened = bool(session) and self._open(session)

    def __enter__(self) -> RawSocket:
        return self

    def __exit__(self, *_: object) -> None:
        self.connected.close()

    def _open(self, session: str) -> bool:
        try:
            send_frame(self.connected, greeting_of(session, ACTOR), kind=FrameKind.OPEN)
            kind, _, _ = self._stream.receive()
        except (OSError, EOFError, ProtocolError):
            self._tally[ENDED] += 1
            return False
        if kind != FrameKind.OPENED:
            self._tally["connection refused"] += 1
        return kind == FrameKind.OPENED

    def ask(self, message: Request) -> Answer | None:
        """Send a message and return its answer; None if none came, or the connection ended."""
        header, payload = encode_frame(message)
        try:
            send_frame(self.connected, header, (payload,) if payload else ())
            _, header, body = self._stream.receive()
            answer: Answer = decode_frame(header, body)  # type: ignore[assignment]  # counted
        except BlockingIOError:
            self._tally[SILENT] += 1
            return None
        except (OSError, EOFError, ProtocolError):
            self._tally[ENDED] += 1
            return None
        self._tally[word_of(answer)] += 1
        return answer
