"""What the planner expects, written into a fork of the online context before the first risky stage.

    online ── fork "expected-7" ── standing of the place: as planned
      └─ what is observed later

So the deviation is ``diff(expected, observed)``, over all that the request should have left alone.
"""

from __future__ import annotations

import logging
import re
import threading
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from actors.palletizing.vocabulary import STANDING, Standing
from enact_dist import Entity, Lock, Write
from enact_dist.errors import EnactError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from actors.palletizing.handling import Known
    from actors.palletizing.vocabulary import Deviation, Request
    from enact_dist import Cell, WorldContext
    from enact_dist.actor.binding import Joined

_LOG: Final = logging.getLogger("enact.actor")
PREFIX: Final = "expected-"
_NAME: Final = re.compile(PREFIX + "[0-9]+")
KEPT: Final = 4
"""So many forks of deviating places stay, the newest ones."""
WAIT_S: Final = 2.0
"""So long a stage waits for its fork; the robot does not stand still for one."""


class Expectations:
    """Makes the forks and drops those that are not needed any more."""

    def __init__(self) -> None:
        self._places: dict[str, str] = {}
        self._thread: threading.Thread | None = None
        self._is_new = True

    def before(
        self, where: Joined, request: Request, plan: Plan, flags: Mapping[str, Deviation]
    ) -> None:
        """Fork the online context, unless that was done for this request.

        A thread of its own does it, since the caller holds a lock; without a fork the robot goes on
        all the same.

        Args:
            where: The cell, and the world context of the role "online".
            request: What is going to be done.
            plan: What shall stand at its place.
            flags: Verdicts by place, to see which forks are not needed any more.
        """
        name = f"{PREFIX}{request.number}"
        if name in self._places or (self._thread is not None and self._thread.is_alive()):
            return
        self._places[name] = request.place
        self._thread = threading.Thread(
            target=self._fork, args=(where, name, plan, dict(flags)), daemon=True
        )
        self._thread.start()
        self._thread.join(WAIT_S)

    def _fork(self, where: Joined, name: str, plan: Plan, flags: Mapping[str, Deviation]) -> None:
        place = self._places[name]
        try:
            if self._is_new:  # what those of an earlier process are about is not known any more
                self._drop(where.cell, self._earlier(where))
                self._is_new = False
            self._places[name] = place
            fork = where.worlds["online"].fork(name)
            standing = Write(fork, Entity(place), STANDING)
            with Lock(standing) as lock:
                lock[standing] = Standing(plan.product, "ok", shift_mm=0.0, turn_deg=0.0)
            self._drop(where.cell, self._needless(name, flags))
        except EnactError as error:
            _LOG.warning("%s was not made: %s", name, error)

    def _earlier(self, where: Joined) -> set[str]:
        """Return the forks that a process before this one made; one may lack its expectation."""
        online = where.worlds["online"].name
        return {
            one
            for one in where.cell.worlds()
            if _NAME.fullmatch(one)
            and (origin := where.cell.world(one).forked_from) is not None
            and origin[0] == online
        }

    def _needless(self, newest: str, flags: Mapping[str, Deviation]) -> set[str]:
        """Return the forks of sound places, and all but the newest of the others."""
        before = [name for name in self._places if name != newest]
        deviating = [
            name
            for name in before
            if (flag := flags.get(self._places[name])) is not None and flag.verdict != "ok"
        ]
        return set(before) - set(deviating[-KEPT:])

    def _drop(self, cell: Cell, names: set[str]) -> None:
        for name in sorted(names):
            with suppress(EnactError):
                cell.drop_world(name)
            self._places.pop(name, None)
