"""The seam between a client and its shards: move one request and its answer.

A carrier decides nothing.  Rules that each one keeps:

- No answer (None) means *unknown*, never *not executed*: requests are idempotent, ask again.
- Many threads may use one carrier at once; a slow answer to one never delays another.
- It belongs to the process that opened it; after a fork it raises `MisuseError` in the child.
- It never blocks the interpreter's exit, even if it was not closed.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Final, Protocol, cast, get_args

from enact_dist.core.messages import Answer
from enact_dist.errors import ConfigError, LinkError, MisuseError, ProtocolError
from enact_dist.wire.frames import decode_frame

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from enact_dist.core.messages import Notice, Request, ShardEntry, Survey
    from enact_dist.link.notices import Skipped


_ANSWERS: Final = frozenset(get_args(Answer))


FORKED_REMEDY: Final = (
    "connect for the first time after the fork, or start the child with the 'spawn' method"
    " (multiprocessing.get_context('spawn'))"
)
"""What somebody does who wants to use a cell in a child process."""


def check_usable(pid: int, *, closed: bool) -> None:
    """Raise unless a carrier is open and belongs to this process.

    Args:
        pid: The process that opened it.
        closed: Whether `close` was called.

    Raises:
        MisuseError: It is closed or was opened before a fork.
    """
    if pid != os.getpid():
        raise MisuseError(
            f"this connection belongs to process {pid}, from which this one"
            f" ({os.getpid()}) was forked; {FORKED_REMEDY}"
        )
    if closed:
        raise MisuseError("the connection to this cell is closed; connect again")


def failure_of(failures: Mapping[str, Exception]) -> Exception:
    """Return the error of shards that could not be connected, which names all of them.

    It is a `ConfigError` only where each is one: of any other kind may pass.
    """
    if len(failures) == 1:
        return next(iter(failures.values()))
    text = "; ".join(f"shard {shard}: {error}" for shard, error in failures.items())
    for_good = all(isinstance(error, ConfigError) for error in failures.values())
    return ConfigError(text) if for_good else LinkError(text)


def read_answer(shard: str, header: bytes, payload: bytes | memoryview) -> Answer:
    """Return the answer that a shard's frame carries.

    Raises:
        ProtocolError: It cannot be read, or is no answer.
    """
    answer = decode_frame(header, payload)
    if type(answer) not in _ANSWERS:
        raise ProtocolError(f"shard {shard} answered with a {type(answer).__name__}")
    return cast("Answer", answer)


class NoticeFeed(Protocol):
    """Notices of all shards of a cell as they come; best effort, their numbers show gaps."""

    @property
    def dropped(self) -> int:
        """How many notices were dropped because the watcher did not take them in time."""

    @property
    def late_s(self) -> float:
        """How long the number of a notice of no interest may stay out."""

    def get(self, timeout_s: float | None) -> Notice | Skipped | None:
        """Return the next notice of interest, or which numbers were of none.

        `timeout_s` None waits until a notice comes or `close` is called; else None is returned
        after so long without one, or once closed.
        """

    def get_here(self) -> Notice | Skipped | None:
        """Return the next of those that are here already, None if there is none; never waits."""

    def not_beyond(self, shard: str, epoch: int, number: int) -> None:
        """Let notices after this number come: the shard says that it has sent no later one."""

    def close(self) -> None:
        """End the feed and wake a thread that waits in `get`; twice is harmless."""


class Begun(Protocol):
    """A request that was sent; exactly one of the methods is called, once."""

    def wait(self, into: memoryview | None = None) -> Answer | None:
        """Return the answer, or None if there was none in time.

        Args:
            into: Where the answer's data may be put, if they are exactly as long; then they are
                a view on it, and on a copy otherwise.

        Raises:
            ProtocolError: As `Carrier.request`.
        """

    def abandon(self) -> None:
        """Stop waiting for the answer."""


class Carrier(Protocol):
    """Moves requests to shards and brings back their answers."""

    @property
    def inside(self) -> bool:
        """Whether the only shard is in this process, where data need not travel."""

    @property
    def fetch_bytes(self) -> int:
        """How large a slice of a datum is asked for in one call, at most."""

    def request(self, shard: str, message: Request, *, timeout_s: float) -> Answer | None:
        """Send one request and return its answer, or None if there was none in time.

        None may come at once if the shard is known to be away; a caller pauses before it retries.

        Raises:
            ProtocolError: The peer sent what this version cannot read, or two daemons answered.
            MisuseError: The carrier is closed or was opened before a fork.
        """

    def request_all(
        self, requests: Sequence[tuple[str, Request]], *, timeout_s: float
    ) -> list[Answer | None]:
        """Send all requests before waiting for the first answer; answers in the same order.

        Raises:
            ProtocolError: As `request`.
            MisuseError: As `request`.
        """

    def begin(self, shard: str, message: Request, *, timeout_s: float) -> Begun:
        """Send one request that moves a slice of a large datum; its answer is waited for later.

        These travel so that nothing else waits behind them.  Many may be under way; those of one
        thread to one shard are best waited for in the order in which they were begun.

        Raises:
            ProtocolError: The request cannot travel.
            MisuseError: As `request`.
        """

    def subscribe(self, interest: Survey | None = None) -> NoticeFeed:
        """Open a feed of the notices of all shards, those of shards added later included.

        Args:
            interest: What is watched; None for everything.
        """

    def add_endpoints(self, entries: Sequence[ShardEntry]) -> None:
        """Connect to further shards, to all that can be; those already in reach stay as they are.

        Raises:
            ConfigError: An endpoint cannot be read.
            LinkError: Several cannot be connected, for the reasons that it names.
            MisuseError: As `request`.
        """

    def way_to(self, shard: str) -> str:
        """Return how calls to a shard travel now, for people: "zenoh", "socket", …."""

    def away(self, shard: str) -> bool:
        """Whether a shard is known to be out of reach; contacts no shard.

        Once it no longer is, what `tell_returns` was given is called.
        """

    def tell_returns(self, returned: Callable[[str], None]) -> None:
        """Call `returned` with the name of each shard that comes (back) into reach.

        From any thread; it must not wait.  A hint only: a carrier that cannot tell never calls it.
        """

    def endpoint_of(self, shard: str) -> str:
        """Return where the shard is expected, for messages to people."""

    def close(self) -> None:
        """End all connections and pending calls (they return None); twice is harmless."""
