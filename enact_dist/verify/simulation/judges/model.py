"""What must hold at every step, judged from what goes into a shard and what comes out.

The model keeps its own picture of each slot's committed states, its own order of arrival and its
own list of grants, and compares.  Rules are named as in the design's list of invariants (I1-I19).
The end of a run is judged by `graph`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from enact_dist.core.protocol.datum import Datum, LockId, Slot
from enact_dist.core.protocol.messages import (
    Commit,
    Committed,
    Finished,
    Forgotten,
    Goodbye,
    Granted,
    Hello,
    KeepVersions,
    Kept,
    ListHistory,
    Notice,
    Prepared,
    SlotVersion,
    Survey,
    Surveyed,
    TakeView,
    Valid,
    Validate,
    Versions,
    Viewed,
)
from enact_dist.core.protocol.records import (
    DecisionDone,
    DecisionRecord,
    OutcomeRecord,
    Persist,
    PreparedEnded,
    PreparedRecord,
    Publish,
    Recovered,
    Reply,
    SessionDied,
    SlotRecord,
)
from enact_dist.core.state.retention import limits_of
from enact_dist.terms import Durability
from enact_dist.verify.simulation.data import FILLED, label_of, value_of, writer_of
from enact_dist.verify.simulation.hosts.payloads import copied
from enact_dist.verify.simulation.judges.causes import CauseJudge
from enact_dist.verify.simulation.judges.clients import ClientJudge
from enact_dist.verify.simulation.judges.growth import GrowthJudge
from enact_dist.verify.simulation.judges.history import TOLD_NOT, Observations
from enact_dist.verify.simulation.judges.locks import KeepingJudge, LockJudge
from enact_dist.verify.simulation.judges.past import PastJudge
from enact_dist.verify.simulation.judges.picture import CommittedState, ShardPicture
from enact_dist.verify.simulation.judges.prefixes import judge_prefixes
from enact_dist.verify.simulation.judges.readers import ReaderJudge, stamp_of
from enact_dist.verify.simulation.judges.worlds import WorldJudge

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from enact_dist.core.protocol.messages import AspectEntry
    from enact_dist.core.protocol.records import Effect
    from enact_dist.verify.simulation.hosts.shard_host import ShardNode
    from enact_dist.verify.simulation.hosts.world import SimulatedWorld
    from enact_dist.verify.simulation.judges.history import RunHistory


class Model(Observations):
    """The judge of a running simulation."""

    def __init__(
        self, world: SimulatedWorld, history: RunHistory, aspects: Iterable[AspectEntry]
    ) -> None:
        aspects = tuple(aspects)
        super().__init__(
            world, history, {entry.name: Durability(entry.durability) for entry in aspects}
        )
        versions = {entry.name: limits_of(entry).versions for entry in aspects}
        self.growth = GrowthJudge(world)
        self.of_clients = ClientJudge(self, self.growth)
        self.keeping = KeepingJudge(self)
        self.labels: dict[tuple[str, str], Slot] = {}
        self._locks = LockJudge(world)
        self._causes = CauseJudge(world, history)
        self._readers = ReaderJudge(self, versions)
        self._pasts = PastJudge(self, versions)
        self._worlds = WorldJudge(self)

    # ---------------------------------------------------------------- restart

    def judge_prefixes(self, host: ShardNode, *, power_cut: bool) -> None:
        """A shard is about to lose what a crash may take: could it start from any rest?"""
        judge_prefixes(host, self.pictures[host.name], self.durabilities, power_cut=power_cut)

    def crashed(self, host: ShardNode, lost: list[Persist], *, power_cut: bool) -> None:
        """A shard died and its disk lost these records: was it allowed to?"""
        picture = self.pictures[host.name]
        gone = {id(persist) for persist in lost}
        losses: dict[LockId, None] = {}
        for lock, persist in picture.applied.items():
            if persist is None or id(persist) not in gone:
                continue
            if not (power_cut and persist.durability is Durability.OS):
                self.fail("I5 committed survives", lock, persist.durability, power_cut)
            self.permitted_losses[lock] = None
            losses[lock] = None
            self.world.tally["commits lost as declared"] += 1
        self._check_promises(lost, picture)
        for lock, persist in picture.in_flight.items():
            if id(persist) not in gone:
                self.world.tally["commits found after a crash"] += 1
                self._found(host, lock, persist, picture)
        picture.in_flight.clear()
        picture.preparing.clear()
        picture.prepared.clear()
        picture.applied = {lock: None for lock in picture.applied if lock not in losses}

    def _check_promises(self, lost: list[Persist], picture: ShardPicture) -> None:
        """Nothing takes a promise that was given, nor the end of one that is decided."""
        for persist in lost:
            for record in persist.records:
                if isinstance(record, PreparedRecord) and record.lock in picture.prepared:
                    self.fail("a promise survives", record.lock, persist.durability)
                if isinstance(record, PreparedEnded) and record.lock in picture.applied:
                    self.fail("an end of a promise survives", record.lock, persist.durability)

    def _found(
        self, host: ShardNode, lock: LockId, persist: Persist, picture: ShardPicture
    ) -> None:
        """What was under way at a crash turned out to be on disk."""
        for record in persist.records:
            if isinstance(record, DecisionRecord):
                self.decided[lock] = record
        datum_of = _recorded_data(persist)
        if any(isinstance(record, OutcomeRecord) for record in persist.records):
            self._apply(host, lock, persist, picture, datum_of=datum_of)
        else:
            kept = [r for r in persist.records if isinstance(r, SlotRecord) and not r.volatile]
            versions = {r.slot: (r.version, r.stamp_ns) for r in kept}
            self._put_all(lock, versions, picture, datum_of)
            picture.applied[lock] = persist

    def booted(self, host: ShardNode, recovered: Recovered, *, crashed_at_ns: int) -> None:
        """A shard started: what it recovered becomes one writer of all slots in the history."""
        picture = self.pictures.setdefault(host.name, ShardPicture())
        if recovered.epoch <= picture.epoch:
            self.fail("epochs grow", recovered.epoch, picture.epoch)
        picture.epoch = recovered.epoch
        writer = f"restart {recovered.epoch} of {host.name}"
        picture.restarts.append((writer, crashed_at_ns, self.world.now_ns))
        self._worlds.booted(host, recovered, picture)
        picture.vanished = frozenset(picture.chains) - {record.slot for record in recovered.slots}
        found = {record.slot: record for record in recovered.slots if not record.volatile}
        prepared = {w.slot: record.lock for record in recovered.prepared for w in record.writes}
        for slot in list(picture.chains):
            record, before = found.get(slot), picture.now(slot)
            name = (record.version, record.stamp_ns) if record else (0, 0)
            durability = self.durabilities[slot.aspect]
            if durability is Durability.DURABLE and name != before.name:
                self.fail("I4 committed versions never regress", slot, name, before)
            if durability is Durability.OS and name not in _names(picture.chains[slot]):
                self.fail("I19 only declared losses", slot, name)
            content = host.shard.state.slots[slot]
            if (content.version, content.stamp_ns) != name:
                self.fail("I15 recovery is exact", slot, content, name)
            if name != before.name:
                # What is prepared here comes later, however early it was decided elsewhere.
                by = f"{writer} under {prepared[slot]}" if slot in prepared else writer
                picture.put(slot, CommittedState(*name, by, picture.epoch, content.datum))
            elif before.version and stamp_of(content.datum) != stamp_of(before.datum):
                self.fail("a datum keeps its capture stamp", slot, content, before)
            picture.restarted_at[slot] = len(picture.chains[slot]) - 1
        self._causes.booted(host, picture)
        self.growth.booted(host, picture)
        self._pasts.booted(host, recovered, picture)
        if len(recovered.outcomes) > len(picture.lanes):
            self.fail("I14 one outcome per lane", len(recovered.outcomes), len(picture.lanes))
        picture.arrivals.clear()
        picture.granted.clear()
        picture.granted_ever.clear()
        picture.holders.clear()
        picture.under.clear()
        for promise in recovered.prepared:
            lock = promise.lock
            self.world.tally["prepared over a restart"] += 1
            tenure = host.shard.state.tenures.by_lock.get(lock)
            if tenure is None or tenure.token != promise.token or not tenure.claim.granted:
                self.fail("I10 prepared locks are held again", lock)
            picture.prepared[lock] = promise
            picture.granted[lock] = picture.granted_ever[lock] = promise.token
            picture.holders[promise.token] = lock
            picture.arrivals[lock] = 0
        picture.notices = 0
        longest_ns = max((record.ttl_ns for record in recovered.sessions), default=0)
        picture.grace_end_ns = host.local_ns + longest_ns * 101 // 100
        picture.grace_waits_for = {record.session: 0 for record in recovered.sessions}

    # ---------------------------------------------------------------- one step of a shard

    def handled(self, host: ShardNode, message: object, effects: Sequence[Effect]) -> None:
        """Judge one step: what came in, and what the shard decided."""
        picture = self.pictures[host.name]
        acknowledged = isinstance(message, Hello) and message.known_epoch == picture.epoch
        ended = isinstance(message, Goodbye | SessionDied)
        if isinstance(message, Hello | Goodbye | SessionDied) and (acknowledged or ended):
            picture.grace_waits_for.pop(message.session, None)
        if isinstance(message, Commit | Validate):
            picture.named(message.lock, message.token)
        self._worlds.judge(host, effects, picture)
        self._check_commits(host, effects, picture)
        self._worlds.check_told()
        self.growth.handled(host, message, effects, picture)
        self._locks.judge(host, message, picture)
        self.keeping.handled(host, message, effects, picture)
        if isinstance(message, KeepVersions):
            self._pasts.take_keep(host, message, picture)
        for effect in effects:
            if not isinstance(effect, Reply):
                continue
            asked = host.asked.get(effect.reply_to)
            if isinstance(asked, TakeView) and asked.strict:
                self._judge_past(effect.answer, asked, picture)
            elif isinstance(effect.answer, Versions) and isinstance(asked, ListHistory):
                self._pasts.check_list(asked, effect.answer, picture)
            elif isinstance(effect.answer, Kept) and isinstance(asked, KeepVersions):
                self._pasts.check_kept(asked, effect.answer, picture)
            elif isinstance(effect.answer, Granted | Viewed):
                self._readers.check(host, effect.answer, picture)
            elif isinstance(effect.answer, Surveyed) and isinstance(message, Survey):
                self._readers.check_survey(message, effect.answer, picture)
            elif isinstance(effect.answer, Valid):
                lock = effect.answer.lock
                if picture.origin(lock) in picture.granted_ever:  # else it only expected something
                    picture.confirmed[lock] = picture.granted_ever[picture.origin(lock)]

    def _judge_past(self, answer: object, asked: TakeView, picture: ShardPicture) -> None:
        if isinstance(answer, Viewed):
            self._pasts.check_view(answer, asked.at_ns, asked.items, picture)
        elif isinstance(answer, Forgotten):
            self._pasts.check_forgotten(answer, asked, picture)

    def _check_commits(
        self, host: ShardNode, effects: Sequence[Effect], picture: ShardPicture
    ) -> None:
        told = {
            effect.answer.position.stamp_ns: effect.answer
            for effect in effects
            if isinstance(effect, Reply) and isinstance(effect.answer, Committed)
        }
        for effect in effects:
            if isinstance(effect, Persist):
                self._check_persist(effect, picture)
            elif isinstance(effect, Reply) and isinstance(effect.answer, Prepared):
                self._check_prepared(host, effect.answer, picture)
            elif isinstance(effect, Reply) and isinstance(effect.answer, Finished):
                self._check_end_told(host, effect.answer.lock, picture)
            elif isinstance(effect, Publish):
                assert isinstance(effect.notice, Notice)
                picture.notices += 1
                if effect.notice.number != picture.notices:
                    self.fail("notices have no gap", effect.notice.number, picture.notices)
                committed = told.get(effect.notice.changes[0].stamp_ns)
                if self._worlds.explains(effect.notice):
                    continue
                if committed is not None:
                    versions = list(committed.versions)
                    self._applied(host, committed.lock, versions, effect.notice, picture)
                else:
                    self._finished(host, effect.notice, picture)

    def _check_persist(self, persist: Persist, picture: ShardPicture) -> None:
        for record in persist.records:
            if isinstance(record, OutcomeRecord):
                picture.in_flight[record.lock] = persist
            elif isinstance(record, PreparedRecord):
                picture.preparing[record.lock] = record
            elif isinstance(record, DecisionDone):
                left = [
                    shard
                    for shard in self.decided[record.lock].participants
                    if record.lock not in self.pictures[shard].applied
                ]
                if left:
                    self.fail("a decision is kept until all have applied it", record.lock, left)
            elif isinstance(record, PreparedEnded) and persist.ticket:
                picture.in_flight[record.lock] = persist
            elif isinstance(record, PreparedEnded):
                self.world.tally["prepared and aborted"] += 1
                picture.aborted[record.lock] = None
                picture.prepared.pop(record.lock, None)
                if record.lock in self.decided:
                    self.fail("I9 committed and aborted", record.lock)
                if record.lock in picture.applied:
                    self.fail("I9 applied and aborted", record.lock)

    def _check_prepared(self, host: ShardNode, answer: Prepared, picture: ShardPicture) -> None:
        record = picture.preparing.pop(answer.lock, None)
        if record is not None:
            picture.prepared[answer.lock] = record
        if answer.lock not in picture.prepared and answer.lock not in picture.in_flight:
            self.fail("prepared what was not asked", answer)
        picture.confirmed[answer.lock] = picture.prepared[answer.lock].token
        on_disk = host.disk.log[: host.disk.synced]
        if not any(
            isinstance(r, PreparedRecord) and r.lock == answer.lock
            for persist in reversed(on_disk)
            for r in persist.records
        ):
            self.fail("a promise is on disk before it is given", answer)

    def _check_end_told(self, host: ShardNode, lock: LockId, picture: ShardPicture) -> None:
        """Once a participant reports the end, the primary may forget the decision."""
        persist = picture.in_flight.get(lock)
        if persist is not None and not any(
            kept is persist for kept in reversed(host.disk.log[: host.disk.synced])
        ):
            self.fail("an end is on disk before it is confirmed", lock)

    def _finished(self, host: ShardNode, notice: Notice, picture: ShardPicture) -> None:
        """A participant has applied what it had prepared."""
        slots = {change.slot for change in notice.changes}
        for lock, record in picture.prepared.items():
            if lock in picture.in_flight and {w.slot for w in record.writes} == slots:
                break
        else:
            self.fail("only what is prepared is finished", notice)
            return
        if lock not in self.decided:
            self.fail("I9 applied without a decision", lock)
        versions = [SlotVersion(change.slot, change.version) for change in notice.changes]
        self.world.tally["commits finished by participants"] += 1
        self._applied(host, lock, versions, notice, picture)
        del picture.prepared[lock]

    def _applied(
        self,
        host: ShardNode,
        lock: LockId,
        expected: list[SlotVersion],
        notice: Notice,
        picture: ShardPicture,
    ) -> None:
        """A commit became visible."""
        persist = picture.in_flight.pop(lock, None)
        self._check_on_disk(host, lock, persist, notice)
        if picture.granted.get(picture.origin(lock)) is None:
            self.fail("the fence: only a holder commits", lock)
        if [(c.slot, c.version) for c in notice.changes] != expected:
            self.fail("a notice tells what was committed", notice, expected)
        for record in persist.records if persist is not None else ():
            if isinstance(record, DecisionRecord):
                self.decided[lock] = record
                self.world.tally["decisions"] += 1
        versions = {change.slot: (change.version, change.stamp_ns) for change in notice.changes}
        datum_of = {slot: copied(host.shard.state.slots[slot].datum) for slot in versions}
        for change in notice.changes:
            datum = datum_of[change.slot]
            if (change.null, change.captured_ns) != (datum is None, stamp_of(datum)):
                self.fail("a notice tells what was committed", change, datum)
        self._put_all(lock, versions, picture, datum_of)
        picture.applied[lock] = persist
        picture.confirmed[lock] = picture.granted_ever[picture.origin(lock)]
        self._causes.applied(host, lock, notice)
        self.world.tally["commits"] += 1

    def check_all_or_nothing(self) -> None:
        """I3: in the end a lock has its effects on all of its shards or on none."""
        for lock, record in self.decided.items():
            for shard in record.participants:
                if lock not in self.pictures[shard].applied:
                    self.fail("I3 decided, but not applied", lock, shard)
        for name, picture in self.pictures.items():
            if picture.prepared:
                self.fail("I12 nothing stays prepared", name, list(picture.prepared))

    def _check_on_disk(
        self, host: ShardNode, lock: LockId, persist: Persist | None, notice: Notice
    ) -> None:
        strictest = {self.durabilities[change.slot.aspect] for change in notice.changes}
        if strictest == {Durability.VOLATILE}:
            return
        kept = host.disk.synced if Durability.DURABLE in strictest else host.disk.written
        log = host.disk.log
        if persist is None or not any(log[i] is persist for i in range(kept - 1, -1, -1)):
            self.fail("P5 on disk before it is confirmed", lock, strictest)

    def _apply(
        self,
        host: ShardNode,
        lock: LockId,
        persist: Persist,
        picture: ShardPicture,
        *,
        datum_of: dict[Slot, Datum | None],
    ) -> None:
        """A commit that was in flight at a crash turned out to be on disk."""
        (outcome,) = (r for r in persist.records if isinstance(r, OutcomeRecord))
        stamp_ns = outcome.position.stamp_ns
        versions = {slot: (version, stamp_ns) for slot, version in outcome.versions}
        self._put_all(lock, versions, picture, datum_of)
        picture.applied[lock] = persist
        picture.confirmed[lock] = picture.granted_ever[picture.origin(lock)]
        self.world.tally["commits"] += 1

    def _put_all(
        self,
        lock: LockId,
        versions: dict[Slot, tuple[int, int]],
        picture: ShardPicture,
        datum_of: dict[Slot, Datum | None],
    ) -> None:
        if lock in picture.applied:
            self.fail("I16 one execution per lock", lock)
        entry = self.history.entries.get(lock)
        if entry is not None and entry.told in TOLD_NOT:
            self.fail("I5 told not committed, then visible", lock, entry.told)
        for slot, (version, stamp_ns) in versions.items():
            before, datum = picture.now(slot), datum_of.get(slot)
            if version != picture.next_version(slot):
                self.fail("I2 versions are a chain", slot, version, before)
            if before.epoch == picture.epoch and stamp_ns <= before.stamp_ns:
                self.fail("stamps grow", slot, stamp_ns, before)
            if stamp_ns <= picture.promised.get(slot, 0):
                self.fail("the past does not change", slot, stamp_ns, picture.promised[slot])
            if entry is not None:
                self.growth.committed(entry, slot, before.datum, datum, picture)
            if datum is not None:
                self._check_content(lock, slot, before, datum)
            picture.put(slot, CommittedState(version, stamp_ns, lock, picture.epoch, datum))

    def _check_content(
        self, lock: LockId, slot: Slot, before: CommittedState, datum: Datum
    ) -> None:
        if writer_of(datum) != str(lock):
            self.fail("a commit publishes its own data", slot, datum)
        if len(datum.body) != datum.size or bytes(datum.body[FILLED:]).strip(b"."):
            self.fail("no half datum is ever shown", slot, datum.size, len(datum.body))
        if slot.aspect == "made":
            first = self.labels.setdefault((slot.context, label_of(datum)), slot)
            if first != slot:
                self.fail("no phantom: two created one thing", first, slot, label_of(datum))
            return
        old = 0 if before.datum is None else value_of(before.datum)
        emptied = self.durabilities[slot.aspect] is Durability.VOLATILE and before.version == 0
        if value_of(datum) != old + 1 and not (emptied and lock in self.decided):
            self.fail("no lost update", slot, old, datum)


def _names(chain: list[CommittedState]) -> set[tuple[int, int]]:
    return {state.name for state in chain} | {(0, 0)}


def _recorded_data(persist: Persist) -> dict[Slot, Datum | None]:
    return {r.slot: r.datum for r in persist.records if isinstance(r, SlotRecord)}
