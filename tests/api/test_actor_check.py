"""What is found wrong with the actors of a cell before any of them runs."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING

import pytest

from enact_dist.actor.actor import Actor
from enact_dist.actor.check import ActorFinding, check_actors, check_cell
from enact_dist.actor.uses import ActorDeclaration
from enact_dist.config.read import load_config
from enact_dist.terms import Aspect, Entities, Entity, View, ViewEach, World, Write, WriteEach

if TYPE_CHECKING:
    from pathlib import Path

training, online = World("training"), World("online")
VIEWS, PRODUCTS = Entities("view/*"), Entities("product/*")
CLOUD, SURFACE, FLAGS = Aspect("cloud", str), Aspect("surface", str), Aspect("flags", dict)
SYSTEM = Entity("system")


def idle(_self: Actor, _lock: object) -> None:
    """Do nothing: these classes are only looked at."""


class Camera(Actor):
    """Writes clouds."""

    cloud = WriteEach(online, VIEWS, CLOUD)
    every_s = 0.1
    update = idle


class Reconstruction(Actor):
    """Clouds to surfaces."""

    cloud = View(online, VIEWS, CLOUD)
    surface = Write(online, VIEWS, SURFACE)
    triggers = (cloud,)
    update = idle


class Alarm(Actor):
    """Looks at all surfaces and writes flags."""

    surfaces = ViewEach(online, VIEWS, SURFACE)
    flags = Write(online, SYSTEM, FLAGS)
    triggers = (surfaces,)
    update = idle


class PoliteAlarm(Alarm):
    """An alarm that keeps what others flagged."""

    shared = (Alarm.flags,)


BOUND = {"online": "online"}


def check(*classes: type[Actor], **options: object) -> tuple[ActorFinding, ...]:
    """Check a cell of these actors, each named after its class and bound to `online`."""
    actors = [
        ActorDeclaration(f"{actor_class.__name__.lower()}{index}", actor_class, BOUND)
        for index, actor_class in enumerate(classes)
    ]
    return check_actors(actors, **options)


def only(findings: tuple[ActorFinding, ...]) -> ActorFinding:
    """Return the one finding."""
    assert len(findings) == 1, findings
    return findings[0]


def test_check_finds_nothing_when_a_cell_is_sound():
    """Every trigger has a writer and every slot one writer."""
    assert check(Camera, Reconstruction, Alarm, worlds=["online"]) == ()


def test_check_finds_two_writers_when_patterns_of_one_context_overlap():
    """Two actors that can write one slot are an error that names both requests."""
    found = only(check(Camera, Reconstruction, Alarm, Alarm))

    assert (found.level, found.kind) == ("error", "two writers")
    assert found.actors == ("alarm2", "alarm3")
    assert "alarm2.flags (Write online/system flags)" in found.text


def test_check_tells_all_writers_of_one_slot_at_once():
    """Actors that were copied are one mistake: six of them are no 15 errors."""
    found = only(check(Camera, Reconstruction, *[Alarm] * 6))

    assert found.actors == tuple(f"alarm{number}" for number in range(2, 8))
    assert "alarm5.flags (Write online/system flags) and 2 more can write one slot" in found.text


def test_check_accepts_two_writers_when_both_say_shared():
    """Writers that keep each other's datum are no finding; one alone that says so is one."""
    assert check(Camera, Reconstruction, PoliteAlarm, PoliteAlarm) == ()
    assert only(check(Camera, Reconstruction, Alarm, PoliteAlarm)).kind == "two writers"


def test_check_accepts_two_writers_when_bound_to_different_contexts():
    """The same class may run once per world context."""
    actors = [
        ActorDeclaration("one", Camera, {"online": "online"}),
        ActorDeclaration("two", Camera, {"online": "training"}),
    ]

    assert check_actors(actors) == ()


def test_check_warns_when_nobody_writes_a_trigger_or_a_read():
    """A trigger without a writer never runs unless something outside writes it."""

    class Reader(Actor):
        cloud = View(online, VIEWS, CLOUD)
        model = View(online, SYSTEM, SURFACE)
        triggers = (cloud,)
        update = idle

    found = check(Reader)

    assert [(finding.level, finding.kind) for finding in found] == [
        ("warning", "unwritten trigger"),
        ("warning", "unwritten read"),
    ]
    assert check(Reader, initial=["cloud", "surface"]) == ()


@pytest.mark.parametrize(
    ("worlds", "kind"),
    [
        ({}, "unbound role"),
        ({"online": "onlin"}, "unknown world"),
        ({"online": "online", "training": "online"}, "unknown role"),
    ],
)
def test_check_finds_what_is_wrong_when_roles_are_bound_wrongly(worlds: dict[str, str], kind: str):
    """Each wrong binding is an error of its own kind."""
    actors = [ActorDeclaration("camera", Camera, worlds)]

    found = only(check_actors(actors, worlds=["online"]))

    assert (found.level, found.kind, found.actors) == ("error", kind, ("camera",))


def test_check_finds_an_own_trigger_when_two_roles_are_one_context():
    """An actor that copies between roles must not be bound to copy a context onto itself."""

    class Copy(Actor):
        source = View(online, VIEWS, CLOUD)
        target = Write(training, VIEWS, CLOUD)
        triggers = (source,)
        update = idle

    actors = [ActorDeclaration("copy", Copy, {"online": "one", "training": "one"})]

    assert only(check_actors(actors)).kind == "own trigger"


def test_check_finds_two_types_when_one_aspect_name_has_two():
    """An aspect's datum type is one for the whole cell."""

    class Counting(Actor):
        cloud = View(online, VIEWS, Aspect("cloud", int))
        triggers = (cloud,)
        update = idle

    found = only(check(Camera, Counting))

    assert (found.level, found.kind) == ("error", "two types")
    assert "str" in found.text
    assert "int" in found.text


def test_check_names_the_actor_and_aspect_of_a_type_that_no_datum_can_have():
    """All other types are compared nevertheless; "set: set cannot be a datum" named none of it."""

    class Tagging(Actor):
        tags = Write(online, Entity("part"), Aspect("tags", set))
        cloud = View(online, VIEWS, Aspect("cloud", int))
        triggers = (cloud,)
        update = idle

    impossible, other = sorted(check(Camera, Tagging), key=lambda one: one.kind)

    assert (impossible.level, impossible.kind, other.kind) == (
        "error", "impossible type", "two types"
    )  # fmt: skip
    assert impossible.text.startswith("tagging1.tags (Write online/part tags): set: set cannot be")


@dataclass(frozen=True)
class Spot:
    x_mm: float


LongerSpot = dataclass(frozen=True)(
    type("Spot", (), {"__annotations__": {"x_mm": float, "name": str}, "name": "spot"})
)


@pytest.mark.parametrize(
    ("written", "read", "found"),
    [
        ([Spot], [LongerSpot], 0),
        ([LongerSpot], [Spot], 0),
        ([Spot, LongerSpot], [], 1),
        ([LongerSpot, Spot], [], 1),
        ([LongerSpot], [Spot, LongerSpot, Spot], 0),
    ],
)
def test_check_lets_a_reader_have_an_older_or_newer_type(written, read, found):
    """A type that gained fields with defaults is read by both; all that write have the newest."""
    actors = []
    for number, kind in enumerate([*written, *read]):
        access = Write if number < len(written) else View
        spot = access(online, Entity(f"spot/{number}"), Aspect("spot", kind))
        body = {"spot": spot, "triggers": (spot,) if access is View else (), "update": idle}
        if access is Write:
            body = {"every_s": 1.0, **body}
            del body["triggers"]
        actors.append(type(f"Actor{number}", (Actor,), body))

    two_types = [one for one in check(*actors) if one.kind == "two types"]

    assert len(two_types) == found
    assert all("name:str=" in one.text for one in two_types)


CELL = """
name = "sample"
worlds = ["online"]

[shards.one]
listen = "tcp/127.0.0.1:7447"

[aspects.clod]
durability = "volatile"

[actors.camera]
class = "sample_cell:Camera"
worlds = { online = "online" }

[actors.maker]
class = "sample_cell:Reconstruction"
"""


@pytest.fixture
def cell_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cell.toml whose actors are those of this module."""
    monkeypatch.setitem(sys.modules, "sample_cell", sys.modules[__name__])
    path = tmp_path / "cell.toml"
    path.write_text(CELL)
    return path


def test_check_cell_warns_when_an_aspect_of_the_file_is_used_by_nobody(cell_file: Path):
    """A misspelt aspect would silently keep its default durability."""
    found, advice = check_cell(load_config(cell_file))

    assert (advice.level, advice.kind) == ("advice", "durable stream")
    assert (found.level, found.kind) == ("warning", "unused aspect")
    assert "did you mean 'cloud'" in found.text


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ('class = "sample_cell:Camra"', "did you mean 'Camera'"),
        ('class = "sample_cell:Camera"\noptions = { fps = 3 }', "has no option 'fps'"),
        ('class = "sample_cell:Alarm"\nevery_s = 0.5', "every_s = 0.5 for actor Alarm"),
    ],
)
def test_check_cell_finds_actors_that_cannot_be_made(cell_file: Path, lines: str, message: str):
    """Class, options and period are checked without making the actor."""
    worlds = 'worlds = { online = "online" }'
    cell_file.write_text(f"{CELL}\n[actors.wrong]\n{lines}\n{worlds}\n")

    found = check_cell(load_config(cell_file))[0]

    assert (found.level, found.kind, found.actors) == ("error", "no such actor", ("wrong",))
    assert message in found.text


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("\nimages = [online]\n", "NameError at {file}:2: name 'online' is not defined"),
        (
            "import dataclasses\n@dataclasses.dataclass\nclass Plan:\n    v: int = 1\n    avoid: str\n",
            "TypeError at {file}:2: non-default argument 'avoid' follows default argument",
        ),
        ("class Plan\n", "SyntaxError at {file}:1: expected ':'"),
        (
            "from enact_dist import Actor\nclass Idle(Actor):\n    triggers = (3,)\n",
            "MisuseError at {file}:2: Idle",
        ),
    ],
)
def test_check_cell_says_where_a_module_raises(
    cell_file: Path, monkeypatch: pytest.MonkeyPatch, code: str, message: str
):
    """Which actor, which module, what and in which line; the actor itself may well be there."""
    (cell_file.parent / "broken_cell.py").write_text(code)
    monkeypatch.syspath_prepend(cell_file.parent)
    monkeypatch.chdir(cell_file.parent)
    cell_file.write_text(f'{CELL}\n[actors.planner]\nclass = "broken_cell:Planner"\n')

    found = check_cell(load_config(cell_file))[0]

    assert (found.level, found.kind) == ("error", "broken module")
    assert found.actors == ("planner",)
    wanted = "actor planner (broken_cell:Planner): " + message.format(file="broken_cell.py")
    assert found.text.startswith(wanted)
