"""What users write: no line here may be an error of the type checker."""

from dataclasses import dataclass
from datetime import datetime
from typing import assert_type

from enact_dist import (
    Actor,
    Aspect,
    Difference,
    Entities,
    Entity,
    Lock,
    Read,
    ReadEach,
    Tolerance,
    View,
    ViewEach,
    World,
    Write,
    WriteEach,
    connect,
)
from enact_dist.types import CauseTree, EachData, PastContext, Version


@dataclass(frozen=True)
class Mesh:
    lowest_z_m: float


def lower(left: Mesh, right: Mesh, /) -> Difference:
    apart_m = abs(left.lowest_z_m - right.lowest_z_m)
    return Difference(apart_m, tolerance=0.001, crossed=apart_m > 0.001, unit="m")


MESH = Aspect("mesh", Mesh, compare=lower)
COUNT = Aspect("contact_count", int, compare=Tolerance(absolute=1.0))
FLAGS = Aspect("flags", dict[str, bool])
piece, bench = Entity("work_piece"), Entity("work_bench")


def count_contacts() -> None:
    with connect("cell.toml") as cell:
        online = cell.world("online")
        online.init(piece, MESH, Mesh(-0.1))
        mesh, count = Read(online, piece, MESH), Write(online, bench, COUNT)
        each, all_counts = (
            ReadEach(online, Entities("view/*"), MESH),
            WriteEach(online, Entities("*"), COUNT),
        )
        with Lock(mesh, count, each, all_counts) as lock:
            assert_type(lock[mesh], Mesh)
            assert_type(lock.get(mesh), Mesh | None)
            assert_type(lock.get(count, 0), int)
            assert_type(lock[each], EachData[Mesh])
            if lock[mesh].lowest_z_m < 0.0:
                lock[count] = lock.get(count, 0) + 1
            lock[count] += 1
            lock[all_counts][piece] = 3
            assert_type(lock[all_counts].new(piece, like=3), int)
            del lock[count]
        view = View(online, bench, COUNT)
        snapshot = online.view(view)
        assert_type(snapshot[view], int)
        assert_type(snapshot.get(view, 0), int)
        for row in online.diff(cell.world("training"), "work_*", MESH, "contact_count"):
            assert_type(row.difference, Difference | None)
        assert_type(cell.why(online, bench, COUNT, 3, depth=2).children, tuple[CauseTree, ...])
        assert_type([one.version for one in cell.impact("online", "b", "c").walk()], list[int])
        with online.watch_diff(online.at(-1.0), bench, COUNT) as watch:
            assert_type([row.entity for row in watch], list[Entity])


def travel(when: datetime) -> None:
    with connect("cell.toml") as cell:
        online = cell.world("online")
        versions = online.history(bench, COUNT, since=when, count=5)
        assert_type(versions, tuple[Version[int], ...])
        assert_type(versions[0].datum(), int)
        past = online.at(versions[0].position)
        mesh, each = View(past, piece, MESH), ViewEach(past, Entities("view/*"), MESH)
        snapshot = past.view(mesh, each)
        assert_type(snapshot[mesh], Mesh)
        assert_type(snapshot[each], EachData[Mesh])
        assert_type(online.at(when), PastContext)
        assert_type(online.at(1763719200.5), PastContext)
        assert_type(online.at(stamp_ns=17, nearest=True), PastContext)
        assert_type(online.fork("what_if", at=when).forked_from, tuple[str, int] | None)
        cell.pin("label", [*versions, *online.history(piece, MESH)])
        assert_type(cell.drop_world("what_if"), int)


class Inspect(Actor):
    """Raise a flag for a mesh below the table."""

    online = World("online")
    mesh = View(online, Entities("product/*"), MESH)
    flags = Write(online, Entity("system"), FLAGS)
    triggers = [mesh]

    def update(self, lock: Lock) -> None:
        below = lock[self.mesh].lowest_z_m < 0.0
        lock[self.flags] = {**lock.get(self.flags, {}), lock.entity.name: below}
