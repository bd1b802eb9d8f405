"""Large data that travel apart from their commits, on a bad network: both ends, and their judge.

Each simulated shard has a real `PayloadDesk` in plain memory, new with each start.  Clients bring
some of their large data in slices, which are lost, doubled, late and cut off by crashes; some name
a payload of which only a part has come, or nothing.  Whatever happens, a commit has all of its
bytes, and a payload is gone as soon as nothing of its shard shows it any more.
"""

from __future__ import annotations

import weakref
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from enact_dist.core.datum import Datum
from enact_dist.core.messages import Commit, EpochChanged, Prepare, Stage, Staged
from enact_dist.core.records import Persist, PreparedRecord, SlotRecord
from enact_dist.link.memory import Plain
from enact_dist.link.payload_desk import PayloadDesk
from enact_dist.verify.simulation.client_host import Calls, ClientHost, Steps
from enact_dist.wire.limits import PAYLOAD_BYTES_MIN

if TYPE_CHECKING:
    from collections.abc import Iterator
    from random import Random

    from enact_dist.core.messages import Answer, Request, WriteItem
    from enact_dist.core.records import Effect
    from enact_dist.core.shard import Shard
    from enact_dist.verify.simulation.world import World

BYTES_MAX: Final = 64 << 20
SLICES: Final = 3
TRIES: Final = 8


# ---------------------------------------------------------------- at a shard


class ShardPayloads:
    """The payloads of one life of a shard, and who may still hold them."""

    def __init__(self, world: World, shard: Shard) -> None:
        self._world, self._shard = world, shard
        self.desk = PayloadDesk(None, BYTES_MAX)
        self._adopted: dict[str, weakref.ref[Plain]] = {}

    def stage(self, message: Stage) -> Answer:
        """Take a slice, as the shard's link does."""
        if message.total and message.session not in self._shard.state.sessions.by_id:
            return EpochChanged(self._shard.epoch)
        self._world.tally["slices staged"] += 1
        return self.desk.stage(message)

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
        return found

    def look(self) -> None:
        """Give up drafts as the shard's link does at each tick; none outlives its session."""
        state = self._shard.state
        self.desk.sweep(state.sessions.by_id.__contains__, state.tenures.by_session.__contains__)
        for file, session in self.desk.drafts().items():
            if session not in state.sessions.by_id:
                self._world.violation("drafts end with their session", file)
            if file in self._adopted:
                self._world.violation("a payload is made once", file)

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


def _memory_of(datum: Datum | None) -> Plain | None:
    body = None if datum is None else datum.body
    if isinstance(body, memoryview) and isinstance(body.obj, Plain):
        return body.obj
    return None


def _shown(shard: Shard) -> Iterator[Datum | None]:
    """Yield all data that a shard that rests can still show to somebody."""
    slots = shard.state.slots
    for column in slots.columns():
        for slot, content in slots.matching(column, "**"):
            yield content.datum
            yield from (old.datum for old in slots.retained.of(slot))
            yield from (old.datum for old in slots.past.of(slot))
    for pins in shard.state.pins.values():
        yield from pins.values()


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


# ---------------------------------------------------------------- at a client


class Stager:
    """Brings large data to their shards before their commit."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._made = 0

    def staged(
        self, host: ClientHost, shard: str, writes: list[WriteItem], luck: Random
    ) -> Steps[list[WriteItem]]:
        """Return writes that name what was staged; of some, that only a part or nothing was."""
        found: list[WriteItem] = []
        for write in writes:
            datum = write.datum
            if datum is None or datum.size <= PAYLOAD_BYTES_MIN or luck.random() < 0.2:
                found.append(write)
                continue
            self._made += 1
            file = f"{host.client.session}-{self._made:x}"
            hasty = luck.random() < 0.2
            whole = yield from self._stage(host, shard, file, datum, luck, hasty=hasty)
            named = whole or hasty
            self._world.tally["payloads named too early"] += named and not whole
            found.append(write._replace(datum=replace(datum, file=file)) if named else write)
        return found

    def _stage(
        self, host: ClientHost, shard: str, file: str, datum: Datum, luck: Random, *, hasty: bool
    ) -> Steps[bool]:
        """Send slices from where the shard is, whatever is lost; return whether it has them all."""
        have, step = 0, datum.size // SLICES + 1
        for _ in range(luck.randrange(SLICES) if hasty else TRIES):
            here = datum.body[have : have + step]
            part = Datum(b"", here, len(here))
            stage = Stage(host.client.session, file, have, datum.size, part)
            (answer,) = yield Calls([(shard, stage)])
            if isinstance(answer, Staged):
                have = answer.have
            elif answer is not None:
                break
            else:
                self._world.tally["slices sent again"] += 1
            if have == datum.size:
                return True
        return False
