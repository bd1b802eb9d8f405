"""The picture of a cell's actors: all that is declared is in it, and nothing stands on another."""

import re
from itertools import combinations
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from enact_dist.actor.actor import Actor
from enact_dist.actor.check import declarations_of
from enact_dist.actor.graph import graph_of, laid_out, svg_of
from enact_dist.actor.uses import ActorDeclaration, uses_of
from enact_dist.cli.main import main
from enact_dist.config.read import load_config
from enact_dist.terms import Aspect, Entities, Entity, Read, View, ViewEach, World, Write

PALLETIZING = Path(__file__).parents[2] / "actors" / "palletizing" / "cell.toml"
SVG = "{http://www.w3.org/2000/svg}"
online = World("online")
CAMERAS, SYSTEM = Entities("camera/*"), Entity("system")
IMAGE, MASK, ALARM = Aspect("image", str), Aspect("mask", str), Aspect("alarm", str)


def idle(_self, _lock):
    """Do nothing: these classes are only looked at."""


class Camera(Actor):
    image = Write(online, CAMERAS, IMAGE)
    every_s = 0.1
    update = idle


class Subtraction(Actor):
    image = View(online, CAMERAS, IMAGE)
    mask = Write(online, CAMERAS, MASK)
    triggers = (image,)
    update = idle


class Watch(Actor):
    masks = ViewEach(online, CAMERAS, MASK)
    before = Read(online, Entity("limit"), ALARM)
    alarm = Write(online, SYSTEM, ALARM)
    triggers = (masks,)
    update = idle


def rig(cameras=3):
    """Return the declarations of some cameras, each with its subtraction, and of what watches."""
    each = [
        ActorDeclaration(f"{name}-{number}", kind, None, Entity(f"camera/{number}"))
        for number in range(cameras)
        for name, kind in (("camera", Camera), ("subtraction", Subtraction))
    ]
    return [*each, ActorDeclaration("watch", Watch)]


def drawn(actors, **options):
    return ET.fromstring(svg_of(graph_of(actors, **options), "a cell"))


def boxes(picture, kind):
    """Return left, top, right, bottom of the boxes of a kind by their names."""
    found = {}
    for rect in picture.iter(f"{SVG}rect"):
        if rect.get("class") == kind:
            x, y, width, height = (float(rect.get(key)) for key in ("x", "y", "width", "height"))
            found[rect.get("data-name")] = (x, y, x + width, y + height)
    return found


def lines(picture):
    return [path for path in picture.iter(f"{SVG}path") if path.get("data-actor")]


def apart(one, other):
    return one[2] <= other[0] or other[2] <= one[0] or one[3] <= other[1] or other[3] <= one[1]


def inside(inner, outer):
    return (
        outer[0] < inner[0] and outer[1] < inner[1] and inner[2] < outer[2] and inner[3] < outer[3]
    )


CELLS = {
    "palletizing": lambda: declarations_of(load_config(PALLETIZING))[0],
    "rig": rig,
    "one": lambda: [ActorDeclaration("watch", Watch)],
    "many": lambda: [ActorDeclaration(f"watch{number}", Watch) for number in range(40)],
}


@pytest.mark.parametrize("cell", CELLS)
def test_each_declared_read_and_write_is_a_line(cell):
    """From its actor to its aspect, with what kind it is; actors of a group share one."""
    actors = CELLS[cell]()
    picture = drawn(actors)
    found = {(one.get("data-actor"), one.get("data-request")): one for one in lines(picture)}
    uses = list(uses_of(actors))
    assert uses
    for use in uses:
        mine = [one for (names, name), one in found.items()
                if use.actor.name in names.split(", ") and name == use.name]  # fmt: skip
        (line,) = mine
        assert line.get("data-kind") == ("writes" if use.request.access.writes else "reads")
        assert line.get("data-datum").startswith(f"{use.world}:")
        assert line.get("data-datum").endswith(f"/{use.request.aspect.name}")
        assert line.get("data-datum") in boxes(picture, "aspect")
    assert len(found) == len(lines(picture))


@pytest.mark.parametrize("cell", CELLS)
def test_no_box_overlaps_another_and_no_line_crosses_one(cell):
    """Aspects lie in their entity, entities in their context; lines keep to the gutters."""
    picture = drawn(CELLS[cell]())
    worlds, entities = boxes(picture, "world"), boxes(picture, "entity")
    aspects, actors = boxes(picture, "aspect"), boxes(picture, "actor")
    for kind in ([*worlds.values(), *actors.values()], entities.values(), aspects.values()):
        assert all(apart(one, other) for one, other in combinations(kind, 2))
    for name, box in entities.items():
        assert inside(box, worlds[name.partition(":")[0]])
    for name, box in aspects.items():
        assert inside(box, entities[name.rpartition("/")[0]])
    left, right = (
        [box for box in actors.values() if (box[0] < min(worlds.values())[0]) == on_left]
        for on_left in (True, False)
    )
    for line in lines(picture):
        xs = [float(x) for x in re.findall(r"[MC ](-?[\d.]+),", line.get("d"))]
        assert len(xs) == 4
        gutter = (
            (max((box[2] for box in left), default=0.0), min(box[0] for box in aspects.values())),
            (max(box[2] for box in aspects.values()), min((box[0] for box in right), default=1e9)),
        )
        assert any(low - 0.1 <= min(xs) and max(xs) <= high + 0.1 for low, high in gutter)
    size = [float(value) for value in picture.get("viewBox").split()]
    assert all(
        box[2] <= size[2] and box[3] <= size[3] for box in (*worlds.values(), *actors.values())
    )


def test_lines_of_one_aspect_end_apart():
    """Forty actors that read and write the same data: no two lines end at one point."""
    layout = laid_out(graph_of(CELLS["many"]()))
    for ends in zip(*layout.ends, strict=True):
        assert len(set(ends)) == len(ends)


def test_actors_that_differ_in_their_entity_only_are_one_box():
    """With their number; with the rates of a running cell where these are known."""
    graph = graph_of(rig(), rates_hz={"camera-0": 10.04, "camera-1": 9.96, "camera-2": 5.0})
    camera, subtraction, watch = graph.groups
    assert camera.lines == ("Camera (3)", "camera-0, camera-1, camera-2", "5.0 to 10.0/s")
    assert (subtraction.lines[0], watch.lines) == ("Subtraction (3)", ("Watch",))
    assert [group.layer for group in graph.groups] == [0, 1, 2]
    assert ("online", "camera/*", "mask") in graph.data
    (alone, *_) = graph_of(rig(cameras=1)).lines
    assert alone.datum == ("online", "camera/0", "image")


def test_views_locks_and_triggers_are_told_apart():
    """A view is dashed, a trigger bold, a read under a lock is neither."""
    by_name = {one.get("data-request"): one for one in lines(drawn([ActorDeclaration("w", Watch)]))}
    assert by_name["masks"].get("stroke-dasharray")
    assert "stroke-width" in by_name["masks"].get("style")
    assert by_name["before"].get("stroke-dasharray") is None
    assert by_name["before"].get("style") is None


def test_check_draws_a_cell_that_does_not_run(tmp_path, capsys):
    """Beside its findings; another kind of file is refused."""
    file = tmp_path / "cell.svg"
    status = main(["actor", "check", "--cell", str(PALLETIZING), "--graph", str(file), "--json"])
    out, err = capsys.readouterr()
    assert (status, out.strip()[:1]) == (0, "[")
    assert "8 actors" in err
    assert ET.parse(file).getroot().tag == f"{SVG}svg"
    wrong = main(["actor", "check", "--cell", str(PALLETIZING), "--graph", str(tmp_path / "a.png")])
    assert wrong == 2
    assert "name it FILE.svg" in capsys.readouterr().err
