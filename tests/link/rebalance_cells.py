"""A stopped cell whose shards are filled and looked at one by one, with the public API.

Each shard is opened with `local()` and given only entities that the cell would place there.
"""

import random
from contextlib import ExitStack, contextmanager

import numpy as np

from enact_dist import (
    Aspect,
    Durability,
    Entity,
    Lock,
    Position,
    Read,
    Retention,
    View,
    Write,
    local,
)
from enact_dist.core.protocol.messages import Pin, PlacementMap, ShardEntry
from enact_dist.core.protocol.placement import shard_of
from enact_dist.errors import ForgottenError, NullDatumError

POSE = Aspect("pose", list, Durability.DURABLE, retention=Retention(versions=3))
ASPECTS = (
    POSE,
    Aspect("note", str, Durability.OS, retention=Retention(versions=50)),
    Aspect("cloud", np.ndarray, Durability.DURABLE, retention=Retention(versions=50)),
    Aspect("swift", int, Durability.VOLATILE),
)
ENTITIES = tuple(Entity(f"part/{number}") for number in range(8))
LATE = Entity("late")
"""Has data only in contexts that are dropped, until somebody writes it."""
PROBES = 12
"""So many moments of the past are looked at."""


def placement(*names, pins=()):
    """Return a placement over shards of these names."""
    shards = tuple(ShardEntry(name, ()) for name in names)
    return PlacementMap(len(names), shards, tuple(Pin(*pin) for pin in pins))


def datum_of(aspect, rng):
    """Return some datum of an aspect, large ones included."""
    number = rng.randrange(1 << 30)
    if aspect.name == "cloud":
        return np.full(rng.choice((10, 20_000)), number, np.int64)
    return {"pose": [number], "note": f"note {number}", "swift": number}[aspect.name]


class StoppedCell:
    """The folders of a cell that is not running.

    Args:
        folder: Where the folders are.
        where: The placement by which `fill` and `write` place entities; may change.
    """

    def __init__(self, folder, where):
        self.folder = folder
        self.where = where

    @property
    def folders(self):
        """The folder of each shard of the placement."""
        return {entry.name: self.folder / entry.name for entry in self.where.shards}

    @contextmanager
    def opened(self):
        """Start all shards, each alone; their cells by name."""
        with ExitStack() as stack:
            yield {n: stack.enter_context(local(path)) for n, path in self.folders.items()}

    def fill(self, seed, *, rounds=30):
        """Write, delete, keep and fork over all shards; drop contexts and make one again."""
        rng = random.Random(seed)
        with self.opened() as cells:
            for cell in cells.values():
                cell.create_world("online")
            self._write(cells, rng, "online", rounds)
            for name in ("again", "gone"):
                for cell in cells.values():
                    cell.create_world(name)
                self._write(cells, rng, name, rounds)
                self.put(cells, name, LATE, rng.randrange(1, 9))
                for cell in cells.values():
                    cell.drop_world(name)
            self._fork(cells, "again")
            self._write(cells, rng, "again", rounds // 2)
            self._keep(cells, rng)
            self._write(cells, rng, "online", rounds)
            self._fork(cells, "what_if")

    def put(self, cells, world, entity, times):
        """Write one pose so often; return its last version."""
        world = cells[shard_of(entity.name, self.where)].world(world)
        for number in range(times):
            with Lock(write := Write(world, entity, POSE)) as lock:
                lock[write] = [number]
        return world.history(entity, POSE)[-1].version

    def _write(self, cells, rng, world, rounds):
        for _ in range(rounds):
            first = rng.choice(ENTITIES)
            shard = shard_of(first.name, self.where)
            near = [e for e in ENTITIES if shard_of(e.name, self.where) == shard]
            here, aspects = cells[shard].world(world), rng.sample(ASPECTS, 3)
            writes = [Write(here, first, aspects[0]), Write(here, rng.choice(near), aspects[1])]
            read = Read(here, rng.choice(near), aspects[2])
            with Lock(read, *writes) as lock:
                lock.get(read, None)
                for write in writes:
                    if rng.random() < 0.2:
                        del lock[write]
                    else:
                        lock.put(write, datum_of(write.aspect, rng), stamp_ns=rng.randrange(1, 99))

    def _fork(self, cells, name):
        """Fork as of one stamp on all shards, as a cell does."""
        position = None
        for shard, cell in cells.items():
            here = next(e for e in ENTITIES if shard_of(e.name, self.where) == shard)
            with Lock(write := Write(cell.world("online"), here, POSE)) as lock:
                lock[write] = [0]
            position = max(position or lock.position, lock.position)
        for cell in cells.values():
            cell.world("online").fork(name, at=position)

    def _keep(self, cells, rng):
        for label in ("incident-7", "best"):
            for cell in cells.values():
                found = [v for slot in _slots(cell) for v in _history(cell, slot)]
                found = [v for v in found if v.position.stamp_ns and v.version]
                cell.pin(label, rng.sample(found, min(3, len(found))))

    # ---------------------------------------------------------------- what there is

    def shown(self, probes_ns=()):
        """Return everything that the shards show, by slot and label, and where each entity is.

        Args:
            probes_ns: Moments of the past that are looked at.
        """
        slots, labels, places = {}, {}, {}
        with self.opened() as cells:
            worlds = {
                (n, cell.world(n).forked_from) for cell in cells.values() for n in cell.worlds()
            }
            for shard, cell in cells.items():
                for label, versions in cell.pinned().items():
                    named = {(*v.slot, v.version, v.position.stamp_ns) for v in versions}
                    labels[label] = labels.get(label, set()) | named
                for slot in _slots(cell):
                    places.setdefault(slot[1].name, set()).add(shard)
                    slots[slot] = _shown_of(cell, slot, probes_ns)
        return {"slots": slots, "labels": labels, "worlds": worlds}, places

    def probes_ns(self):
        """Return moments just before and at some commits, spread over all."""
        with self.opened() as cells:
            found = sorted(
                {v.position.stamp_ns for cell in cells.values() for slot in _slots(cell)
                 for v in _history(cell, slot) if v.position.stamp_ns}
            )  # fmt: skip
        some = found[:: max(1, len(found) // PROBES)]
        return [stamp for at in some for stamp in (at - 1, at)]


def _slots(cell):
    entities = {(w, e) for w in cell.worlds() for e in cell.world(w).entities()}
    entities |= {(w, e) for w in cell.worlds() for e in (*ENTITIES, LATE)}
    found = ((w, e, a) for w, e in sorted(entities, key=str) for a in ASPECTS)
    return [slot for slot in found if _history(cell, slot)]


def _history(cell, slot):
    world, entity, aspect = slot
    return cell.world(world).history(entity, aspect)


def _shown_of(cell, slot, probes_ns):
    """Return the versions of a slot with data and causes, and what it was at some moments."""
    world, entity, aspect = slot
    versions = []
    for v in _history(cell, slot):
        why = None
        if v.version and aspect.durability is not Durability.VOLATILE:
            tree = cell.why(cell.world(world), entity, aspect, version=v.version, depth=1)
            read = sorted((*c.slot, c.version) for c in tree.children)
            why = (tree.kind, tree.actor, tree.pid, tree.held_s, tree.left_out, read)
        datum = None if v.null_reason else _plain(v.datum())
        row = (v.version, v.position.stamp_ns, v.until_ns, v.stamp_ns, v.null_reason, v.pinned)
        versions.append((row if v.version else row[:1], datum, why))
    past = [_at(cell.world(world).at(Position(ns, "local")), entity, aspect) for ns in probes_ns]
    return versions, past


def _at(past, entity, aspect):
    try:
        return _plain(past.view(request := View(past, entity, aspect))[request])
    except NullDatumError as null:
        return str(null.reason)
    except ForgottenError:
        return "forgotten"


def _plain(datum):
    return datum.tobytes() if isinstance(datum, np.ndarray) else datum
