"""What the planner expects, written into a fork of the online context before a risky step.

    online ── fork "expected-7" ── standing of the place: as planned
      └─ what is observed later

So the deviation is ``diff(expected, observed)``, over all that the step should have left alone.
"""

from __future__ import annotations

import threading
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from actors.palletizing.vocabulary import STANDING, Standing
from enact_dist import Entity, Lock, Write, connect
from enact_dist.errors import EnactError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from actors.palletizing.vocabulary import Deviation, Plan, Request
    from enact_dist import Cell

PREFIX: Final = "expected-"
KEPT: Final = 4
"""So many forks of deviating places stay, the newest ones."""
WAIT_S: Final = 2.0
"""So long a stage waits for its fork; the robot does not stand still for one."""


class Expectations:
    """Makes the forks and drops those that are not needed any more.

    Args:
        cell: The `cell.toml`, or an endpoint.
    """

    def __init__(self, cell: str) -> None:
        self._address = cell
        self._cell: Cell | None = None
        self._places: dict[str, str] = {}
        self._thread: threading.Thread | None = None

    def before(self, request: Request, plan: Plan, flags: Mapping[str, Deviation]) -> None:
        """Fork the online context, unless that was done for this request.

        A thread of its own does it, since the caller holds a lock; without a fork the robot goes on
        all the same.

        Args:
            request: What is going to be done.
            plan: What shall stand at its place.
            flags: Verdicts by place, to see which forks are not needed any more.
        """
        name = f"{PREFIX}{request.number}"
        if name in self._places or (self._thread is not None and self._thread.is_alive()):
            return
        self._places[name] = request.place
        self._thread = threading.Thread(
            target=self._fork, args=(name, request.place, plan, dict(flags)), daemon=True
        )
        self._thread.start()
        self._thread.join(WAIT_S)

    def close(self) -> None:
        """Leave the cell; the forks stay."""
        if self._cell is not None:
            self._cell.close()
            self._cell = None

    def _fork(self, name: str, place: str, plan: Plan, flags: Mapping[str, Deviation]) -> None:
        with suppress(EnactError):
            if self._cell is None:
                self._cell = connect(self._address, actor="expectations")
            fork = self._cell.world("online").fork(name)
            standing = Write(fork, Entity(place), STANDING)
            with Lock(standing) as lock:
                lock[standing] = Standing(plan.product, "ok", shift_mm=0.0, turn_deg=0.0)
            self._drop(name, flags)

    def _drop(self, newest: str, flags: Mapping[str, Deviation]) -> None:
        """Drop the forks of sound places, and all but the newest of the others."""
        assert self._cell is not None
        before = [name for name in self._places if name != newest]
        deviating = [
            name
            for name in before
            if (flag := flags.get(self._places[name])) is not None and flag.verdict != "ok"
        ]
        for name in set(before) - set(deviating[-KEPT:]):
            with suppress(EnactError):
                self._cell.drop_world(name)
            del self._places[name]
