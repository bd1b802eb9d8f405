"""What the clients do: random locks of every kind, through the public API alone.

Every datum says who wrote it: ``lock version epoch``, then padding, so that a reader can
reconstruct a history.  `version` is the one that it gets if its lock commits, `epoch` the one of
its shard; a volatile slot counts anew after a restart, so both are needed there.
"""

from __future__ import annotations

import random
import time
from dataclasses import dataclass, field
from typing import Any, Final, cast

from enact_dist import (
    Aspect,
    Cell,
    Durability,
    Entities,
    Entity,
    Lock,
    Read,
    ReadEach,
    View,
    Write,
    WriteEach,
)
from enact_dist.core.protocol.datum import Slot
from enact_dist.core.protocol.placement import shard_of
from enact_dist.errors import (
    ChangedError,
    ClockSkewError,
    CommitUnknownError,
    EnactError,
    LeaseLostError,
    LockTimeoutError,
    ShardUnreachableError,
)
from enact_dist.terms import LockRequest, LockRequestOne
from enact_dist.verify.chaos.journal import UNSEEN, Journal
from enact_dist.verify.checker import LockOutcome

WORLDS: Final = ("online", "training")
ASPECTS: Final = {
    "kept": Aspect("kept", str, Durability.DURABLE),
    "swift": Aspect("swift", str, Durability.OS),
    "frame": Aspect("frame", str, Durability.VOLATILE),
    "made": Aspect("made", str, Durability.DURABLE),
}
VOLATILE: Final = "frame"
MADE: Final = "made"
THINGS_PER_SHARD: Final = 4
GENERATION_S: Final = 8.0
"""Things are created under a pattern that changes so often, so that patterns stay small."""
MADE_PER_GENERATION: Final = 12
LARGE: Final = 100_000
"""Padding of a large datum, which does not travel with the grant."""
NOT_WRITTEN: Final = (
    LeaseLostError,
    ChangedError,
    LockTimeoutError,
    ShardUnreachableError,
    ClockSkewError,
)
"""Errors that say that nothing was written."""
UNEXPECTED: Final = "unexpected: "


class DiscardError(Exception):
    """Raised in a block whose writes shall not be published."""


@dataclass(slots=True)
class PlannedLock:
    """One lock to be: its requests and what to do with it."""

    kind: str
    requests: list[LockRequest[Any]]
    write: list[Write[str]] = field(default_factory=list)
    expect: list[View[str]] = field(default_factory=list)
    each: LockRequest[Any] | None = None
    blind: bool = False
    delete: bool = False
    discard: bool = False
    large: bool = False
    think_s: float = 0.0
    wait_s: float = 2.0
    hold_s: float = 30.0


class LockWorkload:
    """One thread of locks.

    Args:
        cell: The cell.
        journal: Gets what happens.
        name: First part of the ids of its locks; unique in the run.
        seed: What it does is drawn from.
        ttl_s: Session TTL of the cell.
    """

    def __init__(self, cell: Cell, journal: Journal, name: str, *, seed: int, ttl_s: float) -> None:
        self.cell = cell
        self._journal, self._name, self._ttl_s = journal, name, ttl_s
        self._draw = random.Random(seed)
        self._count = 0
        self._worlds = {world: cell.world(world) for world in WORLDS}
        self._shards = [shard.name for shard in cell.shards()]
        self.skewed = False

    # ---------------------------------------------------------------- plans

    def _thing(self, shard: str) -> tuple[Any, Entity, Aspect[str]]:
        draw = self._draw
        world = self._worlds[draw.choices(WORLDS, (3, 1))[0]]
        number = draw.choices(range(THINGS_PER_SHARD), range(THINGS_PER_SHARD, 0, -1))[0]
        name = draw.choices(("kept", "swift", "frame"), (4, 2, 2))[0]
        return world, Entity(f"thing/{shard}/{number}"), ASPECTS[name]

    def plan(self) -> PlannedLock:
        """Draw the next lock."""
        draw = self._draw
        kinds = {
            "write one": 4,
            "write over shards": 5,
            "read": 2,
            "read and write": 4,
            "expect and write": 3,
            "view": 2,
            "look, then create": 1,
            "read all, write one": 1,
        }
        kind = draw.choices(list(kinds), list(kinds.values()))[0]
        plan = self._requests(kind)
        plan.discard = draw.random() < 0.03
        plan.large = draw.random() < 0.02
        plan.wait_s = draw.choice((0.0, 0.5, 2.0, 4.0))
        if draw.random() < 0.25:
            plan.think_s = draw.uniform(0.0, 0.03)
        elif draw.random() < 0.02:
            plan.think_s = draw.uniform(0.0, 1.5) * self._ttl_s
            plan.hold_s = draw.choice((0.3, 30.0))
        return plan

    def _requests(self, kind: str) -> PlannedLock:
        draw, shards = self._draw, self._shards
        some = draw.sample(shards, draw.randint(min(2, len(shards)), len(shards)))
        things = {self._thing(shard): None for shard in some}
        if kind == "write one":
            write = Write(*self._thing(draw.choice(shards)))
            blind = draw.random() < 0.15 and write.aspect.name != VOLATILE
            delete = draw.random() < 0.05 and write.aspect.name != VOLATILE
            return PlannedLock(kind, [write], [write], blind=blind, delete=delete)
        if kind == "write over shards":
            writes = [Write(*thing) for thing in things]
            return PlannedLock(kind, list(writes), writes)
        if kind == "read":
            return PlannedLock(kind, [Read(*thing) for thing in things])
        if kind == "view":
            more = {self._thing(draw.choice(shards)): None for _ in range(2)}
            return PlannedLock(kind, [View(*thing) for thing in {**things, **more}])
        if kind == "read and write":
            first, *others = things
            write = Write(*first)
            return PlannedLock(kind, [write, *(Read(*thing) for thing in others)], [write])
        if kind == "expect and write":
            first, *others = things
            write, views = Write(*first), [View(*thing) for thing in others]
            expect = [view for view in views if draw.random() < 0.7]
            return PlannedLock(kind, [write, *views], [write], expect=expect)
        world = self._worlds["online"]
        generation = int(self._journal.now_ns() / 1e9 / GENERATION_S)
        pattern = Entities(f"made/{generation}/*")
        if kind == "look, then create":
            every = WriteEach(world, pattern, ASPECTS[MADE])
            return PlannedLock(kind, [every], each=every)
        write = Write(*self._thing(draw.choice(shards)))
        all_of = ReadEach(world, pattern, ASPECTS[MADE])
        return PlannedLock(kind, [all_of, write], [write], each=all_of)

    # ---------------------------------------------------------------- one lock

    def run_one(self) -> LockOutcome:
        """Take one lock that is drawn; see `take`."""
        return self.take(self.plan())

    def take(self, plan: PlannedLock) -> LockOutcome:
        """Take one lock, from asking to its end; its history is in the journal."""
        self._count += 1
        lock_id = f"{self._name}.{self._count}"
        journal = self._journal
        items = [[int(request.access), *request.address] for request in plan.requests]
        journal.write("begin", lock_id, journal.now_ns(), plan.kind, items)
        told, why = LockOutcome.NOT, ""
        try:
            with Lock(*plan.requests, wait_s=plan.wait_s, hold_s=plan.hold_s) as lock:
                journal.write("granted", lock_id, journal.now_ns(), lock.token)
                self._block(lock, lock_id, plan)
            told = LockOutcome.COMMITTED
        except DiscardError:
            why = "discarded"
        except CommitUnknownError:
            told, why = LockOutcome.UNKNOWN, "CommitUnknownError"
        except NOT_WRITTEN as error:
            why = type(error).__name__
            self.skewed = isinstance(error, ClockSkewError)
        except EnactError as error:
            told, why = LockOutcome.UNKNOWN, f"{UNEXPECTED}{type(error).__name__}: {error}"
        journal.write("end", lock_id, journal.now_ns(), told.value, why)
        return told

    def take_all(self) -> LockOutcome:
        """Read everything that any workload writes, under one lock."""
        things = [
            Read(world, Entity(f"thing/{shard}/{number}"), aspect)
            for world in self._worlds.values()
            for shard in self._shards
            for number in range(THINGS_PER_SHARD)
            for aspect in ASPECTS.values()
            if aspect.name != MADE
        ]
        made = ReadEach(self._worlds["online"], Entities(f"{MADE}/**"), ASPECTS[MADE])
        return self.take(PlannedLock("read everything", [*things, made], wait_s=20.0))

    def _block(self, lock: Lock, lock_id: str, plan: PlannedLock) -> None:
        seen = self._look(lock, plan)
        self._journal.write("seen", lock_id, seen)
        if plan.think_s:
            time.sleep(plan.think_s)
        epochs = {shard: epoch for shard, epoch, _ in lock.token}
        writes = [self._write(lock, lock_id, write, plan, epochs) for write in plan.write]
        if plan.each is not None and isinstance(plan.each, WriteEach):
            writes += self._create(lock, lock_id, plan.each, epochs)
        for view in plan.expect:
            lock.expect(view)
        if plan.discard:
            raise DiscardError
        expected = [slot_name(view) for view in plan.expect]
        self._journal.write("write", lock_id, writes, expected)

    def _look(self, lock: Lock, plan: PlannedLock) -> list[tuple[str, int, str, bool]]:
        """Read everything that was asked for; return it in the words of the journal."""
        seen = []
        for request in plan.requests:
            if request.access.each:
                for entity, datum in lock[cast("ReadEach[str]", request)].items():
                    writer, version, _ = read_header(datum)
                    slot = Slot(request.world.name, entity.name, request.aspect.name)
                    seen.append((str(slot), int(version), writer, True))
                continue
            one = cast("LockRequestOne[str]", request)
            if plan.blind:
                writer = UNSEEN
            else:
                found = lock.get(one)
                writer = read_header(found)[0] if found is not None else ""
            seen.append((slot_name(one), lock.version(one), writer, one.access.locks))
        return seen

    def _write(
        self, lock: Lock, lock_id: str, write: Write[str], plan: PlannedLock, epochs: dict[str, int]
    ) -> tuple[str, int, str]:
        version = lock.version(write) + 1
        if plan.delete:
            del lock[write]
            return slot_name(write), version, ""
        epoch = epochs[self._shard_of(str(write.entity))]
        lock[write] = datum_text(lock_id, version, epoch, large=plan.large)
        return slot_name(write), version, lock_id

    def _create(
        self, lock: Lock, lock_id: str, each: WriteEach[str], epochs: dict[str, int]
    ) -> list[tuple[str, int, str]]:
        """Create the next thing of the generation, unless all are there."""
        things = lock[each]
        if len(things) >= MADE_PER_GENERATION:
            return []
        entity = Entity.fresh(str(each.entity).removesuffix("/*"))
        things[entity] = datum_text(lock_id, 1, epochs[self._shard_of(entity.name)])
        return [(str(Slot(each.world.name, entity.name, each.aspect.name)), 1, lock_id)]

    def _shard_of(self, entity: str) -> str:
        return shard_of(entity, self.cell._client.core.placement)  # noqa: SLF001 - for the epoch


def datum_text(lock_id: str, version: int, epoch: int, *, large: bool = False) -> str:
    """Return a datum that says who wrote it."""
    return f"{lock_id} {version} {epoch}\n" + "." * (LARGE if large else 0)


def read_header(datum: str) -> tuple[str, str, str]:
    """Return who wrote a datum, as which version, in which epoch."""
    writer, version, epoch = datum.partition("\n")[0].split(" ")
    return writer, version, epoch


def slot_name(request: LockRequest[Any]) -> str:
    """Return how journals name the slot of a request for one entity."""
    return str(Slot(*request.address))
