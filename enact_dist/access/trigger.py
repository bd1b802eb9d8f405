"""The reason why an actor's update runs, on its lock; a lock that you make yourself has none."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from enact_dist.errors import MisuseError

if TYPE_CHECKING:
    from enact_dist.access.newer import Newer
    from enact_dist.terms import Entity, View


class Triggered:
    """The part of `Lock` that an actor's runner fills in."""

    _entity: Entity | None = None
    _tick_ns = 0
    _newer: Newer | None = None

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
