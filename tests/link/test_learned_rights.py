"""`enact actor check --learn`: rules for what a running cell with rights refuses."""

from __future__ import annotations

import json
import tomllib
from contextlib import ExitStack, suppress
from types import SimpleNamespace

import pytest
import test_socket_rights
from test_socket_rights import CELL, COUNT, guarded, put

from enact_dist import Entities, Lock, ViewEach, connect
from enact_dist.cli.actor import learn
from enact_dist.cli.actor.learn import LearnedRefusal, rule_lines
from enact_dist.cli.main import main
from enact_dist.config.read import parse_config
from enact_dist.errors import PermissionDeniedError

pytestmark = pytest.mark.carrier("auto")


def refuse(file):
    """Let three clients ask for what they may not do."""
    with ExitStack() as stack:
        camera = stack.enter_context(connect(file, actor="camera"))
        logger = stack.enter_context(connect(file, actor="logger"))
        joe = stack.enter_context(connect(file, actor="joe"))
        for _ in range(2):
            with pytest.raises(PermissionDeniedError):
                put(camera, "plan/1", 1)
        with pytest.raises(PermissionDeniedError):
            put(logger, "view/1", 1)
        each = ViewEach(joe.world("online"), Entities("view/*"), COUNT)
        with pytest.raises(PermissionDeniedError), Lock(each):
            pass


def learned(file, capsys, *words):
    status = main(["actor", "check", "--cell", str(file), "--learn", *words])
    return status, capsys.readouterr()


@pytest.fixture
def as_ada(monkeypatch):
    """Let the command be an operator: without keys, its name is that of its session."""
    plain = learn.open_cell
    monkeypatch.setattr(learn, "open_cell", lambda options: plain(options, actor="ada"))


@pytest.mark.usefixtures("as_ada")
def test_what_was_refused_so_far_becomes_rules(tmp_path, capsys):
    """The printed rules can be pasted: the cell file with them is read."""
    with guarded(tmp_path) as (_, file):
        refuse(file)
        status, said = learned(file, capsys, "0")
        assert status == 0
        rules = tomllib.loads(said.out)["rights"]["allow"]
        assert {"who": "camera", "write": ["online:plan/1/count"]} in rules
        assert {"who": "joe", "read": ["online:view/*/count"]} in rules
        assert "refused 2 times" in said.out
        assert '# and add "joe" to `programs` of [rights]' in said.out

        _, said = learned(file, capsys, "0", "--json")
        found = json.loads(said.out)["refusals"]
        assert [one["count"] for one in found if one["what"] == "online:plan/1/count"] == [2]

        text = file.read_text("utf-8").replace('"logger"]', '"logger", "joe"]', 1)
        (pasted,) = parse_config(text + json.loads(said.out)["rules"], file).shards
        assert pasted.name == "s"


@pytest.mark.usefixtures("as_ada")
def test_only_what_is_refused_in_the_time_counts(tmp_path, capsys, monkeypatch):
    """An earlier refusal is no rule, and a new one is named at once."""
    with guarded(tmp_path) as (_, file):
        passed_s = 0.0

        def rest(pause_s):
            nonlocal passed_s
            refuse(file)
            passed_s += pause_s

        clock = SimpleNamespace(monotonic=lambda: passed_s, sleep=rest)
        monkeypatch.setattr(learn, "time", clock)
        with connect(file, actor="camera") as camera, suppress(PermissionDeniedError):
            put(camera, "early", 1)
        status, said = learned(file, capsys, "2s")
        assert status == 0
        assert "early" not in said.out
        assert "online:plan/1/count" in said.out
        assert said.err.count("camera may not write online:plan/1/count") == 1


@pytest.mark.usefixtures("as_ada")
def test_an_interrupt_prints_what_was_learned(tmp_path, capsys, monkeypatch):
    """Ctrl-C is the usual end, so the status is that of success."""
    monkeypatch.setattr(learn, "LOOK_EACH_S", 0.0)
    with guarded(tmp_path) as (_, file):
        monkeypatch.setattr(learn.Learner, "look", _once_then(learn.Learner.look, file))
        status, said = learned(file, capsys, "10min")
        assert status == 0
        assert "interrupted" in said.err
        assert "online:plan/1/count" in said.out


def _once_then(look, file):
    """Refuse something after the first look, and interrupt after the second one."""
    looks = []

    def looked(self, cell, **options):
        if len(looks) == 2:
            raise KeyboardInterrupt
        looks.append(0)
        if len(looks) == 2:
            refuse(file)
        return look(self, cell, **options)

    return looked


def test_a_command_that_may_not_observe_is_refused(tmp_path, capsys, monkeypatch):
    """At once, not after the time for learning."""
    observing = CELL.replace("[rights]\n", '[rights]\nobserve = ["logger"]\n')
    monkeypatch.setattr(test_socket_rights, "CELL", observing)
    with guarded(tmp_path) as (_, file):
        status, said = learned(file, capsys, "10min")
        assert status == 1
        assert "enact may not observe the cell" in said.err


def test_what_no_rule_can_give_is_a_comment():
    """The rest becomes one rule per name; a right to write covers one to change."""
    found = [
        LearnedRefusal("-", "read", "online:a/b", 1, 0.0),
        LearnedRefusal("cam", "break", "locks", 1, 0.0),
        LearnedRefusal("cam", "change", "online:a/b", 2, 0.0),
        LearnedRefusal("cam", "fork", "online -> w", 1, 0.0),
        LearnedRefusal("cam", "observe", "the cell", 1, 0.0),
        LearnedRefusal("cam", "write", "aspect b", 1, 0.0),
        LearnedRefusal("cam", "write", "online:a/b", 1, 0.0),
    ]
    assert list(rule_lines(found, ["cam"])) == [
        "# no rule helps clients whose names are not proven (docs/security.md)",
        '# add "cam" to `observe` of [rights]',
        "# cam may not write aspect b: name the data that it needs",
        "[[rights.allow]]  # refused 7 times",
        'who = "cam"',
        'write = ["online:a/b"]',
        'fork = ["online -> w"]',
        "break = true",
        "",
    ]


def test_a_cell_without_rights_has_nothing_to_learn(tmp_path, capsys):
    """That is said before anything is asked, as is a time that cannot be read."""
    file = tmp_path / "cell.toml"
    file.write_text('name = "c"\nworlds = ["online"]\n[shards.s]\nlisten = "tcp/127.0.0.1:7447"\n')
    status, said = learned(file, capsys, "10min")
    assert status == 2
    assert "has no [rights]" in said.err
    with pytest.raises(SystemExit):
        learned(file, capsys, "soon")
    assert "such as 10min" in capsys.readouterr().err
