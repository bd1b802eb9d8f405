"""From the journals of a run to a history: which states each slot went through.

No journal shows a shard's inside.  What a slot held is known from those who looked, the last lock
over everything among them, and from the locks that wrote: an unseen version belongs to the lock
whose commit was confirmed, or else to the only one that may have made it.  A lock whose end is
unknown counts as soon as one of its versions was seen.

A volatile slot counts its versions anew after each restart, so its chain is made anew, too.  A
commit over several shards that was promised before a restart may be applied after it, always as
version 1, which may be another one than was promised.  A commit on one shard never is.
"""

from __future__ import annotations

from collections import defaultdict
from itertools import pairwise
from typing import TYPE_CHECKING, Final

from enact_dist.patterns import pattern_matches
from enact_dist.terms import Access
from enact_dist.verify.chaos.journal import UNSEEN
from enact_dist.verify.chaos.workload import MADE, VOLATILE
from enact_dist.verify.checker import (
    NOTHING,
    Anomaly,
    ChainState,
    Checker,
    LockOutcome,
    LockStory,
    StateRead,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    from enact_dist.verify.chaos.evidence import Evidence, LockRecord, Restart

_ANY_TIME: Final = (0, 1 << 62)
_FIRST: Final = 0
"""Epoch used for slots that keep their versions over restarts."""


class CheckedHistory:
    """The history of a run, ready for the checker.

    Attributes:
        chains: Slot → its states.
        oddities: Errors found before any order is searched.
        guessed: States that one of several locks has written and no lock saw.
    """

    def __init__(self, evidence: Evidence) -> None:
        self._locks = evidence.locks
        self._restarts: dict[str, list[Restart]] = defaultdict(list)
        for restart in evidence.restarts:
            self._restarts[restart.shard].append(restart)
        self.chains: dict[str, list[ChainState]] = {}
        self.oddities: list[Anomaly] = []
        self.guessed: dict[str, None] = {}
        self._seen: dict[str, dict[tuple[int, int], dict[str, None]]] = defaultdict(dict)
        self._untimed: dict[str, tuple[int, int]] = {}
        self._viewed: dict[tuple[str, str], list[tuple[LockRecord, int]]] = defaultdict(list)
        self._claims: dict[str, dict[tuple[int, int], list[tuple[LockRecord, str]]]] = {}
        self._names: dict[str, dict[tuple[int, int], str]] = {}
        self._claimed: dict[tuple[str, str], tuple[int, int]] = {}
        for record in self._locks.values():
            self._note_claims(record)
        for record in self._locks.values():
            self._note_seen(record)
        self._note_viewed()
        for slot in self._seen:
            self._build(slot)
        self._made: dict[str, list[str]] = {}

    def checker(self) -> Checker:
        """Return the checker of this history."""
        stories = [self._story(record) for record in self._locks.values()]
        stories += [LockStory(name, 0, None, LockOutcome.UNKNOWN) for name in self.guessed]
        events = {
            _name_of(restart): (restart.down_ns, restart.ready_ns)
            for restarts in self._restarts.values()
            for restart in restarts[1:]
        }
        return Checker(stories, self.chains, events=events | self._untimed)

    def anomalies(self) -> list[Anomaly]:
        """Return everything that is wrong with it."""
        return [*self.oddities, *self.checker().anomalies()]

    # ---------------------------------------------------------------- what is known

    def _note_claims(self, record: LockRecord) -> None:
        for slot, version, writer in record.writes:
            at = (_epoch(record, slot), version)
            claims = self._claims.setdefault(slot, {})
            claims.setdefault(at, []).append((record, writer))
            self._claimed[record.id, slot] = at

    def _note_seen(self, record: LockRecord) -> None:
        for slot, version, writer, protected in record.seen:
            seen = self._seen[slot]  # a slot that was looked at has a chain, perhaps empty
            if version == 0 or writer == UNSEEN:
                continue
            at = (_epoch(record, slot), version)
            claimed = self._claimed.get((writer, slot), at)
            if not _is_volatile(slot):
                if writer and claimed != at:
                    facts = (f"{slot}: {writer} wrote {claimed[1]}, {record.id} read {version}",)
                    self.oddities.append(Anomaly("a datum under another version", facts))
            elif not protected:
                self._viewed[slot, writer].append((record, version))
                continue
            elif claimed[0] < at[0] and not self._may_outlive(writer, version):
                facts = (f"{slot}: {writer} wrote it in epoch {claimed[0]}, {record.id} read {at}",)
                self.oddities.append(Anomaly("a volatile datum outlived its shard", facts))
            seen.setdefault(at, {})[writer] = None

    def _note_viewed(self) -> None:
        """Take the views of volatile slots, which know no epoch, where no other client looked."""
        known = {(slot, w) for slot, seen in self._seen.items() for ws in seen.values() for w in ws}
        for (slot, writer), views in self._viewed.items():
            if (slot, writer) in known:
                continue
            written, promised = self._claimed.get((writer, slot), (_FIRST, views[0][1]))
            shown = self._shown_later(slot, writer, [view for view, _ in views])
            for _, version in views:
                epoch = written
                if version != promised:
                    # Applied after a restart: the next one, as no client saw it in a later epoch.
                    later = (r.epoch for r in self._restarts[_shard_of(slot)] if r.epoch > written)
                    epoch = min(later, default=written)
                elif shown is not None and self._may_outlive(writer, version):
                    epoch = shown
                self._seen[slot].setdefault((epoch, version), {})[writer] = None

    def _shown_later(self, slot: str, writer: str, views: list[LockRecord]) -> int | None:
        """Return the epoch in which the first view showed a write, if its promise was older.

        None where a view showed the write in the epoch of its promise, or a client found there
        what followed it: then it was applied there, and the restart has emptied the slot.
        """
        written, promised = self._claimed.get((writer, slot), (_FIRST, 0))
        found = {*self._seen[slot], *self._claims.get(slot, ())}
        if any(epoch == written and version > promised for epoch, version in found):
            return None
        epochs = (self._epoch_of_view(slot, view) for view in views)
        shown = min((epoch for epoch in epochs if epoch is not None), default=written)
        return shown if shown > written else None

    def _epoch_of_view(self, slot: str, view: LockRecord) -> int | None:
        """Return the epoch in which a lock was shown its view of a slot; None: one of several.

        The views of a lock are taken between its begin and its grant.  A shard that ends by itself
        answers some while after its order, and none answers before it was started.
        """
        restarts = self._restarts[_shard_of(slot)]
        for one, then in pairwise(restarts):
            if view.granted_ns is not None and view.granted_ns <= then.started_ns:
                return one.epoch
            if view.begun_ns < then.silent_ns:
                return None
        return restarts[-1].epoch

    def _may_outlive(self, writer: str, version: int) -> bool:
        """Return whether a write may be applied as this version after a restart of its shard."""
        record = self._locks.get(writer)
        return version == 1 and record is not None and _is_over_shards(record)

    # ---------------------------------------------------------------- chains

    def _build(self, slot: str) -> None:
        """Tell a slot state by state."""
        states: list[ChainState] = []
        names = self._names[slot] = {}
        seen = self._seen[slot]
        found_at: dict[str, tuple[int, int]] = {}
        for at in sorted(seen):
            for writer in seen[at]:
                if writer and found_at.setdefault(writer, at) != at:
                    facts = (f"{slot}: {writer} as {found_at[writer]} and as {at}",)
                    self.oddities.append(Anomaly("one write stands twice", facts))
        for epoch, restart in self._epochs(slot):
            if restart is not None:
                name = f"null {epoch} 0"
                names[epoch, 0] = name
                states.append(ChainState(name, self._emptied_by(restart, slot), 0))
            newest = max((version for since, version in seen if since == epoch), default=0)
            for version in range(1, newest + 1):
                at = (epoch, version)
                there = self._states_at(slot, at, found_at)
                names[at] = next((str(state.name) for state in there), "")
                states += there
        self.chains[slot] = states

    def _emptied_by(self, restart: Restart, slot: str) -> str:
        """Return who set a volatile slot to null at a restart.

        A promise holds over it: its commit may be confirmed before the restart and be applied
        after it, or after a later one, so of this slot nothing says when it was emptied.
        """
        first = self._seen[slot].get((restart.epoch, 1), ())
        promised = [w for w in first if self._claimed.get((w, slot), (0, 0))[0] < restart.epoch]
        promised += [
            writer
            for (epoch, _), writers in self._seen[slot].items()
            for writer in writers
            if self._claimed.get((writer, slot), (epoch, 0))[0] < restart.epoch < epoch
        ]
        if not promised:
            return _name_of(restart)
        name = f"{_name_of(restart)} under {promised[0]}"
        self._untimed[name] = _ANY_TIME
        return name

    def _epochs(self, slot: str) -> Iterable[tuple[int, Restart | None]]:
        """Return the epochs in which a slot counts anew, with the restarts that began them."""
        if not _is_volatile(slot):
            return [(_FIRST, None)]
        first, *others = self._restarts[_shard_of(slot)]
        return [(first.epoch, None), *((restart.epoch, restart) for restart in others)]

    def _states_at(
        self, slot: str, at: tuple[int, int], found_at: dict[str, tuple[int, int]]
    ) -> list[ChainState]:
        """Return what stood under a version: one state, unless something is wrong."""
        version = at[1]
        writers = list(self._seen[slot].get(at, ()))
        states = [ChainState(writer, writer, version) for writer in writers if writer]
        if "" in writers:
            states.append(self._claimed_state(slot, at, null=True, found_at=found_at))
        if not states and (self._may_be(slot, at, found_at) or _is_volatile(slot)):
            states.append(self._claimed_state(slot, at, null=False, found_at=found_at))
        return states

    def _may_be(
        self, slot: str, at: tuple[int, int], found_at: dict[str, tuple[int, int]]
    ) -> list[tuple[LockRecord, str]]:
        """Return which locks may have written an unseen version; a confirmed one comes alone."""
        claims = [
            (record, writer)
            for record, writer in self._claims.get(slot, {}).get(at, ())
            if record.told is not LockOutcome.NOT and found_at.get(record.id, at) == at
        ]
        sure = [claim for claim in claims if claim[0].told is LockOutcome.COMMITTED]
        return sure or claims

    def _claimed_state(
        self,
        slot: str,
        at: tuple[int, int],
        *,
        null: bool,
        found_at: dict[str, tuple[int, int]],
    ) -> ChainState:
        claims = self._may_be(slot, at, found_at)
        if null:
            claims = [claim for claim in claims if not claim[1]]
        version = at[1]
        if len(claims) == 1:
            ((record, writer),) = claims
            return ChainState(writer or f"null {version}", record.id, version)
        name = f"null {version}" if null else f"unseen {at[0]} {version}"
        if null and not claims:
            return ChainState(name, f"an unknown lock's {slot} {version}", version)
        guess = f"one of {[record.id for record, _ in claims]} at {slot} {version}"
        self.guessed[guess] = None
        return ChainState(name, guess, version)

    # ---------------------------------------------------------------- stories

    def _story(self, record: LockRecord) -> LockStory:
        reads: list[StateRead] = []
        views: list[StateRead] = []
        for slot, version, writer, protected in record.seen:
            reading = self._reading(record, slot, version, writer, protected=protected)
            if reading is not None:
                (reads if protected or slot in record.expected else views).append(reading)
        reads += self._absent(record)
        return LockStory(
            record.id,
            record.begun_ns,
            record.ended_ns,
            record.told,
            reads,
            views,
            writes=[slot for slot, _, _ in record.writes if not _is_volatile(slot)],
            outlives_restarts=_is_over_shards(record),
        )

    def _reading(
        self, record: LockRecord, slot: str, version: int, writer: str, *, protected: bool
    ) -> StateRead | None:
        if writer not in ("", UNSEEN):
            return StateRead(slot, writer)
        if _is_volatile(slot) and not protected:
            return None  # null in an unknown epoch
        at = (_epoch(record, slot), version)
        if version == 0:
            return StateRead(slot, self._names[slot].get(at, NOTHING))
        name = self._names[slot].get(at)
        return StateRead(slot, name or f"unknown {version}")

    def _absent(self, record: LockRecord) -> list[StateRead]:
        """Return what the patterns of a lock did not show, and so said to be null."""
        if record.granted_ns is None or (not record.seen and not record.tried):
            return []
        shown = {slot for slot, *_ in record.seen}
        absent = []
        for access, context, pattern, aspect in record.items:
            if Access(access).each:
                made = self._matching(f"{context}:", pattern, aspect)
                absent += [StateRead(slot, NOTHING) for slot in made if slot not in shown]
        return absent

    def _matching(self, context: str, pattern: str, aspect: str) -> list[str]:
        """Return the slots that a pattern covers; all made things are of one context."""
        assert aspect == MADE
        found = self._made.get(pattern)
        if found is None:
            found = self._made[pattern] = [
                slot
                for slot in self.chains
                if slot.endswith(f"/{aspect}")
                and slot.startswith(context)
                and pattern_matches(pattern, slot[len(context) : -len(aspect) - 1])
            ]
        return found


def _is_volatile(slot: str) -> bool:
    return slot.endswith(f"/{VOLATILE}")


def _shard_of(slot: str) -> str:
    """Return the shard that a thing is pinned to; of made things, some name of their own."""
    _, shard, _ = slot.partition(":")[2].split("/")[:3]
    return shard


def _is_over_shards(record: LockRecord) -> bool:
    return len({_shard_of(slot) for slot, _, _ in record.writes}) > 1


def _epoch(record: LockRecord, slot: str) -> int:
    return record.epochs.get(_shard_of(slot), _FIRST) if _is_volatile(slot) else _FIRST


def _name_of(restart: Restart) -> str:
    return f"restart {restart.epoch} of {restart.shard}"
