"""The interface between a client and its shards: carry one request and its answer.

A carrier decides nothing.  Every carrier keeps these rules:

- No answer (None) means *unknown*, never *not executed*: requests are idempotent, so repeat them.
- Many threads may use one carrier at once; a slow answer never delays another thread.
- It belongs to the process that opened it; after a fork it raises `MisuseError` in the child.
- It never blocks the interpreter's exit, even without `close`.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Final, Protocol

from enact_dist.errors import ConfigError, LinkError, MisuseError

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable, Mapping, Sequence

    from enact_dist.core.protocol.messages import Answer, Notice, Request, ShardEntry, Survey
    from enact_dist.link.notices import Skipped


LOOK_S: Final = 0.1
"""How often a waiting thread looks at an interrupt."""
FORKED_REMEDY: Final = (
    "connect for the first time after the fork, or start the child with the 'spawn' method"
    " (multiprocessing.get_context('spawn'))"
)
"""What to do to use a cell in a child process."""


def check_usable(pid: int, *, closed: bool) -> None:
    """Raise unless a carrier is open and belongs to the process `pid`, which opened it.

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
    """Return the error for shards that could not be connected; it names all of them.

    It is a `ConfigError` only if every one is: any other kind may be temporary.
    """
    if len(failures) == 1:
        return next(iter(failures.values()))
    text = "; ".join(f"shard {shard}: {error}" for shard, error in failures.items())
    for_good = all(isinstance(error, ConfigError) for error in failures.values())
    return ConfigError(text) if for_good else LinkError(text)


class NoticeFeed(Protocol):
    """Notices of all shards of a cell; best effort, with numbers that show gaps."""

    @property
    def dropped(self) -> int:
        """How many notices were dropped because the watcher was too slow."""

    @property
    def late_s(self) -> float:
        """How late the numbers of notices without interest may be, in seconds."""

    def get(self, timeout_s: float | None) -> Notice | Skipped | None:
        """Return the next notice of interest, or the numbers of skipped ones.

        With `timeout_s` None, waits for a notice or `close`.  Returns None after the timeout or
        once closed.
        """

    def get_here(self) -> Notice | Skipped | None:
        """Return the next notice that has arrived already, or None; never waits."""

    def not_beyond(self, shard: str, epoch: int, number: int) -> None:
        """Accept notices after this number: the shard reports it as the last one sent."""

    def close(self) -> None:
        """End the feed and wake a thread that waits in `get`; idempotent."""


class Begun(Protocol):
    """A request that was sent; call exactly one of the methods, once."""

    def wait(self, into: memoryview | None = None) -> Answer | None:
        """Return the answer, or None if none came in time.

        Args:
            into: Buffer for the answer's data.  If their length matches, they become a view of it,
                otherwise a copy.

        Raises:
            ProtocolError: As `Carrier.request`.
        """

    def abandon(self) -> None:
        """Stop waiting for the answer."""


class Carrier(Protocol):
    """Moves requests to shards and brings back their answers."""

    @property
    def inside(self) -> bool:
        """Whether the only shard runs in this process, so that data are not copied."""

    @property
    def fetch_bytes(self) -> int:
        """The largest slice of a datum that one call requests, in bytes."""

    def request(
        self,
        shard: str,
        message: Request,
        *,
        timeout_s: float,
        interrupt: threading.Event | None = None,
    ) -> Answer | None:
        """Send one request and return its answer, or None if none came in time.

        None may come at once if the shard is known to be away; pause before a retry.  Over a
        socket, and within a process, None also comes within 0.1 s after `interrupt` is set.

        Raises:
            ProtocolError: The peer sent a message that this version cannot read, or two daemons
                answered.
            MisuseError: The carrier is closed or was opened before a fork.
        """

    def request_all(
        self, requests: Sequence[tuple[str, Request]], *, timeout_s: float
    ) -> list[Answer | None]:
        """Send all requests before waiting for the first answer; return them in order.

        Raises:
            ProtocolError: As `request`.
            MisuseError: As `request`.
        """

    def begin(self, shard: str, message: Request, *, timeout_s: float) -> Begun:
        """Send one request for a slice of a large datum; the caller awaits the answer later.

        No other message waits behind slices.  Many may be in flight; those of one thread to one
        shard are best awaited in the order in which they were sent.

        Raises:
            ProtocolError: The request cannot be sent.
            MisuseError: As `request`.
        """

    def subscribe(self, interest: Survey | None = None) -> NoticeFeed:
        """Open a feed of the notices of all shards, also of later ones; None: of everything."""

    def add_endpoints(self, entries: Sequence[ShardEntry]) -> None:
        """Connect to all further shards that can be reached; existing connections stay.

        Raises:
            ConfigError: An endpoint cannot be read.
            LinkError: Some cannot be connected; the message gives the reasons.
            MisuseError: As `request`.
        """

    def transport_of(self, shard: str) -> str:
        """Return how calls to a shard travel now, for people: "zenoh", "socket", …."""

    def away(self, shard: str) -> bool:
        """Whether a shard is known to be out of reach; contacts no shard.

        When it comes back, the callback given to `on_reconnect` is called.
        """

    def on_reconnect(self, returned: Callable[[str], None]) -> None:
        """Call `returned` with the name of each shard that comes (back) within reach.

        The call comes from any thread and must not block.  It is a hint: some carriers never call.
        """

    def endpoint_of(self, shard: str) -> str:
        """Return the shard's expected endpoint, for messages to people."""

    def reason_away(self, shard: str) -> str:
        """Return why a shard's certificate or ours is refused; empty if that is not the reason.

        Takes up to 0.5 s, so ask only for the error about a shard that does not answer.
        """

    def close(self) -> None:
        """End all connections and pending calls (they return None); idempotent."""
