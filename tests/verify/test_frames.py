"""Hostile frames: a sample of what `enact verify --frames` runs at night, and that it finds faults."""

from __future__ import annotations

import json

import pytest

from enact_dist.cli.main import main
from enact_dist.core.protocol.messages import Pong
from enact_dist.core.shard import inspection
from enact_dist.core.shard.on_lock import LockHandler
from enact_dist.core.shard.shard import Shard
from enact_dist.verify.frames.hostile import KINDS
from enact_dist.verify.frames.lives import STORE_EVERY, BrokenLife, LifeTally, live
from enact_dist.verify.simulation.series import fresh_seed

LIVES = 48


@pytest.mark.parametrize("part", range(2))
def test_shards_live_through_fresh_hostile_frames(part):
    """Never the same twice; the seed of one that fails stands in what it raises."""
    first = fresh_seed() + part * LIVES

    for seed in range(first, first + LIVES):
        live(seed, LifeTally())


def test_hostile_frames_get_everywhere():
    """Every kind of request is asked, locks are granted and commits made, folders read again."""
    tally = LifeTally()
    for seed in range(2 * STORE_EVERY * 2):
        live(seed, tally)

    assert {kind.__name__ for kind in KINDS} <= tally.asked.keys()
    wanted = {"Granted", "Refused", "Fenced", "Committed", "Prepared", "Valid", "EpochChanged"}
    assert wanted <= tally.answers.keys()
    assert tally.restarts == tally.lives
    assert tally.with_store == 4
    assert tally.illegal


def test_the_seed_of_a_core_repeats_its_life():
    """What one machine has found, another one can look at."""
    once, again = LifeTally(), LifeTally()
    for tally in (once, again):
        live(5, tally)

    assert once == again


def raises(*_):
    """Fail as a forgotten case does."""
    raise KeyError("forgotten")
    yield


FAULTS = {
    "an exception": (Shard, "_on_list_locks", raises, "KeyError.*ListLocks"),
    "an answer that no frame holds": (
        inspection,
        "pong",
        lambda *_: Pong("s0", 1 << 70, True, "", 0),
        "an answer cannot be sent.*Ping",
    ),
    "no answer": (LockHandler, "on_release", lambda *_: iter(()), "stayed unanswered.*Release"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_is_found_and_named(fault, monkeypatch, capsys):
    """The command says which frame it was, ends with 1, and repeats the life by its seed."""
    owner, name, wrong, said = FAULTS[fault]
    monkeypatch.setattr(owner, name, wrong)
    with pytest.raises(BrokenLife, match=f"(?s){said}"):
        for seed in range(40):
            live(seed, LifeTally())

    assert main(["verify", "--frames", "--seeds", "40", "--first", "0", "--json"]) == 1
    (failure,) = json.loads(capsys.readouterr().out)["failures"]
    assert main(["verify", "--frames", "--seed", str(failure["seed"])]) == 1
    assert f"seed {failure['seed']} breaks a rule" in capsys.readouterr().out


def test_command_tells_what_it_has_done(capsys):
    """By number of lives or by time, for people and for programs."""
    assert main(["verify", "--frames", "--seeds", "3"]) == 0
    assert "every answer could be sent" in capsys.readouterr().out
    assert main(["verify", "--frames", "--seconds", "0.2", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["frames"] > 0
    assert found["failures"] == []
