"""The work of the cell without sharing: all actors in one thread, their data in a dictionary.

`enact bench workcell` reports its processor time beside that of the cell: the difference is what
locks, commits, copies, notices and processes cost.  The updates are those of the same actors, in
the order in which one tick's data flow; no shard, no encoding, no copy.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, MutableMapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

from actors.running_cell import toml_of
from actors.workcell import vocabulary as words
from actors.workcell.demo.cell import TEMPLATE, configured
from enact_dist import Entity, Together
from enact_dist.actor.running.load import configured_actor
from enact_dist.config.read import load_config

if TYPE_CHECKING:
    from actors.workcell.demo.options import Options
    from enact_dist import Actor, Lock

PERIOD_NS: Final = round(words.PERIOD_S * 1e9)
READY_S: Final = 60.0
"""How long the backgrounds may take."""
SETUP: Final = "setup"
STAND_IN: Final = "stand-in"
"""No camera fails here."""
IN_TURN: Final = ("reconstruction", "tracking", "speed", "planning", "robot")
"""What a set of masks triggers, in the order in which its data flow."""

Key = tuple[str, str, str]


class Version(NamedTuple):
    """A datum."""

    datum: Any
    stamp_ns: int
    number: int


class PlainLock:
    """What an update sees in place of a lock: a dictionary of its own.

    Args:
        slots: Data by names of world context, entity and aspect.
        entity: The entity that the actor works on; None without one.
        tick_ns: The tick of a source; for others the stamp of what triggers them.
    """

    def __init__(self, slots: dict[Key, Version], entity: Entity | None, tick_ns: int) -> None:
        self.slots, self.tick_ns = slots, tick_ns
        self._entity = entity

    @property
    def entity(self) -> Entity:
        """The entity that the actor works on."""
        assert self._entity is not None, "an actor of one entity"
        return self._entity

    def __getitem__(self, request: Any) -> Any:
        if isinstance(request, Together):
            return tuple(self.get(each) for each in request.requests)
        if request.access.each:
            return PlainEach(self, request.address)
        return self.slots[self._key(request)].datum

    def __setitem__(self, request: Any, datum: object) -> None:
        self.put(request, datum)

    def put(self, request: Any, datum: object, *, stamp_ns: int | None = None) -> None:
        """Set a datum."""
        self.set(self._key(request), datum, self.tick_ns if stamp_ns is None else stamp_ns)

    def set(self, key: Key, datum: object, stamp_ns: int) -> None:
        """Set the datum of a slot."""
        self.slots[key] = Version(datum, stamp_ns, self._of(key).number + 1)

    def get(self, request: Any, default: object = None) -> Any:
        """Return a datum, or the default."""
        found = self.slots.get(self._key(request))
        return default if found is None else found.datum

    def is_null(self, request: Any) -> bool:
        """Whether there is no datum."""
        return self._key(request) not in self.slots

    def stamp_ns(self, request: Any) -> int:
        """Return the capture stamp of a datum, or of a set; 0 without one."""
        first = request.requests[0] if isinstance(request, Together) else request
        return self._of(self._key(first)).stamp_ns

    def version(self, request: Any) -> int:
        """Return the number of a version; 0 without one."""
        return self._of(self._key(request)).number

    def _of(self, key: Key) -> Version:
        return self.slots.get(key, Version(None, 0, 0))

    def _key(self, request: Any) -> Key:
        context, entity, aspect = request.address
        return context, entity if isinstance(request.entity, Entity) else self.entity.name, aspect


class PlainEach(MutableMapping[Entity, Any]):
    """The data of a pattern, by entity."""

    def __init__(self, lock: PlainLock, address: Key) -> None:
        self._lock, (self._context, _, self._aspect) = lock, address

    def _key(self, entity: Entity) -> Key:
        return self._context, entity.name, self._aspect

    def __getitem__(self, entity: Entity) -> Any:
        return self._lock.slots[self._key(entity)].datum

    def __setitem__(self, entity: Entity, datum: object) -> None:
        self._lock.set(self._key(entity), datum, self._lock.tick_ns)

    def __delitem__(self, entity: Entity) -> None:
        del self._lock.slots[self._key(entity)]

    def __iter__(self) -> Iterator[Entity]:
        return iter(
            [
                Entity(entity)
                for context, entity, aspect in self._lock.slots
                if (context, aspect) == (self._context, self._aspect)
            ]
        )

    def __len__(self) -> int:
        return len(list(iter(self)))


class UnsharedCell:
    """The actors of a run of the cell, without a shard.

    Args:
        options: What was asked for; its `source` is an address that the cameras can open.

    Attributes:
        slots: Data by names of world context, entity and aspect.
    """

    def __init__(self, options: Options) -> None:
        self.slots: dict[Key, Version] = {}
        self._options = options
        with tempfile.TemporaryDirectory(prefix="enact-unshared-") as folder:
            file = Path(folder) / "cell.toml"
            file.write_text(toml_of(configured(TEMPLATE.read_text(), options)), encoding="utf-8")
            tables = load_config(file).actors
        self._actors = {table.name: configured_actor(table) for table in tables}

    def run(self) -> float:
        """Play the scenario at its true rate; return the processor time used per second.

        Raises:
            TimeoutError: The backgrounds were not learned within `READY_S`.
        """
        setup = self._actors.pop(SETUP)
        self._actors.pop(STAND_IN, None)
        self._update(setup, time.time_ns())
        for actor in self._actors.values():
            actor.start()
        try:
            tick_ns = self._learned()
            lead = 20  # the arm is seen before the scenario begins
            self._play(tick_ns + lead * PERIOD_NS)
            tick_ns = self._ticks(tick_ns, lead)
            begun_s = time.process_time()
            count = round(self._options.seconds / words.PERIOD_S)
            self._ticks(tick_ns, count)
            return (time.process_time() - begun_s) / (count * words.PERIOD_S)
        finally:
            for actor in self._actors.values():
                actor.stop()

    def _learned(self) -> int:
        """Let the cameras learn what is empty; return the tick after it."""
        empty = words.WORKSPACE.name, words.EMPTY.name
        tick_ns = time.time_ns() // PERIOD_NS * PERIOD_NS
        end_ns = tick_ns + round(READY_S * 1e9)
        lock = PlainLock(self.slots, None, tick_ns)
        lock.set(("online", *empty), tick_ns, tick_ns)
        cameras = [words.camera_entity(number).name for number in range(words.CAMERA_COUNT)]
        while any(("online", name, words.BACKGROUND.name) not in self.slots for name in cameras):
            if tick_ns > end_ns:
                raise TimeoutError(f"no backgrounds within {READY_S:g} s")
            tick_ns = self._ticks(tick_ns, 1)
        return tick_ns

    def _play(self, start_ns: int) -> None:
        options = self._options
        playing = words.Playing(
            options.scenario, options.seed, start_ns, options.seconds, robot=True
        )
        lock = PlainLock(self.slots, None, 0)
        lock.set(("truth", words.SCENARIO.name, words.PLAYING.name), playing, 0)

    def _ticks(self, tick_ns: int, count: int) -> int:
        """Run ticks at their times; return the one after the last."""
        for _ in range(count):
            tick_ns = max(tick_ns + PERIOD_NS, time.time_ns() // PERIOD_NS * PERIOD_NS)
            time.sleep(max(0.0, (tick_ns - time.time_ns()) / 1e9))
            for name, actor in self._actors.items():
                if name not in IN_TURN:
                    self._update(actor, tick_ns)
            silhouette = "online", words.camera_entity(0).name, words.SILHOUETTE.name
            if silhouette in self.slots:
                for name in IN_TURN:
                    self._update(self._actors[name], tick_ns)
        return tick_ns

    def _update(self, actor: Actor, tick_ns: int) -> None:
        actor.update(cast("Lock", PlainLock(self.slots, actor.only_entity, tick_ns)))
