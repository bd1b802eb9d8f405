"""The inner loop of the robot: executes nets on an arm's controller, in a thread of its own.

It locks nothing of a world context: other threads hand in nets and what the gripper measured, and
take what is to be published.  All they exchange are immutable values in single attributes.

Rules a change must keep: the loop waits for nothing but the controller; a measurement is answered
once, and one that stands still is not answered at all; a loop that was held up goes on from now; an
arm whose cell or gripper is silent for longer than the lease ends its net and comes to rest.
"""

from __future__ import annotations

import dataclasses
import logging
import threading
import time
from collections import deque
from contextlib import suppress
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.palletizing.control.controller import ControllerError, Measured
from actors.palletizing.control.execution import Executor
from actors.palletizing.handling.nets import Execution, TraceStep
from actors.palletizing.vocabulary import Control, GripCommand
from actors.workcell.vocabulary import JOINTS_KEPT, Joints

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.palletizing.control.controller import ArmController, ArmMeasured
    from actors.palletizing.vocabulary import Attached, GripState

_LOG: Final = logging.getLogger("enact.actor")
FROZEN_S: Final = 1.0
"""So long may a controller measure nothing new, by the clock of this host: meanwhile it gets no
command, so the arm rests.  A busy host held up the simulated one for more than 0.3 s."""
SAMPLE_NS: Final = 10_000_000
"""Between two samples of the joints that are published."""
SNAPSHOT_NS: Final = 100_000_000
"""Between two states of an execution, if no exit is taken."""
AGAIN_S: Final = 0.5
"""After that long a controller that could not be reached is tried again."""
BIN_MS: Final = 0.05
BINS: Final = 2_000
"""Of the periods, to 100 ms."""
LATE_MS: Final = 8.0
"""A longer period counts as late."""


class Periods:
    """How long the periods of a loop were, in bins of 0.05 ms."""

    def __init__(self) -> None:
        self._counts = np.zeros(BINS + 1, np.int64)
        self._longest_ms = 0.0
        self._last_s = 0.0

    def tick(self, now_s: float) -> None:
        """Take the start of a cycle."""
        if self._last_s:
            ms = 1e3 * (now_s - self._last_s)
            self._counts[min(int(ms / BIN_MS), BINS)] += 1
            self._longest_ms = max(self._longest_ms, ms)
        self._last_s = now_s

    def pause(self) -> None:
        """Do not count the time until the next cycle."""
        self._last_s = 0.0

    def figures(self) -> Control:
        """Return what they were so far; the upper edges of the bins."""
        counts = self._counts.copy()
        total, sums = int(counts.sum()), np.cumsum(counts)

        def quantile_ms(share: float) -> float:
            return BIN_MS * (int(np.searchsorted(sums, share * total)) + 1) if total else 0.0

        return Control(
            cycles=total,
            median_ms=quantile_ms(0.5),
            p99_ms=quantile_ms(0.99),
            longest_ms=self._longest_ms,
            late=int(counts[round(LATE_MS / BIN_MS) :].sum()),
            locked_ms=0.0,
        )


class ControlLoop:
    """A controller with its loop.

    Args:
        controller: The arm's; it is started, and closed, by the loop.
        lease_s: How long the world and the gripper may be silent while a net runs.

    Attributes:
        gripper: The newest state of the gripper; None: none has come.
        grip: The newest command to the gripper of this loop; None: it has asked for nothing.
        grip_number: Its number; before it, that of the command which the gripper follows.
        execution: The newest state of an execution; None before the first one.
        ended: Executions that are over and not yet published.
    """

    def __init__(self, controller: ArmController, *, lease_s: float) -> None:
        self._controller, self._lease_s = controller, lease_s
        self.gripper: GripState | None = None
        self.grip: GripCommand | None = None
        self.grip_number = 0
        self.execution: Execution | None = None
        self.ended: deque[Execution] = deque()
        self._gripper_s = self._world_s = self._fresh_s = self._grip_s = 0.0
        self._asked: tuple[Attached, float] | None = None
        self._executor: Executor | None = None
        self._attached: Attached | None = None
        self._from_rad: npt.NDArray[np.float64] | None = None
        self._snapshot_ns, self._trace = 0, 0
        self._measured: ArmMeasured | None = None
        self._samples: deque[ArmMeasured] = deque(maxlen=JOINTS_KEPT)
        self._periods = Periods()
        self._idle, self._stop = threading.Event(), threading.Event()
        self._idle.set()
        self._brake = ""
        self._thread = threading.Thread(target=self._run, name="robot loop", daemon=True)
        self._thread.start()

    # Of other threads

    def reached(self, gripper: GripState | None) -> None:
        """Take that the world was reached just now, and what it knows of the gripper."""
        self._world_s = time.monotonic()
        if gripper is not None and gripper != self.gripper:
            self.gripper, self._gripper_s = gripper, self._world_s

    def execute(self, attached: Attached) -> None:
        """Begin with a net at the next cycle; `wait` for its end."""
        self._brake = ""
        self._idle.clear()
        self._asked = attached, time.monotonic()

    def wait(self, timeout_s: float) -> bool:
        """Wait for the end of the net; return whether it is over and the arm at rest."""
        return self._idle.wait(timeout_s)

    def brake(self, reason: str) -> None:
        """End the net that runs, for a reason of one word; the arm comes to rest."""
        self._brake = reason

    def joints(self) -> Joints | None:
        """Return the last 0.3 s; None until there are as many."""
        samples = list(self._samples)
        if len(samples) < JOINTS_KEPT:
            return None
        return Joints(
            q=np.stack([one.q for one in samples]),
            dq=np.stack([one.dq for one in samples]),
            stamp_ns=np.array([one.stamp_ns for one in samples], np.int64),
        )

    def figures(self) -> Control:
        """Return what its periods were so far."""
        return self._periods.figures()

    def close(self) -> None:
        """Brake, disconnect."""
        self._stop.set()
        self._thread.join()

    # Of the loop

    def _run(self) -> None:
        started = False
        while not self._stop.is_set():
            try:
                if not started:
                    self._controller.start()
                    started, self._fresh_s = True, time.monotonic()
                self._cycles()
            except ControllerError as error:
                started = False
                self._fail("braked:controller", str(error))
            except Exception as error:  # noqa: BLE001 (a thread has no caller: the net ends by name)
                _LOG.exception("the control loop failed")
                started = False
                self._fail("braked:loop", f"{type(error).__name__}: {error}")
        self._end_now("braked:stopped", "the robot's process ends")
        self._controller.close()

    def _fail(self, result: str, because: str) -> None:
        """Brake after an error, and end the net; the controller is tried again after a while."""
        with suppress(Exception):  # which may be what the controller cannot do either
            self._controller.brake()
        self._periods.pause()
        self._end_now(result, because)
        self._from_rad = None
        self._stop.wait(AGAIN_S)

    def _cycles(self) -> None:
        """Cycle until the end or an error of the controller."""
        period_s = self._controller.cycle_s
        next_s = time.monotonic()
        while not self._stop.is_set() or self._executor is not None:
            if self._stop.is_set():
                self._brake = "stopped"
            self._periods.tick(time.monotonic())
            self._cycle()
            now_s = time.monotonic()
            # A loop that was held up goes on from now: it never makes up for lost cycles.
            next_s = max(next_s + period_s, now_s)
            time.sleep(max(0.0, next_s - now_s))

    def _cycle(self) -> None:
        measured, now_s = self._controller.measured(), time.monotonic()
        fresh = self._measured is None or measured.stamp_ns != self._measured.stamp_ns
        if fresh:
            self._fresh_s = now_s
            self._measured = measured
            if not self._samples or measured.stamp_ns - self._samples[-1].stamp_ns >= SAMPLE_NS:
                self._samples.append(measured)
        silent_s = now_s - self._fresh_s
        if not fresh and silent_s < FROZEN_S:
            return
        asked, self._asked = self._asked, None
        if asked is not None:
            self._begin(*asked)
        if self._executor is not None:
            # The time of the measurements, until they stand still.
            self._step(measured, 1e-9 * measured.stamp_ns + (0.0 if fresh else silent_s), now_s)

    def _begin(self, attached: Attached, at_s: float) -> None:
        self._attached, self._trace, self._snapshot_ns = attached, -1, 0
        self._gripper_s = max(self._gripper_s, at_s)
        self._world_s = max(self._world_s, at_s)
        try:
            self._executor = Executor(
                attached.net,
                self._controller.model,
                attached.frames.__getitem__,
                net_version=attached.number,
                posture_rad=self._controller.posture_rad,
                from_rad=self._from_rad,
            )
        except ValueError as error:
            self._end_now(f"refused:{error}", str(error))

    def _step(self, measured: ArmMeasured, now_s: float, host_s: float) -> None:
        executor, gripper = self._executor, self.gripper
        assert executor is not None
        if gripper is None:
            if host_s - self._gripper_s > self._lease_s:
                self._end_now("braked:gripper_silent", "the gripper has not said anything yet")
            return
        if not executor.result:
            self._look_out(executor, gripper, host_s)
        full = Measured(
            measured.stamp_ns, measured.q, measured.dq, measured.tcp, measured.wrench,
            gripper.width_m, gripper.width_rate_m_s, gripper.force_n,
        )  # fmt: skip
        command = executor.step(full, now_s, waits=self._waits(gripper))
        if command.grip is not None:
            self.grip_number, self._grip_s = self.grip_number + 1, host_s
            self.grip = GripCommand(self.grip_number, command.grip.kind, command.grip.value)
        self._controller.command(command.q)
        self._from_rad = command.q
        if command.result is not None and command.at_rest:
            self.execution = executor.execution()
            self._over()
        elif not executor.result and (
            len(executor.trace) != self._trace
            or measured.stamp_ns - self._snapshot_ns >= SNAPSHOT_NS
        ):
            self._trace, self._snapshot_ns = len(executor.trace), measured.stamp_ns
            self.execution = executor.execution()

    def _look_out(self, executor: Executor, gripper: GripState, host_s: float) -> None:
        """End a net that must not go on."""
        # A gripper is silent only while the world is not: its state comes from there.
        away_s, silent_s = host_s - self._world_s, self._world_s - self._gripper_s
        if self._brake:
            executor.brake(self._brake)
        elif away_s > self._lease_s:
            executor.brake("world_unreachable", f"no shard has answered for {away_s:.1f} s")
        elif silent_s > self._lease_s:
            executor.brake("gripper_silent", f"the gripper's state is {silent_s:.1f} s old")
        elif self._waits(gripper) and host_s - self._grip_s > self._lease_s:
            executor.brake("gripper_refuses", f"the gripper does not take {self.grip}")

    def _waits(self, gripper: GripState) -> bool:
        return self.grip is not None and gripper.number != self.grip_number

    def _end_now(self, result: str, because: str) -> None:
        """End the net that runs, or was to begin, without a step."""
        asked, self._asked = self._asked, None
        if asked is not None:
            self._attached, self._executor, self._trace = asked[0], None, -1
        if self._attached is None:
            return
        executor, measured = self._executor, self._measured
        if executor is not None and self._trace >= 0 and executor.result:
            self.execution = executor.execution()
        else:
            self.execution = ended_without_step(self._attached, self.execution, measured, result)
            step = TraceStep(self.execution.primitive, result, 0.0, because)
            self.execution = dataclasses.replace(
                self.execution, trace=(*self.execution.trace, step)
            )
        self._over()

    def _over(self) -> None:
        self._executor = self._attached = None
        assert self.execution is not None
        self.ended.append(self.execution)
        self._idle.set()


def ended_without_step(
    attached: Attached, before: Execution | None, measured: ArmMeasured | None, result: str
) -> Execution:
    """Return the execution of a net that ends where it was last seen, or before its first step.

    Args:
        attached: The net.
        before: The newest state of an execution, perhaps of an earlier net.
        measured: Where the arm is; None if that is not known.
        result: How it ended.
    """
    if before is not None and before.net_version == attached.number:
        return dataclasses.replace(before, result=result)
    return Execution(
        net_name=attached.net.name,
        net_version=attached.number,
        primitive=attached.net.start,
        since_ns=0 if measured is None else measured.stamp_ns,
        trace=(),
        result=result,
        wrench=np.zeros(6),
        width_m=0.0,
        tcp=np.eye(4) if measured is None else measured.tcp,
    )
