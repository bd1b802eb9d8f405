"""A cell with a past, and what can be seen of it: written by one version, read by a later one.

Public names alone, which both versions have.  `make_stored.py` fills the cell and keeps what it saw
as JSON; `test_stored_before.py` opens the same folders with the present version and looks again.
"""

import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from enact_dist import Aspect, Durability, Entity, Lock, Read, Retention, Write


@dataclass(frozen=True)
class Pose:
    """Where a part stands."""

    position_m: NDArray[np.float64]
    frame: str


KEPT = {"durability": Durability.DURABLE, "retention": Retention(versions=8)}
COUNT = Aspect("count", int, **KEPT)
TITLE = Aspect("title", str, **KEPT)
FLAGS = Aspect("flags", dict[str, bool], **KEPT)
POSE = Aspect("pose", Pose, **KEPT)
IMAGE = Aspect("image", NDArray[np.uint8], **KEPT)
GUESS = Aspect("guess", float, Durability.VOLATILE)
ASPECTS = {aspect.name: aspect for aspect in (COUNT, TITLE, FLAGS, POSE, IMAGE, GUESS)}
PARTS = tuple(Entity(f"part/{number}") for number in range(4))
"""On both shards."""
REPLAYED = ("--world", "online=replayed")
"""What `enact replay` is told: the recorded context becomes one of its own."""
CAPTURED_NS = 1_790_000_000_000_000_000


def image(number):
    """Return an image over 64 KiB, so that it lies in a file of its own; easily compressed."""
    return np.full((200, 400), number, np.uint8)


def fill(cell):
    """Write versions, null, volatile and large data, commits over both shards, a fork, a label."""
    online = cell.world("online")
    for number in range(6):
        writes = [Write(online, part, COUNT) for part in PARTS]
        with Lock(*writes) as lock:
            for part, write in enumerate(writes):
                lock[write] = 10 * number + part
    for part, entity in enumerate(PARTS):
        count = Read(online, entity, COUNT)
        to = [Write(online, entity, aspect) for aspect in (TITLE, FLAGS, POSE, IMAGE, GUESS)]
        for number in range(3):
            stamp_ns = CAPTURED_NS + number * 100_000_000
            with Lock(count, *to) as lock:
                title, flags, pose, picture, guess = to
                lock[title] = f"part {lock[count]} µ"
                lock[flags] = {"seen": True, "held": bool(number)}
                lock.put(pose, Pose(np.arange(3.0) + number, "table"), stamp_ns=stamp_ns)
                lock.put(picture, image(10 * part + number), stamp_ns=stamp_ns)
                lock[guess] = 0.5
    cell.pin("first", online.history(PARTS[0], IMAGE)[:1])
    fork = online.fork("trial")
    with Lock(Write(fork, PARTS[1], COUNT)) as lock:
        lock[Write(fork, PARTS[1], COUNT)] = -1
    with Lock(gone := Write(online, PARTS[3], TITLE)) as lock:
        del lock[gone]


def shown(value):
    """Return a value as JSON can have it: of an array its shape, type and digest."""
    if isinstance(value, np.ndarray):
        digest = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()[:16]
        return [list(value.shape), str(value.dtype), digest]
    if isinstance(value, Pose):
        return [value.position_m.tolist(), value.frame]
    return value


def data_of(world, *, volatile=True):
    """Return the newest data of a context."""
    found = {}
    for entity in world.entities():
        for info in world.list_slots(entity):
            aspect = ASPECTS[info.aspect]
            if info.null_reason or (aspect is GUESS and not volatile):
                continue
            datum = world.history(entity, aspect)[-1].datum()
            found[f"{entity.name} {info.aspect}"] = shown(datum)
    return dict(sorted(found.items()))


def facts_of(cell):
    """Return what outlives a restart of the shards: data, versions, labels, a diff, lineage."""
    worlds = {name: cell.world(name) for name in ("online", "trial")}
    found = {"data": {name: data_of(world, volatile=False) for name, world in worlds.items()}}
    found["versions"] = {
        f"{name} {entity.name} {aspect.name}": [
            [
                one.version,
                one.position.stamp_ns,
                one.position.shard,
                one.until_ns,
                one.stamp_ns,
                one.size_bytes,
                one.null_reason,
                list(one.pinned),
                None if one.null_reason else shown(one.datum()),
            ]
            for one in world.history(entity, aspect)
        ]
        for name, world in worlds.items()
        for entity in PARTS
        for aspect in ASPECTS.values()
        if aspect is not GUESS
    }
    found["kept"] = {
        label: [f"{one.slot} v{one.version}" for one in versions]
        for label, versions in cell.pinned().items()
    }
    diff = worlds["online"].diff(worlds["trial"])
    found["diff"] = sorted(f"{row.entity.name} {row.aspect} {row.kind}" for row in diff.rows)
    found["why"] = [
        f"{one.world} {one.entity.name} {one.aspect} v{one.version} {one.kind} {one.actor}"
        for one in cell.why("trial", PARTS[2], IMAGE).walk()
    ]
    found["forked from"] = list(worlds["trial"].forked_from)
    return found


def replayed(world):
    """Return what came of a recording: the newest data, and how many versions there are of each."""
    data = data_of(world)
    counts = {
        name: len(world.history(Entity(name.split()[0]), ASPECTS[name.split()[1]])) for name in data
    }
    return {"data": data, "versions": counts}
