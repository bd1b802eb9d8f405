"""The rules of clients: alone with a lock (I7), nothing stale, true answers (I5)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.messages import CLOCK_SKEW, Forgotten
from enact_dist.terms import Durability
from enact_dist.verify.simulation.cells import CONTEXTS
from enact_dist.verify.simulation.judges.history import TOLD_NOT, Entry, conflict

if TYPE_CHECKING:
    from enact_dist.core.client.lock import MultiLock
    from enact_dist.core.client.plan import Reading
    from enact_dist.core.protocol.datum import Datum, Slot
    from enact_dist.core.protocol.messages import Surveyed
    from enact_dist.verify.simulation.hosts.client_host import ClientNode
    from enact_dist.verify.simulation.judges.growth import GrowthJudge
    from enact_dist.verify.simulation.judges.history import Observations

    Own = dict[Slot, tuple[str, int, int]]


class ClientJudge:
    """Checks what clients believe, read and learn."""

    def __init__(self, observed: Observations, growth: GrowthJudge) -> None:
        self._observed, self._growth = observed, growth
        self._world, self._history = observed.world, observed.history
        self._fail = observed.fail
        self.clients: list[ClientNode] = []

    def holds(self, host: ClientNode, entry: Entry) -> None:
        """A thread has its lock."""
        self._world.tally["locks held"] += 1
        self.check_beliefs(host)

    def shows_news(self, entry: Entry) -> None:
        """A lock that waits for news shows some."""
        news = entry.lock.news
        if news is None:
            return
        after = {seen.slot: (seen.version, seen.stamp_ns) for seen in news.seen}
        self._world.tally["locks that waited for news"] += 1
        shown = {
            one.state.slot: (one.state.version, one.state.stamp_ns) for one in entry.lock.states
        }
        if all(shown[slot] == seen for slot, seen in after.items()):
            self._fail("a lock that waits for news shows some", entry.id, shown, after)

    def check_beliefs(self, host: ClientNode) -> None:
        """I7: a client that believes in a lock now is alone with it."""
        entries = self._history.entries
        mine = _believed(host)
        if not mine:
            return
        for other in self.clients:
            if not other.up:
                continue
            for theirs in _believed(other):
                for lock in mine:
                    if lock is not theirs and conflict(
                        entries[lock.lock].items, entries[theirs.lock].items
                    ):
                        self._fail("I7 two believers", lock.lock, theirs.lock)

    def datum_seen(self, reading: Reading, datum: Datum | None) -> None:
        """A thread looks at a datum, from the grant, its cache or a fetch: is it the right one?"""
        picture = self._observed.pictures[reading.shard]
        state = reading.state
        for one in reversed(picture.chains.get(state.slot, ())):
            if one.epoch <= reading.epoch and one.name == (state.version, state.stamp_ns):
                same = (one.datum is None) == (datum is None) and (
                    datum is None or one.datum is None or bytes(datum.body) == bytes(one.datum.body)
                )
                if not same:
                    self._fail("no stale datum is served", reading, one)
                return
        if (state.version, state.stamp_ns) != (0, 0) or datum is not None:
            self._fail("what is read was committed", reading)

    def surveyed(self, host: ClientNode, own: Own, shard: str, answer: Surveyed) -> None:
        """A process lists versions at a shard that has settled: its own commits are among them.

        Args:
            host: The process.
            own: What it had committed when it began to ask.
            shard: Whom it has asked.
            answer: What came.
        """
        newest = {state.slot: state for state in answer.states}
        for slot, (at_shard, epoch, stamp_ns) in own.items():
            durable = self._observed.durabilities[slot.aspect] is Durability.DURABLE
            state = newest.get(slot)
            if at_shard == shard and state is not None and (durable or epoch == answer.epoch):
                self._world.tally["own commits found in surveys"] += 1
                if state.stamp_ns < stamp_ns:
                    self._fail("a survey names our own commits", host.name, state, stamp_ns)

    def shows_own(self, own: Own, entry: Entry) -> None:
        """What a process has committed before it asks is shown by all that its locks see."""
        stamps = entry.stamps()
        for shard, epoch, state in entry.lock.states:
            at_shard, at_epoch, stamp_ns = own.get(state.slot, ("", 0, 0))
            durable = self._observed.durabilities[state.slot.aspect] is Durability.DURABLE
            if at_shard == shard and (durable or epoch == at_epoch) and state.slot not in stamps:
                self._world.tally["own commits seen"] += 1
                if state.stamp_ns < stamp_ns:
                    self._fail("a process sees its own commits", entry.id, state, stamp_ns)

    def told(self, host: ClientNode, entry: Entry) -> None:
        """Check the outcome of a lock that its thread has learned."""
        self._world.tally[f"told: {entry.told.value if entry.told else '-'}"] += 1
        applied = any(entry.id in picture.applied for picture in self._observed.pictures.values())
        refusal = entry.lock.refusal
        skewed = self._observed.clocks_were_set and getattr(refusal, "code", "") == CLOCK_SKEW
        explained = skewed or isinstance(refusal, Forgotten) or self._growth.explains(entry)
        if refusal is not None and not explained:
            self._fail("nothing is refused", entry.id, refusal)
        applied = applied or entry.id in self._observed.permitted_losses
        if entry.told is Phase.COMMITTED and entry.lock.versions and not applied:
            self._fail("I5 told committed, not visible", entry.id)
        if entry.told in TOLD_NOT and applied and entry.id not in self._observed.permitted_losses:
            self._fail("I5 told not committed, but visible", entry.id, entry.told, entry.lock.cause)

        if entry.told is Phase.COMMITTED:
            self._check_confirmed(entry)
            epochs = {part.shard: part.token.epoch for part in entry.lock.parts if part.token}
            for slot, _ in entry.lock.versions:
                if slot.context not in CONTEXTS:
                    continue  # a fork under that name may be another one by the time it is seen
                shard, position = entry.lock.shard_of(slot), entry.lock.position
                if shard in epochs and position is not None:
                    host.own[slot] = (shard, epochs[shard], position.stamp_ns)

    def _check_confirmed(self, entry: Entry) -> None:
        """P3: each part was asked, at its end, whether it had been held all the time.

        A lock that has ended without a call was judged in that moment.
        """
        if entry.unasked:
            return
        for part in entry.lock.parts:
            picture = self._observed.pictures[part.shard]
            if part.token != picture.confirmed.get(entry.id):
                self._fail("P3 every lock is confirmed", entry.id, part.shard, part.token)


def _believed(host: ClientNode) -> list[MultiLock]:
    now_ns = host.local_ns
    return [lock for lock in host.client.live_locks() if lock.valid(now_ns)]
