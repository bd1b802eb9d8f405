"""Short lives of a shard under hostile frames, and what is wrong with them.

A life is either the core alone, with a ledger for its disk and time that moves when told, so that
its seed repeats it exactly; or a whole host with a store, a folder of large data and real time.
"""

from __future__ import annotations

import random
import shutil
import tempfile
import threading
import time
import traceback
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast

from enact_dist.core.offline.ledger import Ledger
from enact_dist.core.protocol.datum import Token
from enact_dist.core.protocol.messages import (
    AspectEntry,
    Granted,
    Hello,
    PlacementMap,
    Register,
    Resolve,
    ShardEntry,
)
from enact_dist.core.protocol.records import (
    Call,
    Called,
    Drain,
    Persist,
    Persisted,
    Publish,
    Recovered,
    Reply,
    Tick,
)
from enact_dist.core.shard.owners import shard_identity
from enact_dist.core.shard.shard import Shard
from enact_dist.core.shard.state import ShardSettings
from enact_dist.errors import ProtocolError
from enact_dist.link.memory.shared_folder import SharedFolder
from enact_dist.link.opening import open_host
from enact_dist.verify.frames.hostile import SESSIONS, Hostile
from enact_dist.wire.frames import decode_frame, encode_frame

if TYPE_CHECKING:
    from enact_dist.core.protocol.datum import LockId
    from enact_dist.core.protocol.messages import Answer, Request
    from enact_dist.core.protocol.records import Effect, Event, Record

FRAMES: Final = 60
"""Frames of one life."""
STORE_EVERY: Final = 16
"""So many lives are the core alone, then comes one with a store."""
ANSWER_S: Final = 20.0
"""A host that drains answers everything in this time."""
MS: Final = 1_000_000
WALL_NS: Final = 1_800_000_000_000_000_000
SETTINGS: Final = ShardSettings(
    "s0",
    PlacementMap(1, (ShardEntry("s0", ()), ShardEntry("far", ())), ()),
    worlds=("online", "training"),
)
ASPECTS: Final = (
    AspectEntry("count", "int", "durable"),
    AspectEntry("note", "int", "os"),
    AspectEntry("frame", "int", "volatile"),
)
IDENTITIES: Final = (*[""] * 20, *SESSIONS, shard_identity("far"))
"""Most come from this process itself, which owns both sessions; the others own nothing."""


class BrokenLife(Exception):
    """A rule that was broken; its text says which, and by which frame."""


@dataclass(slots=True)
class LifeTally:
    """What lives have shown.

    Attributes:
        lives: How many there were.
        frames: Legal frames that a shard has handled.
        illegal: Messages that the wire refused to carry.
        asked: How many requests of each kind.
        answers: How many answers of each kind.
        restarts: How often a shard was started again from what it had kept.
        with_store: Lives of a whole host with a store.
    """

    lives: int = 0
    frames: int = 0
    illegal: int = 0
    restarts: int = 0
    with_store: int = 0
    asked: Counter[str] = field(default_factory=Counter)
    answers: Counter[str] = field(default_factory=Counter)


def live(seed: int, tally: LifeTally) -> None:
    """Let one shard live under the frames of a seed.

    Raises:
        Broken: An exception came out, an answer cannot be sent, or a request stayed unanswered.
    """
    tally.lives += 1
    life = _StoreLife if seed % STORE_EVERY == STORE_EVERY - 1 else _CoreLife
    life(seed, tally).run()


def _greetings() -> list[Request]:
    hellos = [Hello(name, 0, 2_000 * MS, name, "host", 1, False) for name in SESSIONS]
    return [*hellos, Register("ann", (), ASPECTS)]


class _Life:
    """What both kinds of lives share: frames go out and answers come back as on the wire."""

    def __init__(self, seed: int, tally: LifeTally) -> None:
        self.random = random.Random(seed)
        self.hostile = Hostile(self.random)
        self.tally = tally
        self.grants: dict[LockId, Granted] = {}
        self.waits: dict[int, Request] = {}
        self.now: object = None
        self._mutex = threading.Lock()
        self._handles = 0

    def run(self) -> None:
        """Live."""
        try:
            self.live()
        except BrokenLife:
            raise
        except Exception as error:
            trace = traceback.format_exc()
            raise BrokenLife(f"{error!r} at {_shown(self.now)}\n{trace}") from error

    def live(self) -> None:
        """Send the frames and judge what comes of them."""
        raise NotImplementedError

    def frame(self, request: Request) -> Request | None:
        """Return a request as it arrives at the shard, None where the wire carries no such one."""
        try:
            header, payload = encode_frame(request)
            arrived = decode_frame(header, bytes(payload) if payload is not None else b"")
        except ProtocolError:
            self.tally.illegal += 1
            return None
        self.now = arrived
        self.tally.frames += 1
        self.tally.asked[type(arrived).__name__] += 1
        return cast("Request", arrived)

    def handle_for(self, request: Request) -> int:
        """Return where the answer of a request goes."""
        self._handles += 1
        self.waits[self._handles] = request
        return self._handles

    def answered(self, handle: int, answer: Answer) -> None:
        """Judge an answer; called from any thread."""
        with self._mutex:
            asked = self.waits.pop(handle, None)
            if asked is None:
                raise BrokenLife(f"answered twice: {_shown(answer)}")
            try:
                header, payload = encode_frame(answer)
                decode_frame(header, bytes(payload) if payload is not None else b"")
            except Exception as error:
                said = f"{_shown(answer)} to {_shown(asked)}"
                raise BrokenLife(f"an answer cannot be sent ({error!r}): {said}") from error
            self.tally.answers[type(answer).__name__] += 1
            if isinstance(answer, Granted):
                self.grants[answer.lock] = answer

    def judge_the_end(self) -> None:
        """Find requests that were never answered."""
        if self.waits:
            left = "; ".join(_shown(request) for request in list(self.waits.values())[:3])
            raise BrokenLife(f"{len(self.waits)} requests stayed unanswered: {left}")


class _CoreLife(_Life):
    """The core alone: time and disk advance on command."""

    def live(self) -> None:
        self.now_ns, self.wall_ns = 1_000_000 * MS, WALL_NS
        self.log: list[Record] = []
        self.pending: list[Persist] = []
        self._start(Recovered(1))
        for request in _greetings():
            self._ask(request, "")
            self._finish_disk()
        for _ in range(FRAMES):
            self._step()
        self.shard.assert_invariants()
        self._give(Drain(), 0)
        self._finish_disk()
        self._pass(2_000 * MS)
        self.judge_the_end()
        self._start(Ledger(self.log).recovered(self.shard.epoch + 1))
        self.tally.restarts += 1

    def _start(self, recovered: Recovered) -> None:
        self.shard = Shard(SETTINGS, recovered, now_ns=self.now_ns, wall_ns=self.wall_ns)

    def _step(self) -> None:
        dice = self.random.random()
        if dice < 0.08:
            self._pass(self.random.choice((1, 50, 400, 2_500)) * MS)
        elif dice < 0.12:
            word = self.hostile.word_of_another_shard(self.grants)
            self.now = word
            asked = Resolve(word.lock, Token(1, 1), "s0")
            self._give(Called("far", asked, word), 0)
        else:
            request = self.frame(self.hostile.request(self.grants))
            if request is not None:
                self._ask(request, self.random.choice(IDENTITIES))
        if self.random.random() < 0.7:
            self._finish_disk()

    def _pass(self, ns: int) -> None:
        self.now_ns += ns
        self.wall_ns += ns
        self._give(Tick(), 0)

    def _ask(self, request: Request, identity: str) -> None:
        self._give(request, self.handle_for(request), identity)

    def _give(self, message: Request | Event, handle: int, identity: str = "") -> None:
        effects = self.shard.handle(
            message,
            reply_to=handle,
            identity=identity,
            now_ns=self.now_ns,
            wall_ns=self.wall_ns,
        )
        for effect in effects:
            self._perform(effect)
        deadline_ns = self.shard.next_deadline_ns()
        if not isinstance(deadline_ns, int):
            raise BrokenLife(f"the next deadline is {deadline_ns!r}")

    def _perform(self, effect: Effect) -> None:
        if isinstance(effect, Reply):
            self.answered(effect.reply_to, cast("Answer", effect.answer))
        elif isinstance(effect, Persist):
            self.pending.append(effect)
        elif isinstance(effect, Call):
            _sent(effect.request)
        elif isinstance(effect, Publish):
            _sent(effect.notice)

    def _finish_disk(self) -> None:
        while self.pending:
            persist = self.pending.pop(0)
            self.log += persist.records
            if persist.ticket:
                self._give(Persisted(persist.ticket), 0)


class _StoreLife(_Life):
    """A whole host: a store, large data and real time; it starts again from its folder."""

    def live(self) -> None:
        self.tally.with_store += 1
        self.broken: BrokenLife | None = None
        memory = Path("/dev/shm")  # noqa: S108 - a folder of its own in there
        with ExitStack() as undo:
            place = memory if memory.is_dir() else None
            folder = Path(tempfile.mkdtemp(prefix="enact-frames-", dir=place))
            undo.callback(shutil.rmtree, folder, ignore_errors=True)
            (folder / "shared").mkdir()
            shared = SharedFolder("frames", "s0", root=folder / "shared")
            undo.callback(shared.close)
            host = open_host(SETTINGS, folder / "s0", shared=shared, payload_bytes_max=1 << 20)
            undo.callback(host.close)
            host.watch(_sent)
            host.call_with(lambda _, request: _sent(request))
            for request in _greetings():
                self._submit(host, request, "")
                self._wait()
            for _ in range(FRAMES):
                arrived = self.frame(self.hostile.request(self.grants))
                if arrived is not None:
                    self._submit(host, arrived, self.random.choice(IDENTITIES))
                if host.failure is not None:
                    raise BrokenLife(f"the host failed: {host.failure!r} at {_shown(self.now)}")
                if self.random.random() < 0.2:
                    host.event(Tick())
            host.drain()
            self._wait()
            if host.failure is not None:
                raise BrokenLife(f"the host failed: {host.failure!r}")
            host.close()
            open_host(SETTINGS, folder / "s0").close()
            self.tally.restarts += 1

    def _submit(self, host: object, request: Request, identity: str) -> None:
        handle = self.handle_for(request)

        def reply(answer: Answer) -> None:
            try:
                self.answered(handle, answer)
            except BrokenLife as broken:  # in a thread of the host, perhaps
                self.broken = self.broken or broken

        host.submit(request, reply, identity)  # type: ignore[attr-defined]

    def _wait(self) -> None:
        end_s = time.monotonic() + ANSWER_S
        while self.waits and self.broken is None and time.monotonic() < end_s:
            time.sleep(0.005)
        if self.broken is not None:
            raise self.broken
        self.judge_the_end()


def _sent(message: object) -> None:
    encode_frame(message)  # type: ignore[arg-type]  # a message of the protocol


def _shown(message: object) -> str:
    text = repr(message)
    return text if len(text) <= 2000 else f"{text[:2000]}… ({len(text)} characters)"
