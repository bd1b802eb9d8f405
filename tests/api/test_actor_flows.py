"""`actor check` follows stamps and streams from actor to actor, by what their classes declare."""

import importlib

import pytest

from enact_dist.access.together import Together
from enact_dist.actor.actor import Actor
from enact_dist.actor.check import check_actors, check_cell
from enact_dist.actor.uses import ActorDeclaration
from enact_dist.config.read import load_config
from enact_dist.terms import Aspect, Entities, Entity, View, World, Write, WriteEach

ONLINE = World("online")
VIEWS, SYSTEM = Entities("view/*"), Entity("system")
LEFT, RIGHT = Entity("view/left"), Entity("view/right")
MASK, TASK = Aspect("mask", str), Aspect("task", str)


class Writing:
    """Nothing here says a stamp: no word of this file is the name of that argument."""

    def update(self, lock):
        pass


class Joined(Writing, Actor):
    masks = Together([View(ONLINE, LEFT, MASK), View(ONLINE, RIGHT, MASK)], by="stamp")
    joined = Write(ONLINE, SYSTEM, Aspect("joined", str))
    triggers = (masks,)


class Once(Writing, Actor):
    masks = WriteEach(ONLINE, VIEWS, MASK)


class Source(Once):
    every_s = 1.0


class Commanded(Once):
    task = View(ONLINE, SYSTEM, TASK)
    triggers = (task,)


class Commander(Writing, Actor):
    task = Write(ONLINE, SYSTEM, TASK)


class Clock(Commander):
    every_s = 1.0


def found(*classes):
    actors = [ActorDeclaration(each.__name__.lower(), each) for each in classes]
    return [one for one in check_actors(actors) if one.kind == "set without stamps"]


def test_set_whose_writer_gives_no_stamp_is_told_of():
    """Its actor would idle in silence; who writes without a stamp is named, and the remedy."""
    one, other = found(Joined, Once)

    assert (one.level, one.actors) == ("warning", ("joined", "once"))
    assert "joined.masks[0] (View online/view/left mask) waits for data with equal" in one.text
    assert "once runs once, and its module never uses" in one.text
    assert "joined.masks[1]" in other.text


def test_set_behind_a_chain_without_stamps_is_told_of():
    """What is triggered by data without a stamp writes none either."""
    assert "is triggered by data without one" in found(Joined, Commanded, Commander)[0].text


@pytest.mark.parametrize("writers", [(Source,), (Commanded, Clock), (Commanded,), ()])
def test_set_that_gets_its_stamps_is_not_told_of(writers):
    """From a tick, through what it triggers, or from outside, which may give them."""
    assert found(Joined, *writers) == []


def test_writer_whose_module_gives_stamps_is_not_told_of(tmp_path, monkeypatch):
    """It runs once, and says them itself."""
    (tmp_path / "stamping_actors.py").write_text(
        "from test_actor_flows_base import Once\n\nclass Own(Once):\n"
        "    def update(self, lock):\n        lock.put(self.masks, '', stamp_" + "ns=1)\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(
        importlib.sys.modules, "test_actor_flows_base", importlib.sys.modules[__name__]
    )

    assert found(Joined, importlib.import_module("stamping_actors").Own) == []


class Fast(Writing, Actor):
    masks = WriteEach(ONLINE, VIEWS, MASK)
    every_s = 0.1


@pytest.mark.parametrize(
    ("said", "advised"),
    [
        ("every_s = 0.05", True),
        ("", True),
        ("every_s = 0.2", False),
        ('\n[aspects.mask]\ndurability = "volatile"', False),
        ('\n[aspects.mask]\ndurability = "durable"', False),
        ("\n[aspects.mask]\nretention = 4", True),
    ],
)
def test_stream_that_is_durable_without_a_word_is_told_of(tmp_path, monkeypatch, said, advised):
    """Ten times a second or more, each forced to the disk: volatile is advised, by name."""
    monkeypatch.setitem(importlib.sys.modules, "fast_cell", importlib.sys.modules[__name__])
    file = tmp_path / "cell.toml"
    file.write_text(
        'name = "fast"\nworlds = ["online"]\n[shards.one]\nlisten = "tcp/127.0.0.1:7447"\n'
        f'[actors.fast]\nclass = "fast_cell:Fast"\n{said}\n'
    )

    findings = check_cell(load_config(file))

    assert [(one.level, one.kind) for one in findings] == (
        [("advice", "durable stream")] if advised else []
    )
    assert all("[aspects.mask] durability = " in one.text for one in findings)
