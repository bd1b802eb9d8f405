"""`[rights]` of a cell.toml: what it gives, and every way in which it can be wrong."""

from __future__ import annotations

from pathlib import Path

import pytest

from enact_dist.cli.main import main
from enact_dist.cli.up import _refuse_misfits
from enact_dist.config.read import load_config, parse_config
from enact_dist.errors import ConfigError

CELL = """\
name = "c"
worlds = ["online", "training"]
carrier = "socket"
[shards.s]
listen = "tcp/127.0.0.1:7447"
[actors.camera]
class = "a.b:C"
[actors.planner]
class = "a.b:C"
[security]
operators = ["ada", "uid:1000"]
"""
RIGHTS = """\
[rights]
default = "none"
uids = { 1001 = "camera", 10001 = "@vision" }
programs = ["logger"]
[rights.groups]
vision = ["camera*", "planner"]
[[rights.allow]]
who = ["@vision", "logger"]
read = ["online:**", "training:view/*/cloud"]
[[rights.allow]]
who = "planner"
write = ["what_if*:**"]
init = "online:plan/*/joints"
fork = ["online -> what_if*"]
drop = ["what_if*"]
keep = "day/*"
break = true
"""


def parsed(text, folder=Path("/cells")):
    return parse_config(text, folder / "cell.toml", environment={}, shown="cell.toml")


def refused(text):
    with pytest.raises(ConfigError) as caught:
        parsed(text)
    return str(caught.value)


def test_without_the_table_there_are_no_rights():
    """A shard then asks no guard at all."""
    assert parsed(CELL).shard_settings("s").rights is None


def test_rules_groups_users_and_operators_are_read():
    """Each right of the example is given to those of its rule and to no one else."""
    rights = parsed(CELL + RIGHTS).shard_settings("s").rights
    assert rights.may("camera2", "read", "online/any/a/b")
    assert rights.may("@vision", "read", "training/cloud/view/1")
    assert not rights.may("camera", "read", "training/depth/view/1")
    assert rights.may("planner", "delete", "what_if1/x/a")
    assert rights.may("planner", "init", "online/joints/plan/1")
    assert not rights.may("planner", "change", "online/joints/plan/1")
    assert rights.may("planner", "fork", "online/what_if1")
    assert not rights.may("planner", "fork", "training/what_if1")
    assert rights.may("planner", "break", "**")
    assert not rights.may("planner", "resolve", "**")
    assert rights.may("anybody", "observe", "**")
    assert rights.may("uid:1000", "resolve", "**")
    assert rights.subject_of(1001, "x", trusted=False) == "camera"
    assert rights.hint == "[rights] of cell.toml"


@pytest.mark.parametrize(
    ("old", "new", "wrong"),
    [
        (
            '"@vision", "logger"',
            '"@vison"',
            "line 19: unknown group '@vison'; did you mean 'vision'?",
        ),
        (
            '"@vision", "logger"',
            '"camra"',
            "line 19: unknown actor 'camra'; did you mean 'camera'?",
        ),
        ('["camera*", "planner"]', '["plannr"]', "line 17: unknown actor 'plannr'; did you mean"),
        (
            '["camera*", "planner"]',
            '["@vision"]',
            "contains '@vision'; a group contains names only",
        ),
        (
            '"online:**"',
            '"onlin:**"',
            "line 20: unknown world context 'onlin'; did you mean 'online'?",
        ),
        ('"online -> what_if*"', '"onlin -> a"', "unknown world context 'onlin'"),
        ('"online:**"', '"online"', "line 20: 'online' names no data; write WORLD:ENTITIES/ASPECT"),
        ('"online:**"', '"online:a b/c"', "is no pattern of entities"),
        ('"online:**"', '"online:**", "online:**"', "'online:**' stands twice in 'read'"),
        ("break = true", 'deny = ["online:**"]', "line 28: unknown key 'deny' in [rights.allow]"),
        ('"none"', '"all"', "unknown default 'all'"),
        ("1001 =", "joe =", "'joe' = 'camera' is no user with a name"),
        ('1001 = "camera"', '1001 = "shard.s"', "is no user with a name"),
        ('10001 = "@vision"', '10001 = "@visio"', "unknown group '@visio'"),
    ],
)
def test_what_is_wrong_is_refused_by_line_with_a_suggestion(old, new, wrong):
    """Names are compared with those of the cell, patterns and keys with what exists."""
    text = CELL + RIGHTS
    assert old in text
    assert wrong in refused(text.replace(old, new, 1))


def test_a_rule_that_stands_twice_is_refused():
    """By the numbers of both."""
    rule = '[[rights.allow]]\nwho = "planner"\nread = "online:**"\n'
    assert "rule 2 of [[rights.allow]] repeats rule 1" in refused(CELL + rule + rule)


@pytest.mark.parametrize(
    ("old", "new", "wrong"),
    [
        ("tcp/127.0.0.1:7447", "tcp/cell-pc:7447", "[rights] with endpoint tcp/cell-pc:7447"),
        ('carrier = "socket"', 'carrier = "auto"', "[rights] with carrier = 'auto'"),
    ],
)
def test_rights_where_any_program_can_claim_any_name_are_refused(old, new, wrong):
    """Without rights the same endpoint and carrier are fine; the environment counts as well."""
    assert wrong in refused((CELL + RIGHTS).replace(old, new))
    parsed(CELL.replace(old, new))
    with pytest.raises(ConfigError, match="carrier = 'zenoh'"):
        parse_config(
            CELL + RIGHTS, Path("/cells/cell.toml"), environment={"ENACT_CARRIER": "zenoh"}
        )


@pytest.mark.parametrize(
    "name", ["*", "@vision", "-", "ada~1", "ada:x", "ada@h", "a/b", "a%20b", "ümlaut", "a" * 201]
)
def test_program_has_a_name_that_is_nobody_elses(name):
    """`ada~1` is what the next certificate of ada says, `-` a client that proves no name."""
    wrong = refused(CELL + RIGHTS.replace('programs = ["logger"]', f'programs = ["{name}"]'))
    assert "line 15: " in wrong
    assert "program" in wrong


@pytest.mark.parametrize(
    ("old", "line"), [("actors.planner", 8), ('"ada"', 11), ('programs = ["logger', 14)]
)
@pytest.mark.parametrize(
    ("name", "wrong"),
    [("shard.s", "belong to the authority and to shards"), ("a" * 61, "60 characters of a name")],
)
def test_names_that_two_could_have_are_refused(old, line, name, wrong):
    """An identity has room for 64 characters, so of two long names one could be the other."""
    text = CELL + '[rights]\ndefault = "none"\nprograms = ["logger"]\n'
    new = {8: f'actors."{name}"', 11: f'"{name}"', 14: f'programs = ["{name}'}[line]
    found = refused(text.replace(old, new, 1))
    assert f"line {line}: '{name}' cannot have rights: " in found
    assert wrong in found


def test_the_tables_are_tables():
    """A number in place of one is named by its key."""
    assert "'rights' is a table" in refused("rights = 3\n" + CELL)
    assert "'security' is a table" in refused("security = 3\n" + CELL.partition("[security]")[0])


# ---------------------------------------------------------------- declared rights


def test_declared_rights_are_written_read_and_found_stale(tmp_path, capsys, monkeypatch):
    """`enact actor check --rights` writes what `enact up` and the shards read."""
    monkeypatch.delenv("ENACT_CARRIER", raising=False)
    (tmp_path / "cams.py").write_text(
        "from enact_dist import *\n"
        "class Camera(Actor):\n"
        '    image = Write(World("now"), Entity("view/1"), Aspect("image", int))\n'
        '    plan = View(World("now"), Entities("plan/**"), Aspect("joints", int))\n'
        "    every_s = 1.0\n"
        "    def update(self, lock): pass\n",
        "utf-8",
    )
    cell = (
        CELL.partition("[actors.")[0]
        + '[actors.camera]\nclass = "cams:Camera"\nworlds = { now = "online" }\n[rights]\n'
    )
    (tmp_path / "cell.toml").write_text(cell, "utf-8")
    file = tmp_path / "rights.toml"
    check = ["actor", "check", "--cell", str(tmp_path / "cell.toml")]

    with pytest.raises(ConfigError, match=r"rights\.toml: .*write it with enact actor check"):
        parsed(cell, tmp_path).shard_settings("s")
    assert main(check) == 1
    assert "rights stale" in capsys.readouterr().out
    assert main([*check, "--rights"]) == 0

    rights = parsed(cell, tmp_path).shard_settings("s").rights
    assert rights.may("camera", "change", "online/image/view/1")
    assert rights.may("camera", "read", "online/image/view/1")
    assert rights.may("camera", "read", "online/joints/plan/**")
    assert rights.may("camera", "delete", "online/actor_words/actor")
    assert not rights.may("camera", "init", "online/joints/plan/1")
    assert not rights.may("planner", "read", "online/image/view/1")

    file.write_text(file.read_text("utf-8").replace("view/1", "view/2"), "utf-8")
    assert main(check) == 1
    assert "differs from what the actors declare" in capsys.readouterr().out
    with pytest.raises(ConfigError, match="differs from what the actors declare"):
        _refuse_misfits(load_config(tmp_path / "cell.toml", environment={}))
    file.write_text("allow = 3", "utf-8")
    with pytest.raises(ConfigError, match="cannot be used"):
        parsed(cell, tmp_path).shard_settings("s")


def test_missing_and_unused_rights_are_found(tmp_path, capsys, monkeypatch):
    """The rule to add can be pasted; what cannot be judged is not reported."""
    monkeypatch.delenv("ENACT_CARRIER", raising=False)
    (tmp_path / "arms.py").write_text(
        "from enact_dist import *\n"
        "class Arm(Actor):\n"
        '    joints = Write(World("now"), Entity("arm"), Aspect("joints", int))\n'
        '    plan = View(World("now"), Entity("plan"), Aspect("path", int))\n'
        "    every_s = 1.0\n"
        "    def update(self, lock): pass\n",
        "utf-8",
    )
    file = tmp_path / "cell.toml"
    head = (
        CELL.partition("[actors.")[0]
        + '[actors.arm]\nclass = "arms:Arm"\nworlds = { now = "online" }\n'
        + '[rights]\ndefault = "none"\nprograms = ["logger"]\n[rights.groups]\narms = ["arm"]\n'
        + '[[rights.allow]]\nwho = ["@arms"]\nread = "online:arm/joints"\n'
    )
    other = '[[rights.allow]]\nwho = "arm"\nchange = ["online:pallet/joints"]\n'
    unjudged = '[[rights.allow]]\nwho = ["arm", "logger"]\nread = "online:logs/**"\n'
    file.write_text(head + other + unjudged, "utf-8")
    check = ["actor", "check", "--cell", str(file)]

    assert main(check) == 1
    told = capsys.readouterr().out
    said = "error: right missing: actor arm declares data that no rule gives to it"
    closest = "rule 2 gives change of online:pallet/joints to arm"
    assert f"{said} ({closest}); add to cell.toml:" in told
    assert "gives change of online:pallet/joints to arm, and none of them declares it" in told
    assert told.count("right unused") == 1
    pasted = told[told.index("[[rights.allow]]\nwho = ") :].partition("warning:")[0]
    file.write_text(head + unjudged + pasted, "utf-8")
    assert main(check) == 0
    assert "right" not in capsys.readouterr().out.partition("unwritten")[0]
