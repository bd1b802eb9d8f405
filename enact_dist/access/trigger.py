"""Why an actor's update runs, as its lock shows it; a lock of your own has no trigger."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final
from weakref import ref

from enact_dist.errors import MisuseError
from enact_dist.terms import Entity, View

LOOK_S: Final = 0.1
"""How often a wait looks whether the actor is to stop."""
WHOLE: Final = ""
"""Key of the one pending run of an actor whose requests do not depend on the triggering entity."""


@dataclass(slots=True)
class Trigger:
    """One run to do: for which entity, and how often in a row it was refused before.

    `states` are the changes that it stands for: (index of the trigger request, entity) → state.
    `captured_ns` is the capture stamp of the set that it stands for, 0 if it is none; `members` the
    stamp of each datum of that set, 0 of one that is missing.
    """

    key: str
    entity: Entity
    refused: int = 0
    states: dict[tuple[int, str], Hashable] = field(default_factory=dict)
    captured_ns: int = 0
    members: tuple[int, ...] = ()


class Newer:
    """An event: the version was replaced or deleted, or the actor must stop.

    Any thread may check it at any rate: a check sends no message and holds no lock.  If an update
    has seen the event and returns, its outcome is the reason; otherwise its outcome is "done".

    Args:
        stop: Set when the actor is to stop.
    """

    def __init__(self, stop: threading.Event | None = None) -> None:
        self._stop = stop
        self._event = threading.Event()
        self._reason = ""
        self._owner = threading.get_ident()
        self._seen = False

    def set(self, reason: str) -> None:
        """Let it be seen; the first reason stays."""
        if not self._event.is_set():
            self._reason = reason
            self._event.set()

    def is_set(self) -> bool:
        """Return whether to end the motion now."""
        if not self._event.is_set() and self._is_to_stop():
            self.set("stopped")
        self._seen = self._seen or self._event.is_set()
        return self._event.is_set()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until it is set, or for `timeout_s`; return whether it is set."""
        end_s = float("inf") if timeout_s is None else time.monotonic() + timeout_s
        while not self.is_set():
            left_s = end_s - time.monotonic()
            if left_s <= 0:
                return False
            self._event.wait(min(left_s, LOOK_S))
        return True

    @property
    def reason(self) -> str:
        """Why it is set: "preempted" (a newer version), "cancelled" (deleted), "stopped"; or ""."""
        return self._reason if self.is_set() else ""

    def ended(self) -> str:
        """Return the outcome of an update that returned: "done", or the reason that it saw."""
        return self._reason if self._seen else "done"

    def _is_to_stop(self) -> bool:
        if self._stop is None:
            return False
        if threading.get_ident() == self._owner:
            return self._stop.is_set()  # the look of the actor's own thread is its sign of life
        return threading.Event.is_set(self._stop)


@dataclass(frozen=True, slots=True)
class LockStatistics:
    """Times and counts of one lock.

    Attributes:
        granted: Whether it was granted.
        waited_s: From asking to the grant.
        held_s: From the grant to the end of the block, or until now.
        shards: The shards that it locked.
        fetched: How many data were decoded.
    """

    granted: bool
    waited_s: float
    held_s: float
    shards: tuple[str, ...]
    fetched: int


class Leaves:
    """The `__exit__` of `Lock`, by which a lock knows whether its block runs.

    A Ctrl-C that waits for the end of a long computation in C is raised where `__exit__` begins,
    outside of any ``try`` in it.  Python does not call it again, but the ``with`` statement then
    drops the object that it got from here.  The thread's next lock then ends the one left behind.
    """

    def __get__(self, lock: Any, owner: type[Any]) -> Callable[..., None]:
        if lock is None:
            leave: Callable[..., None] = owner._leave  # noqa: SLF001 - it is `Lock`
            return leave
        leaving = partial(owner._leave, lock)  # noqa: SLF001
        if lock._lock is None and not lock._asking:  # noqa: SLF001 - it is not entered twice
            lock._open = ref(leaving)  # noqa: SLF001
        return leaving


class Triggered:
    """The part of `Lock` that an actor's runner fills in, and the end of its block."""

    __exit__ = Leaves()
    _open: ref[Any] | None = None
    _entity: Entity | None = None
    _tick_ns = 0
    _newer: Newer | None = None

    def _is_abandoned(self) -> bool:
        """Whether the ``with`` statement has ended without `__exit__`; see `Leaves`."""
        return self._open is not None and self._open() is None

    @property
    def entity(self) -> Entity:
        """The entity that triggered this update of an actor.

        Raises:
            MisuseError: The lock was not made for a triggering entity.
        """
        if self._entity is None:
            raise MisuseError(f"{self!r} was not made by a trigger, so no entity triggered it")
        return self._entity

    @property
    def tick_ns(self) -> int:
        """The time of the tick of `every_s` that this update serves, nanoseconds since 1970.

        Ticks are multiples of the period on every host, so sources with equal periods share their
        ticks.  All writes of the update carry the tick as capture stamp, unless `put` sets another.

        Raises:
            MisuseError: The lock was not made for a tick.
        """
        if not self._tick_ns:
            raise MisuseError(f"{self!r} was not made for a tick of every_s, so it has no tick_ns")
        return self._tick_ns

    @property
    def missing(self) -> tuple[View[Any], ...]:
        """The data that an actor's set with `least` runs without, as declared; see `Together`.

        Raises:
            MisuseError: No set triggered the update.
        """
        raise MisuseError(f"{self!r} was not made by a Together, so its set has no missing data")

    @property
    def newer(self) -> Newer:
        """An event: a newer version was committed, the version was deleted, or the actor must stop.

        For actors with ``once = True``.  Check it or wait on it in the loop of a motion, in any
        thread.

        Raises:
            MisuseError: The lock is not that of an update that acts once.
        """
        if self._newer is None:
            raise MisuseError(
                f"{self!r} has no `newer`: only an update with once = True can be preempted"
            )
        return self._newer

    def _stamp(self, stamp_ns: int | None) -> int:
        """Return the capture stamp of a datum that is written with `stamp_ns`."""
        return stamp_ns or 0
