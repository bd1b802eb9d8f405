"""What the planner expects, written into a fork of the online context before each risky stage.

    online ── fork "expected-7-push" ── standing of the place: as planned
      └─ what is observed later

So the deviation is ``diff(expected, observed)``, over all that the stage should have left alone.

=========  =========================================================================================
stage      what is expected after it
=========  =========================================================================================
regrasp    the place is empty
place      the package stands at its place; short of it by the gap, if it is pushed then
push       it stands as planned
remove     it is seen nowhere
=========  =========================================================================================
"""

from __future__ import annotations

import logging
import re
import threading
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from actors.palletizing.handling.grounding import PUSH_GAP_M
from actors.palletizing.handling.stages import RISKY
from actors.palletizing.vocabulary import SIGHTING, STANDING, Standing
from enact_dist import Entity, Lock, Write
from enact_dist.errors import EnactError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from actors.palletizing.handling.stages import Known
    from actors.palletizing.vocabulary import Deviation, Request
    from enact_dist import Cell, WorldContext
    from enact_dist.actor.binding import Joined

_LOG: Final = logging.getLogger("enact.actor")
PREFIX: Final = "expected-"
_NAME: Final = re.compile(f"({PREFIX}[0-9]+)(-({'|'.join(RISKY)}))?")
KEPT: Final = 4
"""The forks of so many requests about deviating places stay, of the newest ones."""
WAIT_S: Final = 2.0
"""So long a stage waits for its fork; the robot does not stand still for one."""


class Expectations:
    """Makes the forks and drops those that are not needed any more."""

    def __init__(self) -> None:
        self._places: dict[str, str] = {}
        self._thread: threading.Thread | None = None
        self._is_new = True

    def before(
        self,
        where: Joined,
        request: Request,
        stage: str,
        known: Known,
        flags: Mapping[str, Deviation],
    ) -> None:
        """Fork the online context, unless that was done for this stage.

        A thread of its own does it, since the caller holds a lock; without a fork the robot goes on
        all the same.

        Args:
            where: The cell, and the world context of the role "online".
            request: What is asked for.
            stage: One of `RISKY`, that is going to be executed.
            known: What shall stand at its place, and where its package was seen.
            flags: Verdicts by place, to see which forks are not needed any more.
        """
        name = f"{PREFIX}{request.number}-{stage}"
        if name in self._places or (self._thread is not None and self._thread.is_alive()):
            return
        self._places[name] = request.place
        self._thread = threading.Thread(
            target=self._fork, args=(where, name, request, known, dict(flags)), daemon=True
        )
        self._thread.start()
        self._thread.join(WAIT_S)

    def _fork(
        self,
        where: Joined,
        name: str,
        request: Request,
        known: Known,
        flags: Mapping[str, Deviation],
    ) -> None:
        place = self._places[name]
        try:
            if self._is_new:  # what those of an earlier process are about is not known any more
                self._drop(where.cell, self._earlier(where))
                self._is_new = False
            self._places[name] = place
            fork = where.worlds["online"].fork(name)
            write_expected(fork, request, name.rpartition("-")[2], known)
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
        own = request_of(newest)
        before = [name for name in self._places if request_of(name) != own]
        deviating = dict.fromkeys(
            request_of(name)
            for name in before
            if (flag := flags.get(self._places[name])) is not None and flag.verdict != "ok"
        )
        kept = list(deviating)[-KEPT:]
        return {name for name in before if request_of(name) not in kept}

    def _drop(self, cell: Cell, names: set[str]) -> None:
        for name in sorted(names):
            with suppress(EnactError):
                cell.drop_world(name)
            self._places.pop(name, None)


def request_of(name: str) -> str:
    """Return what the forks of one request have in common: the name without the stage."""
    found = _NAME.fullmatch(name)
    return name if found is None else found[1]


def write_expected(fork: WorldContext, request: Request, stage: str, known: Known) -> None:
    """Write what is expected after a stage, see the module.

    Raises:
        EnactError: It cannot be written.
    """
    if stage == "remove":
        sighting = Write(fork, Entity(request.package), SIGHTING)
        with Lock(sighting) as lock:
            seen = known.sightings[request.package]
            lock[sighting] = replace(seen, frame="", unfit="")
        return
    plan = known.plans[request.place]
    state = "missing" if stage == "regrasp" else "ok"
    short_mm = 1e3 * PUSH_GAP_M if stage == "place" and plan.push.any() else 0.0
    standing = Write(fork, Entity(request.place), STANDING)
    with Lock(standing) as lock:
        lock[standing] = Standing(plan.product, state, shift_mm=short_mm, turn_deg=0.0)


def last_forks(cell: Cell) -> list[str]:
    """Return the fork of the last risky stage of each request that has any, the oldest first."""
    forks = {
        name: origin[1]
        for name in cell.worlds()
        if _NAME.fullmatch(name) and (origin := cell.world(name).forked_from) is not None
    }
    last = {request_of(name): name for name in sorted(forks, key=lambda one: forks[one])}
    return sorted(last.values(), key=lambda one: forks[one])
