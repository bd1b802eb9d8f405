"""`enact actor ls` tells a frozen actor from one that runs, and two of one name from one."""

import os
import re
import signal
import socket
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest

from enact_dist.actor.report import ActorStatistics
from enact_dist.cli.actor.actor import _losses
from enact_dist.cli.actor.run import _warn_of_same_name
from enact_dist.world.listings import ActorInfo

MODULE = """\
from enact_dist import Actor, Aspect, Entity, World, Write


class Beat(Actor):
    count = Write(World("online"), Entity("beat/ls"), Aspect("count_of_ls", int))
    every_s = 0.05

    def update(self, lock):
        lock[self.count] = lock.get(self.count, 0) + 1
"""
PATIENCE_S = 60.0


@pytest.fixture
def start(tmp_path, spawn, until, cell_file):
    """Start an actor of a name; it and what it has said until it is ready."""
    (tmp_path / "my_actors.py").write_text(MODULE, encoding="utf-8")

    def begin(name):
        actor = spawn("actor", "run", "my_actors:Beat", "--cell", cell_file, "--name", name)
        until(actor, f"ready: actor {name}")
        return actor

    return begin


def listed(enact, cell_file, wanted):
    """Return the rows and the JSON of `actor ls` once they are as wanted."""
    end_s = time.monotonic() + PATIENCE_S
    while True:
        infos = enact("actor", "ls", "--json", "--cell", cell_file).json
        if wanted(infos) or time.monotonic() > end_s:
            return infos


def silent(infos, name):
    """Whether the lease of the only actor of a name is over; others of the cell may be gone."""
    return [info["lease_left_s"] < 0 for info in infos if info["actor"] == name] == [True]


def test_frozen_actor_is_silent(start, enact, cell_file):
    """What it reported last says nothing of how it is; its lease has been over for some time."""
    frozen = start("frozen")
    os.kill(frozen.pid, signal.SIGSTOP)

    infos = listed(enact, cell_file, lambda infos: silent(infos, "frozen"))
    (row,) = [
        line
        for line in enact("actor", "ls", "--cell", cell_file).out.splitlines()
        if line.startswith("frozen")
    ]

    assert silent(infos, "frozen")
    assert "silent" in row
    assert "running" not in row
    assert "over for" in row


def test_ticks_that_an_actor_missed_are_told_of(start, enact, cell_file):
    """One that was frozen and goes on has missed those of that time."""
    frozen = start("late")

    def told(infos, what):
        reports = [one for info in infos for one in info["report"].get("actors", ())]
        return sum(report[what] for report in reports if report["name"] == "late")

    listed(enact, cell_file, lambda infos: told(infos, "updates"))  # its ticks have begun
    os.kill(frozen.pid, signal.SIGSTOP)
    listed(enact, cell_file, lambda infos: silent(infos, "late"))
    os.kill(frozen.pid, signal.SIGCONT)
    known = told(listed(enact, cell_file, lambda infos: told(infos, "missed")), "missed")
    table = enact("actor", "ls", "--cell", cell_file).out

    assert known > 0
    (shown,) = re.findall(r"^late: (\d+) ticks missed$", table, re.MULTILINE)
    assert "never answered" not in table
    assert int(shown) >= known


def test_only_what_was_lost_is_told_of():
    """A zero is no news."""
    assert list(_losses(ActorStatistics("camera", updates=9))) == []
    assert list(_losses(ActorStatistics("camera", missed=6))) == ["6 ticks missed"]
    robot = ActorStatistics("robot", interrupted=1, last_interrupted="version 7 for Write(…)")
    assert list(_losses(robot)) == [
        (
            "1 versions taken, never ended, the newest version 7 for Write(…): how far they came is"
            " unknown; write them again to run them"
        )
    ]
    fusion = ActorStatistics("fusion", unstamped=240, unstamped_from="online:camera/1/mask")
    assert list(_losses(fusion)) == [
        (
            "240 data without a capture stamp, from online:camera/1/mask: this actor waits for data"
            " with equal stamps; set them with lock.put(…, stamp_ns=…)"
        )
    ]
    assert list(
        _losses(ActorStatistics("fusion", incomplete=2, last_incomplete="set", unknown=1))
    ) == [
        "2 incomplete sets, the newest a set",
        "1 commits without an answer, which may stand (see its log)",
    ]


def test_two_actors_of_one_name_are_told_of(start, until, enact, cell_file):
    """Both run, as replicas may be meant; the second one's log and the list say so."""
    first, alone = start("twin"), start("alone")
    second = start("twin")

    said = until(second, "another actor named twin runs")
    infos = listed(
        enact,
        cell_file,
        lambda infos: sum(len(info["namesakes"]) for info in infos) == 2,
    )
    table = enact("actor", "ls", "--cell", cell_file).out.splitlines()

    assert f"process {first.pid} on " in said[-1]
    assert re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} WARNING enact.actor ", said[-1])
    sessions = {info["pid"]: info for info in infos}
    assert sessions[first.pid]["namesakes"] == [sessions[second.pid]["session"]]
    assert sessions[second.pid]["namesakes"] == [sessions[first.pid]["session"]]
    assert sessions[alone.pid]["namesakes"] == []
    assert [line.split()[0] for line in table if "running, one of 2" in line] == ["twin", "twin"]


def test_predecessor_that_is_gone_is_no_namesake(caplog, monkeypatch):
    """Its session lasts a lease longer; of another host nobody can know."""
    gone = ActorInfo("twin", socket.gethostname(), (1 << 22) + 1, "s1", ("left",), 0.5, 0)
    both = (gone, replace(gone, host=f"not-{gone.host}"))
    monkeypatch.setattr("enact_dist.world.listings.sessions_named", lambda *_: both)
    cell = SimpleNamespace(_session=SimpleNamespace(client=None))

    _warn_of_same_name(cell, "twin")

    (said,) = caplog.messages
    assert said.startswith(f"another actor named twin runs, process {gone.pid} on not-")
