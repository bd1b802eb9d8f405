"""The robot that acts once, and what tests of it share."""

import threading

from enact_dist import Outcome
from enact_dist.access.lock import Lock
from enact_dist.actor.actor import Actor
from enact_dist.terms import (
    Aspect,
    Entities,
    Entity,
    View,
    ViewEach,
    World,
    Write,
)

ROBOT = Entity("robot")
PLAN, OUTCOME = Aspect("plan", list), Aspect("plan_outcome", Outcome)
JOINTS, LIMIT = Aspect("joints", list), Aspect("limit", float)
ONLINE = World("online")
PATIENCE_S = 60.0


class Robot(Actor):
    """Moves along a plan until it is over or somebody wants something else."""

    plan = View(ONLINE, ROBOT, PLAN)
    limits = ViewEach(ONLINE, Entities("limit/*"), LIMIT)
    outcome = Write(ONLINE, ROBOT, OUTCOME)
    joints = Write(ONLINE, ROBOT, JOINTS)
    triggers = (plan,)
    once = True
    hold_s = 0.2

    def __init__(self, moves=None):
        self.moved = []
        self.moves = moves or (lambda _lock: None)

    def update(self, lock):
        self.moved.append(lock[self.plan])
        self.moves(lock)
        lock[self.joints] = lock[self.plan]


def write(world, aspect, datum):
    request = Write(world, ROBOT, aspect)
    with Lock(request) as lock:
        if datum is None:
            del lock[request]
        else:
            lock[request] = datum


def read(world, aspect):
    view = View(world, ROBOT, aspect)
    return world.view(view).get(view)


class Gate:
    """Lets a test follow a motion: `begun` when it moves, `seen` what `newer` says in the end."""

    def __init__(self):
        self.begun, self.reasons = threading.Semaphore(0), []

    def __call__(self, lock):
        self.begun.release()
        assert lock.newer.wait(PATIENCE_S)
        self.reasons.append(lock.newer.reason)


def outcomes(world, count):
    """Follow the outcomes of the robot until so many have come, or time is up."""
    found = []
    with world.watch(ROBOT, OUTCOME) as watch:
        while len(found) < count:
            change = watch.next(timeout_s=PATIENCE_S)
            assert change is not None, found
            if not change.null:
                found.append(read(world, OUTCOME))
    return found


def until(world, state):
    """Wait until the newest outcome is in a state; return it."""
    with world.watch(ROBOT, OUTCOME) as watch:
        while True:
            change = watch.next(timeout_s=PATIENCE_S)
            assert change is not None, read(world, OUTCOME)
            found = read(world, OUTCOME)
            if found is not None and found.state == state:
                return found
