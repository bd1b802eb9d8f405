"""The rules of forks and drops: exactly the source as of the stamp, and afterwards nothing at all.

In the chains of slots a fork is one writer on all of its shards, so that a view has to show all of
it or nothing; a drop leaves each slot as if it had never been set, but for its next version.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from enact_dist.core.protocol.messages import DatumRead, Dropped, Forked, WorldEntry
from enact_dist.core.protocol.parts import CAUSE_FORK
from enact_dist.core.protocol.records import Reply, WorldDropped, WorldRecord
from enact_dist.terms import Durability
from enact_dist.verify.simulation.hosts.payloads import copied
from enact_dist.verify.simulation.judges.picture import DROP, NEVER_SET, CommittedState

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from enact_dist.core.protocol.datum import Slot
    from enact_dist.core.protocol.messages import Notice
    from enact_dist.core.protocol.records import Content, Effect, Recovered
    from enact_dist.verify.simulation.hosts.shard_host import ShardNode
    from enact_dist.verify.simulation.judges.history import Observations
    from enact_dist.verify.simulation.judges.picture import ShardPicture


class WorldJudge:
    """Looks at the world contexts of shards that were forked from others."""

    def __init__(self, observed: Observations) -> None:
        self._observed = observed
        self._fail = observed.fail
        self._to_tell: dict[Slot, tuple[int, bool]] = {}

    # ---------------------------------------------------------------- one step of a shard

    def judge(self, host: ShardNode, effects: Sequence[Effect], picture: ShardPicture) -> None:
        """Take note of what was forked or dropped in this step."""
        self._to_tell.clear()
        for effect in effects:
            answer = effect.answer if isinstance(effect, Reply) else None
            if isinstance(answer, Forked) and answer.world not in picture.worlds:
                world = host.shard.state.catalogue.worlds[answer.world]
                wanted = WorldRecord(*world)
                if not any(record == wanted for record in _on_disk(host)):
                    self._fail("a fork is on disk before it is confirmed", host.name, world)
                self._made(host, world, picture)
            elif isinstance(answer, Dropped) and answer.world in picture.worlds:
                self._dropped(host, answer.world, picture)
        for world in host.shard.state.catalogue.shown().forks:
            if picture.worlds.get(world.name) != world:
                self._fail("a fork is there when it is confirmed", host.name, world)

    def explains(self, notice: Notice) -> bool:
        """Whether a notice tells of a fork or a drop of this step; it must do so rightly."""
        if notice.changes[0].slot not in self._to_tell:
            return False
        for change in notice.changes:
            if self._to_tell.pop(change.slot, None) != (change.version, change.null):
                self._fail("watchers learn of forks and drops", change)
        return True

    def check_told(self) -> None:
        """Watchers have learnt of all that changed in this step."""
        if self._to_tell:
            self._fail("watchers learn of forks and drops", self._to_tell)

    def _made(self, host: ShardNode, world: WorldEntry, picture: ShardPicture) -> None:
        """A fork is there: it has what its source had, and nothing else."""
        wanted = _as_of(picture, world)
        found = dict(host.shard.state.slots.of_context(world.name))
        for slot, source in wanted.items():
            if source.version and slot not in found:
                self._fail("a fork has all that its source had", slot, source)
        for slot, content in found.items():
            # What a crash took of a first volatile write leaves an unseen null slot.
            self._check_slot(slot, content, wanted.get(slot, NEVER_SET), world, picture)
            self._put(slot, content, world, picture)
            self._to_tell[slot] = (content.version, content.datum is None)
        self._enter(world, picture)
        self._observed.count("worlds forked", 1)
        self._observed.count("slots forked", len(found))

    def _check_slot(
        self,
        slot: Slot,
        content: Content,
        source: CommittedState,
        world: WorldEntry,
        picture: ShardPicture,
    ) -> None:
        version = picture.bases.get(slot.context, 0) + 1
        if content.stamp_ns != world.at_ns:
            self._fail("a fork is of one moment", slot, content, world)
        if content.version != version:
            self._fail("the versions of a context are never used twice", slot, content, version)
        if _bytes(content.datum) != _bytes(source.datum):
            self._fail("a fork has what its source had", slot, content, source)
        cause, at = content.cause, slot._replace(context=world.source)
        read = DatumRead(at, *source.name)
        if cause is None or (cause.kind, cause.reads) != (CAUSE_FORK, (read,)):
            self._fail("a fork's lineage goes on in its source", slot, cause, source)

    def _put(self, slot: Slot, content: Content, world: WorldEntry, picture: ShardPicture) -> None:
        state = CommittedState(
            content.version, world.at_ns, _writer(world), picture.epoch, copied(content.datum)
        )
        picture.put(slot, state)

    def _enter(self, world: WorldEntry, picture: ShardPicture) -> None:
        now_ns = self._observed.world.now_ns
        picture.worlds[world.name] = world
        picture.restarts.append((_writer(world), now_ns, now_ns))

    def _dropped(self, host: ShardNode, name: str, picture: ShardPicture) -> None:
        """A context is gone: no client was in it, and nothing is left but the base of versions."""
        for tenure in host.shard.state.tenures.by_lock.values():
            if any(item.context == name for item in tenure.items):
                self._fail("no client has a lock in a context that goes", name, tenure.lock)
        left = next(iter(host.shard.state.slots.of_context(name)), None)
        if left is not None:
            self._fail("nothing is left of a dropped context", left)
        records = (r for r in _on_disk(host) if isinstance(r, WorldDropped) and r.name == name)
        record = next(records, None)
        if record is None:
            self._fail("a drop is on disk before it is confirmed", host.name, name)
        else:
            for slot, state in _of_context(picture, name):
                if state.datum is not None:
                    self._to_tell[slot] = (state.version + 1, True)
            self._gone(record, picture)
            self._observed.count("worlds dropped", 1)

    def _gone(self, record: WorldDropped, picture: ShardPicture) -> None:
        now_ns = self._observed.world.now_ns
        writer = DROP + _writer(picture.worlds.pop(record.name))
        for slot, state in _of_context(picture, record.name):
            told = state.version + (state.datum is not None)
            if record.version_base < max(told, picture.bases.get(record.name, 0)):
                self._fail("the versions of a context are never used twice", record, slot, state)
            picture.put(slot, CommittedState(0, 0, writer, picture.epoch, None))
            picture.restarted_at[slot] = len(picture.chains[slot]) - 1
        picture.bases[record.name] = record.version_base
        picture.restarts.append((writer, now_ns, now_ns))

    # ---------------------------------------------------------------- restart

    def booted(self, host: ShardNode, recovered: Recovered, picture: ShardPicture) -> None:
        """A shard started: forks and drops that it has found on its disk count from now on."""
        forks = {r.name: WorldEntry(*_fields(r)) for r in recovered.worlds if r.source}
        dropped = {record.name: record for record in recovered.dropped}
        for name, world in list(picture.worlds.items()):
            if forks.get(name) == world:
                continue
            newest = (r for p in reversed(host.disk.log) for r in reversed(p.records))
            acts = (r for r in newest if isinstance(r, WorldRecord | WorldDropped))
            if dropped.get(name) != next((r for r in acts if r.name == name), None):
                self._fail("a fork survives", host.name, world)
            self._observed.count("drops found after a crash", 1)
            self._gone(dropped[name], picture)
        for name, world in forks.items():
            if name not in picture.worlds:
                self._observed.count("forks found after a crash", 1)
                self._found(host, world, picture)

    def _found(self, host: ShardNode, world: WorldEntry, picture: ShardPicture) -> None:
        """A fork that the disk was working on is there after all, but for what is volatile."""
        wanted = _as_of(picture, world)
        for slot, content in host.shard.state.slots.of_context(world.name):
            durability = self._observed.durabilities[slot.aspect]
            if durability is not Durability.VOLATILE:
                self._check_slot(slot, content, wanted.get(slot, NEVER_SET), world, picture)
                self._put(slot, content, world, picture)
        self._enter(world, picture)


def _fields(record: WorldRecord) -> tuple[str, str, int]:
    return record.name, record.source, record.at_ns


def _writer(world: WorldEntry) -> str:
    return f"fork {world.name} of {world.source} as of {world.at_ns}"


def _on_disk(host: ShardNode) -> Iterable[object]:
    """Yield what no power cut can take any more, the newest first."""
    for persist in reversed(host.disk.log[: host.disk.synced]):
        yield from persist.records


def _of_context(picture: ShardPicture, name: str) -> list[tuple[Slot, CommittedState]]:
    return [(slot, chain[-1]) for slot, chain in picture.chains.items() if slot.context == name]


def _as_of(picture: ShardPicture, world: WorldEntry) -> dict[Slot, CommittedState]:
    """Return what a fork is to show, by its own slots."""
    return {
        slot._replace(context=world.name): picture.at(slot, world.at_ns)
        for slot, _ in _of_context(picture, world.source)
    }


def _bytes(datum: object) -> bytes | None:
    body = getattr(datum, "body", None)
    return None if body is None else bytes(body)
