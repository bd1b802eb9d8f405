"""What only processes can show: the cell with its robot while parts of it are killed or fail.

One cell runs for all of these tests.  Each breaks something in the middle of a package, and ends when
it is known what became of that package; the next one takes the next package.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import pytest
from polling import until

pytest.importorskip("open3d", exc_type=ImportError)
pytest.importorskip("mujoco", exc_type=ImportError)

from actors.palletizing.demo.robot_cell import RunningRobotCell
from actors.palletizing.vocabulary import (
    ARRIVAL,
    CONTROL,
    CONVEYOR,
    EXECUTION,
    NET,
    REQUEST,
    RESULTS,
    ROBOT,
    SYSTEM,
)
from enact_dist import View
from enact_dist.errors import EnactError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from actors.palletizing.handling.nets import Execution
    from actors.palletizing.vocabulary import Request, Result
    from enact_dist import Aspect, Cell, Entity

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timing,
    pytest.mark.sampled(0, of="faults of packing"),  # on a slow host arms lag
]

T = TypeVar("T")
LONG_S = 90.0
"""What a busy machine may take for anything; it is no claim."""
PACKAGES = 7
SEED = 7


class Trial:
    """A running cell, and what a test does to it."""

    def __init__(self, processes: RunningRobotCell, cell: Cell) -> None:
        self.processes, self.cell = processes, cell
        self.online, self.hardware = cell.world("online"), processes.hardware

    def get(self, entity: Entity, aspect: Aspect[T]) -> T | None:
        """Return a datum, None if it is null."""
        view = View(self.online, entity, aspect)
        return self.online.view(view).get(view)

    def until(self, what: str, condition: Callable[[], T]) -> T:
        """Wait until a condition holds, and return what it found; a shard may be away meanwhile."""

        def asked() -> T | None:
            self.processes.check()
            with contextlib.suppress(EnactError, IndexError):
                return condition()
            return None

        def missed() -> str:
            log = self.processes.config.with_name("cell.log").read_text()[-3000:]
            doing = self.get(ROBOT, EXECUTION), self.get(SYSTEM, REQUEST), self.get(SYSTEM, RESULTS)
            return f"not within {LONG_S:.0f} s: {what}\n{doing}\n{log}"

        found = until(asked, limit_s=LONG_S, missed=missed)
        print(f"{time.strftime('%X')} {what}: {found}")
        return found

    def doing(self, *primitives: str) -> Execution:
        """Wait until the robot executes one of some primitives."""

        def found() -> Execution | None:
            now = self.get(ROBOT, EXECUTION)
            return None if now is None or now.result or now.primitive not in primitives else now

        return self.until(f"the robot is at {', '.join(primitives)}", found)

    def ended(self, net: int, *results: str) -> Execution:
        """Wait until a net, or one after it, is over; with one of some results, if any are named."""

        def found() -> Execution | None:
            every = [one.datum() for one in self.online.history(ROBOT, EXECUTION, count=100)]
            over = (one for one in every if one.net_version >= net and one.result)
            return next((one for one in over if one.result.startswith(results or "")), None)

        return self.until(f"net {net} is over", found)

    def request_of(self, execution: Execution) -> Request:
        """Return the request that a net was for."""
        nets = [one.datum() for one in self.online.history(SYSTEM, NET)]
        number = next(one.request for one in nets if one.number == execution.net_version)
        every = [one.datum() for one in self.online.history(SYSTEM, REQUEST)]
        return next(one for one in every if one.number == number)

    def failed(self, kind: str, seconds: float, when: str) -> tuple[float, float]:
        """Order a failure, and wait until it has begun; return from when to when it lasts."""
        self.hardware.fail(kind, seconds, when)
        return self.until(f"the {kind} fails", lambda: self.hardware.failures().get(kind))

    def closed(self, place: str) -> Result:
        """Wait until it is known what became of the package of a place."""
        return self.until(
            f"{place} is closed", lambda: (self.get(SYSTEM, RESULTS) or {}).get(place)
        )

    def requests(self, place: str) -> list[Request]:
        """Return all requests about a place, the oldest first."""
        every = [one.datum() for one in self.online.history(SYSTEM, REQUEST)]
        return [one for one in every if one.place == place]

    def looks(self, place: str, error: str) -> Request:
        """Wait until a request about a place gives an error as its reason; return it."""
        return self.until(
            f"{place}: {error}",
            lambda: next((one for one in self.requests(place) if error in one.reason), None),
        )

    def pid(self, name: str) -> int:
        """Return the process of an actor."""
        return next(one.pid for one in self.cell.actors() if name in one.names())


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Trial]:
    """A cell that is up, and trains."""
    out = tmp_path_factory.mktemp("cell")
    running = RunningRobotCell(out, packages=PACKAGES, seed=SEED, speed=2.0)
    with running as processes, processes.joined() as cell:
        yield Trial(processes, cell)


def test_robot_that_is_killed_brakes_holds_and_asks(trial: Trial) -> None:
    """The arm stops with what it holds; the net does not begin again, and the operator is asked."""
    begun = trial.doing("carry")
    pid = trial.pid("robot")
    os.kill(pid, signal.SIGKILL)

    def rests() -> bool:
        return float(np.abs(trial.hardware.ask("measured").dq).max()) < 0.01

    trial.until("the arm rests", rests)
    held = trial.hardware.truth().packages[0].where
    done = trial.ended(begun.net_version, "interrupted:")  # perhaps the net after it
    request = trial.request_of(done)
    result = trial.closed(request.place)

    assert held == "held"
    assert trial.until("it is back", lambda: trial.pid("robot")) != pid
    nets = [one.datum() for one in trial.online.history(SYSTEM, NET)]
    assert [one.number for one in nets] == sorted({one.number for one in nets})
    follows = next(one for one in trial.requests("place/0") if one.number == request.number + 1)
    assert follows.kind == "ask"
    assert result.result in {"rejected", "removed", "placed", "accepted"}


def test_gripper_that_loses_its_package_is_noticed(trial: Trial) -> None:
    """It opens when the package hangs over the tray: the net ends by the width, and more follows."""
    net = trial.until("a net", lambda: trial.get(SYSTEM, NET)).number
    trial.failed("gripper", 0.4, "carried")

    done = trial.ended(net, "lost")
    request = trial.request_of(done)
    trial.closed(request.place)

    number = int(request.place.rpartition("/")[2])
    assert trial.hardware.truth().packages[number].lost >= 1
    follows = [one for one in trial.requests(request.place) if one.number > request.number]
    assert follows[0].reason  # how it lies is chance, that it does not stand at its place is not


def test_belt_that_stops_delays_the_next_package(trial: Trial) -> None:
    """Nothing comes while it stands, and it goes on by itself; what the robot does is not disturbed."""
    _, ends_s = trial.failed("belt", 3.0, "running")
    before = trial.until("what has come", lambda: trial.get(CONVEYOR, ARRIVAL))

    later = trial.until(
        "the next package comes",
        lambda: (now := trial.get(CONVEYOR, ARRIVAL)) and now.number > before.number and now,
    )

    assert trial.hardware.truth().at_s > ends_s
    assert later.number == before.number + 1


def test_sensor_that_freezes_ends_the_net(trial: Trial) -> None:
    """The arm rests, the operator is asked, and the cell goes on when it measures again."""
    net = trial.until("a net", lambda: trial.get(SYSTEM, NET)).number
    trial.failed("wrist", 3.0, "carried")

    done = trial.ended(net, "sensor:frozen")
    request = trial.request_of(done)
    trial.closed(request.place)

    follows = next(one for one in trial.requests(request.place) if one.number == request.number + 1)
    assert follows.kind == "ask"


def test_depth_sensor_that_is_blind_or_stands_still_is_looked_through_again(trial: Trial) -> None:
    """Nothing is judged by old pictures: each failure has a name, and its end is not missed."""
    net = trial.until("a net", lambda: trial.get(SYSTEM, NET)).number
    trial.failed("blind", 600.0, "carried")
    place = trial.request_of(trial.ended(net, "in_contact", "no_neighbour")).place

    first = trial.looks(place, "the tray sensor gave no image")
    trial.failed("camera", 600.0, "")
    trial.hardware.fail("blind", 0.0)
    second = trial.looks(place, "the tray sensor stands still")
    trial.hardware.fail("camera", 0.0)
    result = trial.closed(place)

    assert first.kind == "look"
    assert second.number > first.number
    assert result.result in {"placed", "accepted", "rejected", "removed"}


def test_push_outlives_the_restart_of_its_shard(trial: Trial) -> None:
    """The shard with what the system requests is killed in middle of it; the net ends, and what it did is seen."""
    begun = trial.doing("push")
    os.kill(trial.processes.shard_pid("right"), signal.SIGKILL)

    done = trial.ended(begun.net_version)
    trial.closed(trial.request_of(done).place)

    assert done.result in {"in_contact", "no_neighbour", "braked:world_unreachable"}


def test_control_was_regular_beside_all_actors(trial: Trial) -> None:
    """The robot's loop has run at 250 Hz in spite of all that; its figures are published."""
    control = trial.until("figures", lambda: trial.get(ROBOT, CONTROL))

    print(control)
    assert control.median_ms < 5.0
    assert control.cycles > 1000
