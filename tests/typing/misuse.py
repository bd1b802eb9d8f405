"""What users write by mistake: the type checker must flag every line that ends in `# wrong`."""

from dataclasses import dataclass

from enact_dist import (
    Aspect,
    Difference,
    Entities,
    Entity,
    Lock,
    Read,
    ReadEach,
    View,
    Write,
    WriteEach,
    connect,
)


@dataclass(frozen=True)
class Mesh:
    lowest_z_m: float


def lower(left: Mesh, right: Mesh, /) -> Difference:
    return Difference(0.0)


MESH = Aspect("mesh", Mesh)
COUNT = Aspect("contact_count", int)
NAME = Aspect("name", str)
bench = Entity("work_bench")
cell = connect("cell.toml")
world = cell.world("online")
count, name, mesh = Read(world, bench, COUNT), Write(world, bench, NAME), View(world, bench, MESH)
each, names = ReadEach(world, Entities("view/*"), MESH), WriteEach(world, Entities("*"), NAME)
with Lock(count, name, mesh, each, names) as lock:
    lock[count] = 3  # wrong: write through Read
    lock[mesh] = Mesh(1.0)  # wrong: write through View
    lock[name] = 3  # wrong: datum type
    lock[mesh].bogus  # wrong: attribute
    text: str = lock[count]  # wrong: result type
    lock.get(count) + 1  # wrong: null unhandled
    lock[each] = {}  # wrong: write through ReadEach
    lock[each][bench] = Mesh(1.0)  # wrong: mapping of a ReadEach is read-only
    lock[names][bench] = 3  # wrong: datum type
    lock[names]["bench"] = "x"  # wrong: entities, not names
    del lock[count]  # wrong: delete through Read
    lock.expect(count)  # wrong: a Read is held, not expected
world.init(bench, COUNT, "five kg")  # wrong: datum type
Read(bench, COUNT, world)  # wrong: argument order
ReadEach(world, bench, COUNT)  # wrong: an entity is no pattern
Lock(bench)  # wrong: no request
world.view(bench)  # wrong: no request
Aspect("label", str, compare=lower)  # wrong: comparator of another type
world.diff("training")  # wrong: a name is no world context
world.at("yesterday")  # wrong: no moment
world.at()  # wrong: neither a moment nor a capture stamp
world.history(bench, COUNT)[0].datum().upper()  # wrong: datum type
Lock(world.at(1.0))  # wrong: no request
