"""What an actor's own code is doing at this moment, visible to other threads.

An update that never returns cannot report anything.  `Doing` therefore records which method of the
actor runs, since when and under which lock.  If a method calls `sys.exit`, `Doing` raises an error
that names the place of the call.
"""

from __future__ import annotations

import contextlib
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING

from enact_dist.actor.running.user_code import place_of, place_of_thread
from enact_dist.errors import MisuseError
from enact_dist.link.clock import monotonic_ns

if TYPE_CHECKING:
    from collections.abc import Iterator

    from enact_dist.access.lock import Lock


@dataclass(frozen=True, slots=True)
class Call:
    """One call of a method of an actor that has not returned yet.

    Attributes:
        method: "start", "update" or "stop".
        about: " for ENTITY", or nothing.
        since_ns: When it began, by the monotonic clock.
        thread: Which thread is in it.
        lock: The lock that it runs under, if it runs under one.
        remains: What becomes of its result if the process is ended now.
    """

    method: str
    about: str
    since_ns: int
    thread: int
    lock: Lock | None
    remains: str

    @property
    def lock_lost(self) -> bool:
        """Whether it runs on after its lock was lost, so that nothing of it can be committed."""
        return self.lock is not None and self.lock.running and not self.lock.valid()

    def __str__(self) -> str:
        lasted_s = (monotonic_ns() - self.since_ns) / 1e9
        lost = " (lock lost)" if self.lock_lost else ""
        return f"{lasted_s:.1f} s in {self.method}{self.about}{lost}"


class Doing:
    """Which method of an actor runs.  The actor's thread enters and leaves; any thread looks.

    Args:
        actor: Name of the actor's class.

    Attributes:
        call: What runs now; None between the calls.
        between: Held while a method runs; a thread that holds it may change the actor.
    """

    __slots__ = ("_actor", "between", "call")

    def __init__(self, actor: str) -> None:
        self._actor = actor
        self.call: Call | None = None
        self.between = threading.Lock()

    @contextlib.contextmanager
    def inside(
        self, method: str, *, about: str = "", lock: Lock | None = None, remains: str = ""
    ) -> Iterator[None]:
        """Note that the block calls a method of the actor; arguments as for `Call`.

        Raises:
            MisuseError: The method called `sys.exit`, which would end the actor silently.
        """
        self.call = Call(method, about, monotonic_ns(), threading.get_ident(), lock, remains)
        try:
            with self.between:
                yield
        except SystemExit as error:
            raise MisuseError(
                f"{self._actor}.{method} called sys.exit({error.code!r}) at {place_of(error)};"
                " raise an exception if the actor cannot do its work, or return if it is done"
            ) from None
        finally:
            self.call = None

    def cut_off(self) -> str:
        """Return what would be cut off if the process ended now, and where the code stands."""
        call = self.call
        if call is None:
            return "between updates"
        remains = f"; {call.remains}" if call.remains else ""
        return f"{call}, at {place_of_thread(call.thread)}{remains}"
