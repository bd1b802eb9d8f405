"""The lock of an update that acts at most once: held only while a version is claimed.

While it is held it is the lock of any update; `begin` is called after its commit, and from there on
the same object shows what was seen at the grant, holds nothing, and collects what is written.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from enact_dist.actor_lock import ActorLock
from enact_dist.errors import LeaseLostError, MisuseError
from enact_dist.lock import Lock
from enact_dist.reading import slot_of
from enact_dist.terms import View, Write
from enact_dist.wire.payload import decode_datum
from enact_dist.writing import Asked, Writing

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from enact_dist.core.datum import Datum, Slot
    from enact_dist.newer import Newer
    from enact_dist.outcome import Outcome
    from enact_dist.terms import Aspect
    from enact_dist.wire.payload import Encoded


class _Collected(Writing):
    """What an update writes while it holds no lock: kept until the outcome is written."""

    def put(self, slot: Slot, encoded: Encoded, shard_of: Callable[[Slot], str]) -> None:
        """Keep a value for the outcome's commit."""
        self.data[slot] = encoded.datum()

    def delete(self, slot: Slot) -> None:
        """Keep that a slot is to be null."""
        self.data[slot] = None

    def new(self, slot: Slot, asked: Asked, shard_of: Callable[[Slot], str]) -> Any:
        """Refuse to hand out memory of a shard: no lock holds it."""
        raise MisuseError(
            f"new() of {slot.entity}/{slot.aspect}: an update with once = True holds no lock, so it"
            " cannot fill a datum in place; create an array and put() it"
        )


class OnceLock(ActorLock):
    """See the module."""

    _outcome: Write[Outcome] | None = None
    _taken: Outcome | None = None
    _keeps = _lost = False

    def own(self, declared: Write[Outcome]) -> Write[Outcome]:
        """Return the bound form of the declared request of the outcomes."""
        return self._resolve(declared)

    def keep(self) -> None:
        """Fetch all that the update may look at; called while the lock is held."""
        self._keeps = True
        for request in self._requests:
            if request.access.each:
                dict(self[request])
            elif not self._is_null(slot_of(request)):
                self[request]

    def begin(self, outcome: Write[Outcome], taken: Outcome, newer: Newer) -> None:
        """Let `update` act on the version that was taken; the lock is over."""
        self._outcome, self._taken, self._newer = outcome, taken, newer
        self._writing = _Collected(self._session.client.payloads)

    def end(self) -> None:
        """Free the data; the update is over, or the version was not taken."""
        self._taken = None
        if self._lock is not None:  # else it was never granted
            super()._let_go()

    def written(self) -> Iterator[tuple[Write[Any], Any, int]]:
        """Yield what the update has written: request, value or None for null, capture stamp."""
        requests = {slot_of(one): one for one in self._requests if isinstance(one, Write)}
        for slot, datum in self._writing.data.items():
            request = requests[slot]
            if datum is None:
                yield request, None, 0
            else:
                yield request, _value(datum, request.aspect), datum.stamp_ns

    def _let_go(self) -> None:
        if not self._keeps:
            super()._let_go()

    def _use(self) -> None:
        if self._taken is None:
            super()._use()

    def _put(self, slot: Slot, aspect: Aspect[Any], datum: Any, stamp_ns: int | None) -> None:
        if self._taken is not None and self._outcome is not None and slot == slot_of(self._outcome):
            raise MisuseError(
                f"the framework writes {self._outcome!r} when the update ends; raise an exception"
                " to report a failure, and write other results to another aspect"
            )
        super()._put(slot, aspect, datum, stamp_ns)

    def expect(self, view: Any) -> None:
        """Refuse: an update with ``once = True`` does not commit under this lock."""
        if self._taken is not None:
            raise MisuseError("an update with once = True holds no lock and cannot expect a View")
        super().expect(view)

    def valid(self) -> bool:
        """Whether the actor may go on, as far as is known; while it is held, as `Lock.valid`."""
        return not self._lost if self._taken is not None else super().valid()

    def check(self) -> None:
        """Ask the shard whether this process still holds the version.

        Raises:
            LeaseLostError: Another process concluded that this one had ended, and wrote an outcome.
        """
        if self._taken is None or self._outcome is None:
            super().check()
            return
        view = View(self._outcome.world, self._outcome.entity, self._outcome.aspect)
        with Lock(view, wait_s=self._wait_s) as lock:
            found = lock.get(view)
        if found != self._taken:
            self._lost = True
            raise LeaseLostError(f"{self._outcome!r} is now {found!r}", cause="taken over")


def _value(datum: Datum, aspect: Aspect[Any]) -> Any:
    return decode_datum(datum, aspect.datum_type)
