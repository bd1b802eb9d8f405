"""A version whose taker is gone, is another process, or was taken for gone: nothing is done twice."""

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from once_robot import (
    JOINTS,
    OUTCOME,
    PATIENCE_S,
    PLAN,
    ROBOT,
    Robot,
    read,
    until,
    write,
)

from enact_dist import ActorThread, Outcome, testing
from enact_dist.actor.running.runner import run_actor
from enact_dist.errors import LeaseLostError, LockTimeoutError


def taken_by(online, session, version=1):
    """Leave a version as taken, as an actor does that is killed before its outcome."""
    (found,) = (slot for slot in online.list_slots(ROBOT.name) if slot.aspect == "plan")
    left = Outcome("taken", version, found.position.stamp_ns, actor="Robot, process 7 on cell-1",
                   session=session, run="before")  # fmt: skip
    write(online, OUTCOME, left)
    return left


def test_version_whose_taker_is_gone_is_interrupted_and_never_repeated(cell, online, caplog):
    """Shown by its outcome, in the log and in the report; a newer plan runs."""
    write(online, PLAN, [1])
    taken_by(online, "0123456789abcdef")
    robot = Robot()

    with ActorThread(robot, cell) as thread:
        found = until(online, "interrupted")
        write(online, PLAN, [2])
        until(online, "done")

    assert robot.moved == [[2]]
    assert found.version == 1
    assert "process 7 on cell-1" in found.text
    assert thread.statistics().interrupted == 1
    assert "version 1 for " in thread.statistics().last_interrupted
    assert "how far it came is unknown" in caplog.text


def test_version_of_a_run_before_in_this_process_is_closed(cell, online, caplog):
    """Its session lives on with the next run, which would wait for an outcome for ever."""

    class Killed(BaseException):
        pass

    def moves(_):
        raise Killed

    write(online, PLAN, [1])
    with pytest.raises(Killed):
        run_actor(Robot(moves), cell, stop=threading.Event())
    assert read(online, OUTCOME).state == "taken"
    robot = Robot()
    with ActorThread(robot, cell):
        until(online, "interrupted")
        write(online, PLAN, [2])
        until(online, "done")

    assert robot.moved == [[2]]
    assert "interrupted: version 1" in caplog.text


def test_version_that_was_deleted_meanwhile_is_closed_too(cell, online):
    """No plan is there to trigger; the start of the actor looks for what was left."""
    write(online, PLAN, [1])
    taken_by(online, "0123456789abcdef")
    write(online, PLAN, None)

    with ActorThread(Robot(), cell):
        assert until(online, "interrupted").version == 1


@pytest.mark.slow
def test_version_of_a_session_that_still_seems_to_live_is_closed_when_it_is_over(two_shards):
    """No trigger is needed for it: the actor looks again until the other's lease has ended."""
    online = two_shards.cell.world("online")
    other = two_shards.connect(actor="before")
    write(online, PLAN, [1])
    left = taken_by(online, other._client.core.session)
    write(online, PLAN, None)

    with ActorThread(Robot(), two_shards.cell) as thread:
        while thread.statistics().state != "running":
            pass
        assert read(online, OUTCOME) == left
        other.close()
        assert until(online, "interrupted").version == 1


def test_two_processes_of_one_actor_do_not_act_both(cell, online, caplog):
    """While the taker's session lives, the other one waits; it does not call it interrupted."""
    write(online, PLAN, [1])
    left = taken_by(online, cell._client.core.session)
    robot = Robot()

    with pytest.raises(LockTimeoutError, match="version 1 is taken by Robot, process 7 on cell-1"):
        testing.run_once(robot, cell)
    assert robot.moved == []
    assert read(online, OUTCOME) == left

    write(online, OUTCOME, Outcome("done", 1, left.committed_ns))
    assert testing.run_once(robot, cell) == 0
    assert "waits: version 1" in caplog.text


def test_taker_that_was_taken_for_gone_learns_it_and_writes_no_outcome(cell, online, caplog):
    """One that was cut off and comes back: what others have written stays."""
    other = Outcome("interrupted", 1, 1)

    def moves(lock):
        write(online, OUTCOME, other)
        with pytest.raises(LeaseLostError):
            lock.check()
        assert not lock.valid()

    write(online, PLAN, [1])
    testing.run_once(Robot(moves), cell)

    assert read(online, OUTCOME) == other
    assert read(online, JOINTS) is None
    assert "the outcome done of version 1 is not written" in caplog.text


PROGRAM = """
import os, sys, threading
from pathlib import Path
sys.path.insert(0, sys.argv[3])
from enact_dist import Actor, Aspect, Entity, View, World, Write, connect
from enact_dist.actor.running.runner import run_actor
from enact_dist import Outcome

class Robot(Actor):
    plan = View(World("online"), Entity("robot"), Aspect("plan", list))
    outcome = Write(World("online"), Entity("robot"), Aspect("plan_outcome", Outcome))
    triggers = (plan,)
    once = True
    def update(self, lock):
        with Path(sys.argv[2]).open("a") as moved:
            moved.write(f"{lock[self.plan]}\\n")
        print("moves", flush=True)
        if lock[self.plan] == [1]:
            threading.Event().wait()

with connect(sys.argv[1]) as cell:
    run_actor(Robot(), cell, stop=threading.Event())
"""


@pytest.mark.slow
@pytest.mark.carrier("socket", "zenoh")
def test_actor_that_is_killed_in_its_motion_never_repeats_it(two_shards, tmp_path):
    """`kill -9` between taking and outcome; started again, it closes the version and goes on."""
    online = two_shards.cell.world("online")
    moved = tmp_path / "moved"
    command = [sys.executable, "-c", PROGRAM, two_shards._endpoints["left"], str(moved),
               str(Path(__file__).parents[2])]  # fmt: skip
    write(online, PLAN, [1])
    actors = []
    try:
        for _ in range(2):
            actors.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
            if len(actors) == 1:
                assert actors[0].stdout.readline() == "moves\n"
                os.kill(actors[0].pid, signal.SIGKILL)
                actors[0].wait(PATIENCE_S)
        interrupted = until(online, "interrupted")
        write(online, PLAN, [2])
        assert actors[1].stdout.readline() == "moves\n"
        until(online, "done")
    finally:
        for actor in actors:
            actor.kill()
            actor.wait(PATIENCE_S)
            actor.stdout.close()

    assert interrupted.version == 1
    assert [json.loads(line) for line in moved.read_text().splitlines()] == [[1], [2]]
