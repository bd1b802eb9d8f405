"""The data of given versions from their shards, as far as these still know them.

The datum comes by a view as of a stamp: of what is retained, or was replaced within the last 2 s.
Who committed a version, and how large it is, its shard explains as long as it is retained.  As of
the largest stamp of a batch each slot shows its newest version of the batch, so there are as many
views as the busiest slot has versions, and one for a batch of different slots.
"""

from __future__ import annotations

from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.access.asking import versions_in
from enact_dist.core.protocol.messages import Explain, Item, SlotVersion
from enact_dist.errors import ForgottenError, LeaseLostError
from enact_dist.link.client.fetch import fetch_all
from enact_dist.terms import Access
from enact_dist.world.history import listed

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from enact_dist.access.session import Session
    from enact_dist.core.client.lock import MultiLock
    from enact_dist.core.client.plan import Reading
    from enact_dist.core.protocol.datum import Datum, Slot
    from enact_dist.core.protocol.messages import VersionEntry

VIEW_S: Final = 10.0
"""How long a view may last."""
EXPLAINED_MAX: Final = 64
"""So many versions are explained by one answer: each cause may name a thousand reads."""


class Wanted(NamedTuple):
    """One version that is to be recorded; sorted by stamp."""

    stamp_ns: int
    slot: Slot
    version: int
    shard: str


class View:
    """States as of one moment, whose data can be fetched.

    Attributes:
        states: What was asked for, with the shard and epoch that each comes from.
    """

    def __init__(self, session: Session, lock: MultiLock) -> None:
        self._session, self._lock = session, lock.lock
        self.states: tuple[Reading, ...] = tuple(lock.states)

    def fetch(self, readings: Sequence[Reading]) -> dict[Slot, Datum]:
        """Return the data of some of the states that are not null.

        Raises:
            LeaseLostError: A shard restarted since; the view is over.
            ShardUnreachableError: A shard does not answer.
        """
        return fetch_all(self._session.client, self._session.cache, self._lock, readings)


class Found(NamedTuple):
    """What a version is: a datum, or null for a reason."""

    null_reason: str
    datum: Datum | None


@contextmanager
def viewed(session: Session, items: Iterable[Item], *, at_ns: int = 0) -> Iterator[View]:
    """View data, as of a stamp if one is given; they can be fetched while the block runs.

    Raises:
        ForgottenError: A state as of `at_ns` has left its retention.
        LockTimeoutError: A commit stamped before is not decided yet.
        ShardUnreachableError: A shard does not answer.
    """
    client = session.client
    lock = client.acquire(items, wait_s=client.patience_s, hold_s=VIEW_S, past_ns=at_ns)
    try:
        yield View(session, lock)
    finally:
        client.release(lock)


def explained(session: Session, wanted: Sequence[Wanted]) -> dict[Wanted, VersionEntry]:
    """Return what the shards list of these versions: those that are retained, without data.

    Raises:
        ShardUnreachableError: A shard does not answer.
    """
    by_shard: dict[str, list[SlotVersion]] = {}
    for each in wanted:
        by_shard.setdefault(each.shard, []).append(SlotVersion(each.slot, each.version))
    calls = [
        (shard, Explain(tuple(versions[first : first + EXPLAINED_MAX])))
        for shard, versions in by_shard.items()
        for first in range(0, len(versions), EXPLAINED_MAX)
    ]
    found = {
        (state.slot, state.version, state.stamp_ns): entry
        for answer in map(versions_in, session.client.call_all(calls))
        for entry in answer.entries
        for state in (entry.state,)
    }
    keys = {each: (each.slot, each.version, each.stamp_ns) for each in wanted}
    return {each: found[key] for each, key in keys.items() if key in found}


def between(session: Session, slot: Slot, shard: str, first: int, last: int) -> list[Wanted]:
    """Return the versions of a slot from `first` to `last` that its history still has.

    Raises:
        ShardUnreachableError: The shard does not answer.
    """
    states = [entry.state for entry in listed(session, shard, slot)]
    return [
        Wanted(state.stamp_ns, slot, state.version, shard)
        for state in states
        if state.slot == slot and first <= state.version <= last
    ]


def found_of(session: Session, wanted: Sequence[Wanted]) -> dict[Wanted, Found]:
    """Return what these versions are; those that are forgotten are left out.

    Raises:
        ShardUnreachableError: A shard does not answer.
    """
    found: dict[Wanted, Found] = {}
    by_slot: dict[Slot, list[Wanted]] = {}
    for each in sorted(wanted):
        by_slot.setdefault(each.slot, []).append(each)
    while by_slot:
        newest = [versions.pop() for versions in by_slot.values()]
        by_slot = {slot: versions for slot, versions in by_slot.items() if versions}
        found |= _together(session, newest)
    return found


def _together(session: Session, wanted: Sequence[Wanted]) -> dict[Wanted, Found]:
    """Return versions of different slots by one view, or else one by one."""
    found: dict[Wanted, Found] = {}
    if len(wanted) > 1:
        with suppress(ForgottenError, LeaseLostError):
            found = _as_of(session, wanted, max(wanted).stamp_ns)
    for each in wanted:
        if each not in found:
            with suppress(ForgottenError, LeaseLostError):
                found |= _as_of(session, [each], each.stamp_ns)
    return found


def _as_of(session: Session, wanted: Sequence[Wanted], at_ns: int) -> dict[Wanted, Found]:
    items = [Item(int(Access.VIEW), *each.slot) for each in wanted]
    with viewed(session, items, at_ns=at_ns) as view:
        by_state = {(r.state.slot, r.state.version, r.state.stamp_ns): r for r in view.states}
        shown = {each: by_state.get((each.slot, each.version, each.stamp_ns)) for each in wanted}
        readings = {each: reading for each, reading in shown.items() if reading is not None}
        data = view.fetch([r for r in readings.values() if not r.state.null_reason])
        return {
            each: Found(reading.state.null_reason, data.get(each.slot))
            for each, reading in readings.items()
        }
