"""Large data that travel apart from their commits, on a bad network: both ends, and their judge.

Each simulated shard has a real `PayloadDesk` in plain memory, new with each start.  Clients bring
some of their large data in slices, which are lost, doubled, late and cut off by crashes; some name
a payload of which only a part has come, or nothing.  Whatever happens, a commit has all of its
bytes, and a payload is gone as soon as nothing of its shard shows it any more.  A draft ends with
its session, or, where the session holds no lock, after 30 s of its shard without a slice.
"""

from __future__ import annotations

import weakref
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.datum import Datum
from enact_dist.core.protocol.messages import Commit, EpochChanged, Prepare, Stage, Staged
from enact_dist.core.protocol.records import Persist, PreparedRecord, SlotRecord
from enact_dist.link.memory.maps import PlainMemory
from enact_dist.link.memory.payload_desk import PayloadDesk
from enact_dist.verify.simulation.hosts.world import Host, S

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from enact_dist.core.protocol.messages import Answer, Request, WriteItem
    from enact_dist.core.protocol.records import Effect
    from enact_dist.core.shard.shard import Shard
    from enact_dist.core.state.tenure import Tenure

BYTES_MAX: Final = 64 << 20
DRAFT_NS: Final = 30 * S
"""A draft of a session without a lock ends when it has had no slice for longer."""


class HostClock:
    """The clocks of a simulated host, as the real parts read them."""

    def __init__(self, host: Host) -> None:
        self._host = host

    def monotonic_ns(self) -> int:
        """Return what its steady clock shows."""
        return self._host.local_ns

    def wall_ns(self) -> int:
        """Return what its wall clock shows."""
        return self._host.wall_ns


class ShardPayloads:
    """The payloads of one life of a shard, and who may still hold them."""

    def __init__(self, host: Host, shard: Shard, is_unused: Callable[[Tenure], bool]) -> None:
        self._world, self._shard, self._host = host.world, shard, host
        self._is_unused = is_unused
        self.desk = PayloadDesk(None, BYTES_MAX, clock=HostClock(host))
        self._adopted: dict[str, weakref.ref[PlainMemory]] = {}
        self._drafts: dict[str, tuple[str, int, int]] = {}
        """Of each draft its session, its first and its newest slice, by the shard's clock."""

    def stage(self, message: Stage) -> Answer:
        """Take a slice, as the shard's link does."""
        if message.total and message.session not in self._shard.state.sessions.by_id:
            return EpochChanged(self._shard.epoch)
        self._world.tally["slices staged"] += 1
        answer = self.desk.stage(message)
        file, now_ns = message.file, self._host.local_ns
        if file not in self._adopted and isinstance(answer, Staged):
            _, begun_ns, _ = self._drafts.get(file, ("", now_ns, now_ns))
            self._drafts[file] = message.session, begun_ns, now_ns
        return answer

    def with_bodies(self, message: Request) -> Request:
        """Put in what a commit names, as the shard's link does."""
        if not isinstance(message, Commit | Prepare):
            return message
        bare = tuple(_as_in_a_frame(write) for write in message.writes)
        message = replace(message, writes=bare)
        found: Commit | Prepare
        if isinstance(message, Commit):
            found = self.desk.with_bodies(message)
        else:
            found = self.desk.with_bodies(message)
        for before, after in zip(message.writes, found.writes, strict=True):
            memory = _memory_of(after.datum)
            if before.datum is None or not before.datum.file or memory is None:
                continue
            known = self._adopted.get(before.datum.file)
            again = known is not None and known() is memory
            self._world.tally["payloads adopted again" if again else "payloads adopted"] += 1
            self._adopted[before.datum.file] = weakref.ref(memory)
            _, begun_ns, _ = self._drafts.pop(before.datum.file, ("", self._host.local_ns, 0))
            late = self._host.local_ns - begun_ns > DRAFT_NS
            self._world.tally["payloads adopted after a long time"] += late
        return found

    def look(self) -> None:
        """Give up drafts as the shard's link does at each tick: those that must end, no others."""
        state, now_ns = self._shard.state, self._host.local_ns
        sessions, before = state.sessions.by_id, self._holders()
        self.desk.sweep(sessions.__contains__, state.tenures.works)
        left, after = self.desk.drafts(), self._holders()
        for file in left:
            if file in self._adopted:
                self._world.violation("a payload is made once", file)
        for file, (session, _, newest_ns) in list(self._drafts.items()):
            if session not in sessions:
                over = "drafts end with their session"
            elif now_ns - newest_ns <= DRAFT_NS or session in before & after:
                over = ""
            elif session in before | after and file in left:
                over = ""  # its client went on while the shard looked
            else:
                over = "drafts end after a time without a slice"
                self._world.tally["drafts given up for want of slices"] += 1
            if over and file in left:
                self._world.violation(over, file)
            if not over and file not in left:
                self._world.violation("a draft stays while its client may commit it", file)
            if over:
                del self._drafts[file]

    def _holders(self) -> set[str]:
        """Return the sessions with a lock, other than kept grants that they do not use."""
        if not self._drafts:
            return set()
        tenures = self._shard.state.tenures.by_lock.values()
        return {tenure.lock.session for tenure in tenures if not self._is_unused(tenure)}

    def check_released(self) -> None:
        """When nothing is under way, a payload lives as long as a slot or a reader shows it."""
        held = {id(_memory_of(datum)) for datum in _shown(self._shard)}
        for file, adopted in self._adopted.items():
            memory = adopted()
            if memory is None:
                self._world.tally["payloads released"] += 1
            elif id(memory) not in held:
                self._world.violation("a payload ends with its last holder", file)
            else:
                self._world.tally["payloads held to the end"] += 1


def _as_in_a_frame(write: WriteItem) -> WriteItem:
    """Leave out the bytes of a datum that names a payload, as its frame does."""
    datum = write.datum
    if datum is None or not datum.file:
        return write
    return write._replace(datum=replace(datum, body=b""))


def _memory_of(datum: Datum | None) -> PlainMemory | None:
    body = None if datum is None else datum.body
    if isinstance(body, memoryview) and isinstance(body.obj, PlainMemory):
        return body.obj
    return None


def _shown(shard: Shard) -> Iterator[Datum | None]:
    """Yield all data that an idle shard can still show."""
    slots = shard.state.slots
    for column in slots.columns():
        for slot, content in slots.matching(column, "**"):
            yield content.datum
            found = slots.history.of(slot)
            if found is not None:
                yield from (old.datum for old in found.states)
                yield from (kept.content.datum for kept in found.kept.values())
    for lock in shard.state.pins:
        yield from shard.state.pins.get(lock).values()


def copied(datum: Datum | None) -> Datum | None:
    """Return a datum that holds on to no payload: what a disk or a judge keeps."""
    if datum is None or _memory_of(datum) is None:
        return datum
    return replace(datum, body=bytes(datum.body))


def as_kept(effect: Effect) -> Effect:
    """Return what a disk keeps of an effect; others stay as they are."""
    if not isinstance(effect, Persist):
        return effect
    records = list(effect.records)
    for index, record in enumerate(records):
        if isinstance(record, SlotRecord) and _memory_of(record.datum) is not None:
            records[index] = replace(record, datum=copied(record.datum))
        elif isinstance(record, PreparedRecord) and any(_memory_of(w.datum) for w in record.writes):
            writes = tuple(write._replace(datum=copied(write.datum)) for write in record.writes)
            records[index] = replace(record, writes=writes)
    if all(one is other for one, other in zip(records, effect.records, strict=True)):
        return effect
    return replace(effect, records=tuple(records))
