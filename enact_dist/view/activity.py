"""Who does what in the cell: locks, actors, shards, and who wrote the data that pages list.

One thread asks the shards once a second while a page is open, so that a shard that does not answer
delays no page.
"""

from __future__ import annotations

import contextlib
import re
import time
from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.cli.top.tables import TABLES
from enact_dist.errors import EnactError
from enact_dist.operate.cell_rates import Looks, pause_s
from enact_dist.view import markup
from enact_dist.view.follower import Follower
from enact_dist.world.look import look_at
from enact_dist.world.trees import shown_s

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from enact_dist.core.protocol.datum import Slot
    from enact_dist.core.protocol.messages import VersionEntry
    from enact_dist.operate.cell_rows import ActorRates, CellRates
    from enact_dist.view.catalogue import SlotCatalogue
    from enact_dist.view.source import CellSource
    from enact_dist.world.listings import LockInfo

_FIELDS: Final = re.compile(r"\{[^{}]*\}")
EVERY_S: Final = 1.0


class CellActivity(NamedTuple):
    """What the page shows of the cell, as HTML.

    Attributes:
        locks: Who holds, waits and keeps.
        actors: Every actor with its rate and its losses.
        shards: Every shard, and its counters that moved.
        held: Who holds a slot and for how long, by the slot's name.
    """

    locks: str = ""
    actors: str = ""
    shards: str = ""
    held: Mapping[str, str] = {}


class Activity(Follower):
    """The thread that asks.

    Args:
        source: The cell.
        catalogue: Which version of a listed slot is the newest.

    Attributes:
        now: What was found last.
    """

    def __init__(self, source: CellSource, catalogue: SlotCatalogue) -> None:
        super().__init__("view activity")
        self._source, self._catalogue = source, catalogue
        self.now = CellActivity()
        self._entries: dict[Slot, VersionEntry] = {}
        self._types: dict[str, str] = {}
        self._listed: dict[object, frozenset[Slot]] = {}
        self._looks = Looks()
        self._run_times = RunTimes()

    def list(self, page: object, slots: Iterable[Slot] | None) -> None:
        """Set which slots a page lists; None: the page has gone."""
        with self._news:
            if slots is None:
                self._listed.pop(page, None)
            else:
                before, self._listed[page] = self._listed.get(page), frozenset(slots)
                if before != self._listed[page]:
                    self._news.notify_all()

    def entry(self, slot: Slot) -> VersionEntry | None:
        """Return size and writer of a listed slot's newest version, as far as they have come."""
        return self._entries.get(slot)

    def type_of(self, aspect: str) -> str:
        """Return the type of an aspect in a few words."""
        return self._types.get(aspect, "")

    def _run(self) -> None:
        while True:
            with self._news:
                self._news.wait_for(lambda: self._stopped or bool(self._listed))
                if self._stopped:
                    return
                listed = self._listed.copy()
            begun_s = time.monotonic()
            explain = partial(self._explain, frozenset().union(*listed.values()))
            for ask in (explain, self._ask, self._refresh):
                with contextlib.suppress(EnactError):
                    ask()
            left_s = pause_s(EVERY_S, time.monotonic() - begun_s)
            with self._news:
                self._news.wait_for(partial(self._is_over, listed), left_s)

    def _is_over(self, listed: Mapping[object, frozenset[Slot]]) -> bool:
        """Whether a pause is over, because pages list something else."""
        return self._stopped or self._listed != listed

    def _explain(self, slots: Iterable[Slot]) -> None:
        states = {slot: self._catalogue.state(slot) for slot in slots}
        self._entries = self._source.explained(
            {slot: state.version for slot, state in states.items() if state and not state.null}
        )

    def _refresh(self) -> None:
        self._catalogue.keep(self._source.refresh())
        aspects = self._source.session.client.aspect_entries()
        self._types = {name: type_name(one.fingerprint) for name, one in aspects.items()}

    def _ask(self) -> None:
        rates = self._looks.add(look_at(self._source.cell))
        self._run_times.add(rates.actors)
        self.now = CellActivity(
            table(rates, "l"),
            table(rates, "a", self._run_times),
            table(rates, "s") + table(rates, "c"),
            held_of(rates.locks),
        )


def type_name(fingerprint: str) -> str:
    """Return a type without the fields of its dataclasses."""
    before = ""
    while before != fingerprint:
        before, fingerprint = fingerprint, _FIELDS.sub("", fingerprint)
    return fingerprint


def lock_mark(lock: LockInfo) -> str:
    """Return who holds a slot, how and since when."""
    return f"{lock.state} by {lock.actor or '(unnamed)'} for {shown_s(lock.age_s)}"


def held_of(locks: Iterable[LockInfo]) -> dict[str, str]:
    """Return who holds a slot and for how long, by the slot's name; grants in use only."""
    return {
        slot.partition(" (")[0]: lock_mark(lock)  # without how it is locked
        for lock in locks
        if lock.granted and lock.state != "kept"
        for slot in lock.slots
    }


class RunTimes:
    """How long the updates of each actor took at the last looks."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, ...], deque[tuple[int, dict[str, float]]]] = {}

    def add(self, actors: Iterable[ActorRates]) -> None:
        """Take a look: of these actors, and of no others, run times are known from now on."""
        before, self._known = self._known, {}
        for actor in actors:
            key = (actor.name, actor.host, str(actor.pid))
            known = before.get(key, deque(maxlen=markup.SAMPLES_MAX))
            if actor.runs_hz is not None and actor.update_p50_ms:
                took_ms = {"p50": actor.update_p50_ms, "p99": actor.update_p99_ms}
                known.append((time.time_ns(), took_ms))
            self._known[key] = known

    def strip(self, *key: str) -> markup.Markup:
        """Return the run times of an actor (its name, host and process) as a small picture."""
        return markup.Markup(markup.plot([*self._known.get(key, ())]))


def table(rates: CellRates, key: str, run_times: RunTimes | None = None) -> str:
    """Return a table of `enact top` as HTML, without what needs a look at all slots.

    Args:
        rates: What two looks have shown.
        key: Which table.
        run_times: Those of actors, which follow the names of those that are shown.
    """
    (found,) = (one for one in TABLES if one.key == key)
    lines, count = found.lines(rates, markup.ROWS_SHOWN_MAX)
    names = [column.name for column in found.columns]
    kept = [index for index, name in enumerate(names) if name != "wrote"]
    rows = [[line[index] for index in kept] for line in lines]
    shown = [names[index] for index in kept]
    if run_times is not None:
        places = [shown.index(name) for name in ("actor", "host", "pid")]
        for row in rows:
            row.insert(1, run_times.strip(*(row[place] for place in places)))
        shown.insert(1, "run time")
    return markup.table(shown, rows, empty=found.empty, count=count)
