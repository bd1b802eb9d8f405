"""The replaced states of all slots of one shard: how long they stay, and which go first.

A replaced state is *held* while its aspect's retention allows (versions, age, bytes), and every one
stays for two seconds so that cuts can be made (*loose*, where it is not held).  So what is known of
a slot is a tail of its history without holes.  Versions that labels keep are stored separately,
without limit of time.

Limits of the whole shard come before what an aspect retains: then the oldest goes first; at the cap
of shared memory, the oldest of the aspects whose history has payloads there.  Whatever of a stored
aspect is held no longer waits in here until the store learns of it, with the next batch.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from itertools import pairwise
from typing import Final, NamedTuple

from enact_dist.core.protocol.datum import Slot
from enact_dist.core.protocol.parts import NO_LIMIT, SlotVersion
from enact_dist.core.protocol.records import Content, HistoryForgotten, own_bytes
from enact_dist.core.state.retention import DEFAULT, KeptVersion, Limits, PayloadNames, SlotHistory

LOOSE_NS: Final = 2_000_000_000
"""How long any replaced state is kept, on the clock of the stamps."""
LOOSE_BYTES_MAX: Final = 64 << 20
"""Bytes of data, payloads included, that only this keeps."""
LOOSE_STATES_MAX: Final = 50_000
"""States that were replaced within that time: where the wall clock was set back, the stamps stand
still for as long, and nothing would be old."""
HELD_BYTES_MAX: Final = 256 << 20
"""Bytes of replaced data and their lineage within retention, over all slots of a shard; those of
payloads have a cap of their own, which the link keeps."""
HELD_STATES_MAX: Final = 100_000
"""Replaced states within retention, over all slots of a shard."""


class Policy(NamedTuple):
    """How much of each slot's history an aspect retains, and whether it is on the disk, too."""

    limits: Limits
    stored: bool


UNKNOWN: Final = Policy(DEFAULT, stored=False)
"""The policy of an aspect that is not registered."""


class History:
    """The replaced states of one shard's slots.

    Args:
        policies: What each aspect retains; may change.
        payloads: Counts who names which payload; the newest states are counted by their owner.
        bytes_max: `HELD_BYTES_MAX`.

    Attributes:
        bytes: Bytes of data that the held states have in memory, payloads left out.
        count: How many states are held.
        kept_bytes: Bytes of data that labels keep, payloads left out.
        dropped: How many had to go before their time.
        labels: What each label keeps.
    """

    __slots__ = (
        "_by_slot",
        "_bytes_max",
        "_forgotten",
        "_loose",
        "_loose_bytes",
        "_number",
        "_payloads",
        "_payloads_held",
        "_policies",
        "_queues",
        "_recent",
        "bytes",
        "count",
        "dropped",
        "kept_bytes",
        "labels",
    )

    def __init__(
        self,
        policies: Mapping[str, Policy],
        payloads: PayloadNames,
        *,
        bytes_max: int = HELD_BYTES_MAX,
    ) -> None:
        self._policies = policies
        self._payloads = payloads
        self._bytes_max = bytes_max
        self._by_slot: dict[Slot, SlotHistory] = {}
        self._recent: deque[tuple[int, SlotHistory]] = deque()
        self._queues: dict[str, list[tuple[int, int, SlotHistory]]] = {}
        self._payloads_held: dict[str, int] = {}
        self._forgotten: list[SlotVersion] = []
        self._loose = self._loose_bytes = self._number = 0
        self.bytes = self.count = self.kept_bytes = self.dropped = 0
        self.labels: dict[str, dict[SlotVersion, None]] = {}

    def of(self, slot: Slot) -> SlotHistory | None:
        """Return what is known of a slot's replaced states, None if nothing is."""
        return self._by_slot.get(slot)

    def __iter__(self) -> Iterator[SlotHistory]:
        return iter(self._by_slot.values())

    def policy(self, aspect: str) -> Policy:
        """Return what an aspect retains."""
        return self._policies.get(aspect, UNKNOWN)

    # ---------------------------------------------------------------- states come

    def replaced(self, slot: Slot, old: Content, *, until_ns: int) -> None:
        """Take a state that another one, stamped `until_ns`, has replaced."""
        if not old.version:
            return  # before its first version a slot is null: nothing to remember
        policy = self._policies.get(slot.aspect, UNKNOWN)
        found = self._by_slot.get(slot) or self._opened(slot, stored=policy.stored)
        if policy.limits.versions <= 1 and found.held:
            self._release_all(found)  # an earlier, larger retention may have kept versions
        found.until_ns = until_ns
        found.young += 1
        recent = self._recent
        recent.append((until_ns, found))
        self._append(found, old, policy.limits)
        if (
            recent[0][0] < until_ns - LOOSE_NS
            or self._loose_bytes > LOOSE_BYTES_MAX
            or len(recent) > LOOSE_STATES_MAX
        ):
            self._end_recent(until_ns - LOOSE_NS)
        if self.count > HELD_STATES_MAX or self.bytes > self._bytes_max:
            self._fit()

    def _opened(self, slot: Slot, *, stored: bool) -> SlotHistory:
        self._number += 1
        found = self._by_slot[slot] = SlotHistory(slot, self._number, stored=stored)
        return found

    def _append(self, found: SlotHistory, old: Content, limits: Limits) -> None:
        """Add a state as held, or as loose where its aspect retains none."""
        found.states.append(old)
        datum = old.datum
        if limits.versions <= 1:
            self._loose += 1
            if datum is not None:
                self._loose_bytes += datum.size
                self._payloads.count(datum, may_go=1)
            return
        found.held += 1
        self.count += 1
        self.bytes += old.bytes if old.bytes >= 0 else own_bytes(old)
        if datum is not None:
            found.size += datum.size
            if datum.file:
                self._payloads.count(datum, may_go=1)
                self._hold_payload(found.slot.aspect, 1)
            if datum.stamp_ns:
                found.index(old)
        while found.held >= limits.versions or found.size > limits.size:
            self._release(found)
        if not found.queued and found.held:
            self._queue(found)

    def _hold_payload(self, aspect: str, count: int) -> None:
        """Count that so many more (or fewer) held states of an aspect have payloads."""
        left = self._payloads_held.get(aspect, 0) + count
        if left:
            self._payloads_held[aspect] = left
        else:
            del self._payloads_held[aspect]

    def _queue(self, found: SlotHistory) -> None:
        found.queued = True
        queue = self._queues.setdefault(found.slot.aspect, [])
        heapq.heappush(queue, (found.held_until_ns(), found.number, found))

    # ---------------------------------------------------------------- states go

    def _release(self, found: SlotHistory) -> None:
        """Let the oldest held state of a slot be held no longer."""
        old = found.states[-found.held]
        found.held -= 1
        self.count -= 1
        self._loose += 1
        self.bytes -= old.bytes if old.bytes >= 0 else own_bytes(old)
        datum = old.datum
        if datum is not None:
            found.size -= datum.size
            self._loose_bytes += datum.size
            if datum.file:
                self._hold_payload(found.slot.aspect, -1)
            if datum.stamp_ns:
                found.unindex(old)
        if found.stored and old.version not in found.kept:
            self._forgotten.append(SlotVersion(found.slot, old.version))
        if found.young < len(found.states) > found.held:
            self._trim(found)

    def _release_all(self, found: SlotHistory) -> None:
        while found.held:
            self._release(found)

    def _trim(self, found: SlotHistory) -> None:
        """Drop the states of a slot that are neither held nor lately replaced."""
        states, stay = found.states, max(found.held, found.young)
        while len(states) > stay:
            old = states.popleft()
            self._loose -= 1
            if old.datum is not None:
                self._loose_bytes -= old.datum.size
                self._payloads.count(old.datum, may_go=-1)
            kept = found.kept.get(old.version) if found.kept else None
            if kept is not None:
                kept.until_ns = states[0].stamp_ns if states else found.until_ns
        self._close(found)

    def _close(self, found: SlotHistory) -> None:
        """Drop a slot without known versions; its queue entry is reused."""
        left = found.states or found.kept or found.queued
        if not left and self._by_slot.get(found.slot) is found:
            del self._by_slot[found.slot]

    def _end_recent(self, before_ns: int) -> None:
        """Remove states replaced before a timestamp, and the oldest beyond the limits."""
        recent = self._recent
        while recent and (
            recent[0][0] < before_ns
            or self._loose_bytes > LOOSE_BYTES_MAX
            or len(recent) > LOOSE_STATES_MAX
        ):
            found = recent.popleft()[1]
            found.young -= 1
            if found.young < len(found.states) > found.held:
                self._trim(found)

    def grow_old(self, now_ns: int) -> None:
        """Forget what has become too old by a stamp."""
        self._end_recent(now_ns - LOOSE_NS)
        for aspect, queue in self._queues.items():
            age_ns = self.policy(aspect).limits.age_ns
            while age_ns < NO_LIMIT and queue and queue[0][0] < now_ns - age_ns:
                found = self._oldest(aspect)
                if found is None or found.held_until_ns() >= now_ns - age_ns:
                    break
                self._release(found)

    def _oldest(self, aspect: str) -> SlotHistory | None:
        """Return the slot of an aspect whose oldest held state was replaced first.

        A slot is queued under a past timestamp; it is reordered when it comes first.
        """
        queue = self._queues[aspect]
        while queue:
            until_ns, _, found = queue[0]
            if not found.held:
                heapq.heappop(queue)
                found.queued = False
                self._close(found)
            elif until_ns < found.held_until_ns():
                heapq.heapreplace(queue, (found.held_until_ns(), found.number, found))
            else:
                return found
        return None

    def _drop_oldest(self, aspects: Iterable[str]) -> bool:
        """Let the state of these aspects that was replaced first be held no longer."""
        firsts = [first for first in map(self._oldest, aspects) if first is not None]
        if not firsts:
            return False
        self.dropped += 1
        self._release(min(firsts, key=lambda found: (found.held_until_ns(), found.number)))
        return True

    def _fit(self) -> None:
        """Keep the limits of the whole shard."""
        while self.count > HELD_STATES_MAX or self.bytes > self._bytes_max:
            self._drop_oldest(self._queues)

    def make_room(self, size: int) -> tuple[int, int]:
        """Remove the oldest states until so many bytes of payloads are no longer named.

        What is kept only to answer as of a recent stamp goes first, then what is oldest in the
        aspects that have payloads: a camera at the cap costs the others nothing.  Where all would
        not do, all stay; what labels keep stays in any case.

        Returns:
            How many states went, and the bytes of payloads that only they named.
        """
        before = self._payloads.spare
        if before < size:
            return 0, 0
        states = self.count + self._loose
        while self._recent and before - self._payloads.spare < size:
            self._end_recent(self._recent[0][0] + 1)
        while before - self._payloads.spare < size and self._drop_oldest(self._payloads_held):
            pass
        return states - self.count - self._loose, before - self._payloads.spare

    def take_forgotten(self) -> tuple[HistoryForgotten, ...]:
        """Return the deletions for the store, at most one record; they then count as passed on."""
        if not self._forgotten:
            return ()
        record = HistoryForgotten(tuple(self._forgotten))
        self._forgotten.clear()
        return (record,)

    def drop(self, slots: Iterable[Slot]) -> None:
        """Forget all of these slots at once, what is kept too; their owner tells the store."""
        for slot in slots:
            found = self._by_slot.pop(slot, None)
            if found is None:
                continue
            found.stored, found.young = False, 0
            for version in list(found.kept):
                for label in list(found.kept[version].labels):
                    self._let_go(label, found, version)
            self._release_all(found)
            self._trim(found)
        for queue in self._queues.values():
            queue[:] = [entry for entry in queue if self._by_slot.get(entry[2].slot) is entry[2]]
            heapq.heapify(queue)

    # ---------------------------------------------------------------- labels

    def is_stored(self, slot: Slot) -> bool:
        """Whether the versions of a slot lie on the disk, too."""
        found = self._by_slot.get(slot)
        return found.stored if found is not None else self.policy(slot.aspect).stored

    def will_hold(self, slot: Slot, old: Content) -> bool:
        """Whether the newest state of a slot will stay in its history when it is replaced."""
        if not old.version:
            return False
        limits = self.policy(slot.aspect).limits
        size = old.datum.size if old.datum is not None else 0
        if limits.versions > 1 and size <= limits.size:
            return True
        found = self._by_slot.get(slot)
        return found is not None and old.version in found.kept

    def keep(self, label: str, version: SlotVersion, newest: Content) -> bool:
        """Keep a version under a label; False where it is forgotten."""
        slot, number = version
        found = self._by_slot.get(slot)
        is_newest = 0 < newest.version == number
        content = newest if is_newest else found.find(number) if found is not None else None
        if content is None:
            return False
        if found is None:
            found = self._opened(slot, stored=self.policy(slot.aspect).stored)
            found.until_ns = newest.stamp_ns
        self._keep(label, found, content)
        return True

    def _keep(self, label: str, found: SlotHistory, content: Content, *, until_ns: int = 0) -> None:
        kept = found.kept.get(content.version)
        if kept is None:
            kept = found.kept[content.version] = KeptVersion(content, until_ns)
            self.kept_bytes += own_bytes(content)
            self._payloads.count(content.datum, stays=1)
        kept.labels.add(label)
        self.labels.setdefault(label, {})[SlotVersion(found.slot, content.version)] = None

    def let_go(self, label: str) -> None:
        """Keep nothing under a label any more; what is outside its retention is forgotten."""
        for slot, version in list(self.labels.get(label, ())):
            found = self._by_slot[slot]
            self._let_go(label, found, version)
            self._close(found)

    def _let_go(self, label: str, found: SlotHistory, version: int) -> None:
        versions, kept = self.labels[label], found.kept[version]
        is_newest = not found.until_ns_of(version)
        del versions[SlotVersion(found.slot, version)]
        if not versions:
            del self.labels[label]
        kept.labels.discard(label)
        if kept.labels:
            return
        del found.kept[version]
        self.kept_bytes -= own_bytes(kept.content)
        self._payloads.count(kept.content.datum, stays=-1)
        if found.is_held(version) or not found.stored:
            return
        # The newest one, too: a commit that replaces it may be with the store already.
        if not (is_newest and self.will_hold(found.slot, kept.content)):
            self._forgotten.append(SlotVersion(found.slot, version))

    # ---------------------------------------------------------------- restart

    def recover(
        self,
        slot: Slot,
        newest: Content,
        states: Iterable[Content],
        labels: Mapping[SlotVersion, list[str]],
    ) -> None:
        """Take over what a store has kept of a slot, as far as its retention still allows.

        Args:
            slot: The slot.
            newest: Its newest state; version 0 where that is lost.
            states: Its replaced states, oldest first, with or without holes.
            labels: Which labels keep which versions.
        """
        found = self._opened(slot, stored=True)
        found.until_ns = newest.stamp_ns
        rows = {content.version: content for content in states}
        first = newest.version
        while first - 1 in rows:
            first -= 1
        ordered = [*rows.values(), newest]
        untils = {
            one.version: after.stamp_ns if after.version == one.version + 1 else one.stamp_ns
            for one, after in pairwise(ordered)
        }
        for content in ordered:
            version = content.version
            tail = first <= version <= newest.version
            for label in labels.get(SlotVersion(slot, version), ()):
                self._keep(label, found, content, until_ns=0 if tail else untils[version])
            if not tail and version not in found.kept:
                self._forgotten.append(SlotVersion(slot, version))
        limits = self.policy(slot.aspect).limits
        if limits.versions <= 1:  # less than before the restart: never held, so never released
            gone = [n for n in range(first, newest.version) if n not in found.kept]
            self._forgotten += [SlotVersion(slot, version) for version in gone]
        found.young = len(rows)  # nothing of it goes before all is here
        for version in range(first, newest.version):
            found.until_ns = rows.get(version + 1, newest).stamp_ns
            self._append(found, rows[version], limits)
        found.young = 0
        self._trim(found)
        self._fit()

    def assert_invariants(self) -> None:
        """Assert the bookkeeping.  For tests and simulation."""
        held = loose = count = states = kept = 0
        young: dict[int, int] = {}
        payloads: dict[str, int] = {}
        for _, found in self._recent:
            young[found.number] = young.get(found.number, 0) + 1
        for slot, found in self._by_slot.items():
            assert found.slot == slot
            assert found.states or found.kept or found.queued, slot
            assert len(found.states) <= max(found.held, found.young), slot
            assert found.young == young.get(found.number, 0), slot
            found.assert_invariants()
            count, states = count + found.held, states + len(found.states)
            for index, state in enumerate(found.states):
                if index < len(found.states) - found.held:
                    loose += state.datum.size if state.datum is not None else 0
                else:
                    held += own_bytes(state)
                    if state.datum is not None and state.datum.file:
                        payloads[slot.aspect] = payloads.get(slot.aspect, 0) + 1
            assert not found.held or found.queued, slot
            for version, one in found.kept.items():
                kept += own_bytes(one.content)
                assert one.labels
                for label in one.labels:
                    assert SlotVersion(slot, version) in self.labels[label]
        assert (self.bytes, self.count, self._loose_bytes) == (held, count, loose)
        assert self._loose == states - count
        assert self._payloads_held == payloads
        assert self.kept_bytes == kept
        named = {key for versions in self.labels.values() for key in versions}
        assert named == {SlotVersion(f.slot, version) for f in self for version in f.kept}
