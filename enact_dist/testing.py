"""Test actors without a network: world contexts in this process, a manual clock, `run_once`.

::

    def test_deviation_flags_a_product_that_lost_a_corner():
        with testing.worlds("training", "online") as cell:
            cell.world("training").init(PRODUCT, SURFACE, cube())
            cell.world("online").init(PRODUCT, SURFACE, cube(without_corner=True))

            testing.run_once(DeviationDetection(tolerance_m=0.003), cell)

            flags = View(cell.world("online"), SYSTEM, DEVIATIONS)
            assert cell.world("online").view(flags)[flags] == {"product": True}

The real core, locks and commits included, runs behind it; nothing is simulated but time.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from typing import Final
from weakref import WeakKeyDictionary

from enact_dist.access.session import session_of
from enact_dist.access.sets import IncompleteSet, PendingSets
from enact_dist.access.together import captured_versions
from enact_dist.actor.actor import Actor, name_of
from enact_dist.actor.binding import BoundActor
from enact_dist.actor.once import Once
from enact_dist.actor.running.doing import Doing
from enact_dist.actor.triggers import PendingTriggers, tick_before
from enact_dist.link.clock import monotonic_ns, wall_ns
from enact_dist.terms import Entity
from enact_dist.world.cell import Cell
from enact_dist.world.connecting import local

STEP_NS: Final = 100_000_000
"""Time passes in steps of 0.1 s: a shard takes a longer one for its own standing still, for which
no holder has to pay (a quarter of the session TTL, 2 s)."""


_clocks: WeakKeyDictionary[Cell, ManualClock] = WeakKeyDictionary()
"""The clocks of cells that have a manual one."""


class ManualClock:
    """A clock that stands still until `advance`; starts at 1,000 s.

    Monotonic and wall-clock time advance together.  Leases that ended in that time have ended when
    `advance` returns.
    """

    def __init__(self, *, start_s: float = 1_000.0) -> None:
        self._now_ns = round(start_s * 1e9)
        self._ticks: list[Callable[[], object]] = []

    def monotonic_ns(self) -> int:
        """Return the time in nanoseconds since some start."""
        return self._now_ns

    def wall_ns(self) -> int:
        """Return the time in nanoseconds since 1970."""
        return self._now_ns

    def advance(self, seconds: float) -> None:
        """Let time pass.

        Raises:
            ValueError: `seconds` is negative: clocks here never go back.
        """
        if seconds < 0:
            raise ValueError(f"a clock cannot go back by {-seconds} s")
        end_ns = self._now_ns + round(seconds * 1e9)
        while self._now_ns < end_ns:
            self._now_ns = min(self._now_ns + STEP_NS, end_ns)
            for tick in self._ticks:
                tick()

    @contextlib.contextmanager
    def ticking(self, tick: Callable[[], object]) -> Iterator[None]:
        """Call `tick` after each `advance` within the block."""
        self._ticks.append(tick)
        try:
            yield
        finally:
            self._ticks.remove(tick)


@contextlib.contextmanager
def worlds(*names: str, clock: ManualClock | None = None) -> Iterator[Cell]:
    """Run world contexts in this process, in memory, on a manual clock.

    No time passes by itself: a lock lasts until its block ends, or until the test lets its
    `hold_s` pass.  Waiting for a lock that another thread holds needs time to pass, too; so actors
    in threads are tested on `local()`.

    Args:
        names: World contexts that exist from the start.
        clock: Time of the shard and of the leases; a new one by default.
    """
    clock = clock or ManualClock()
    with (
        local(worlds=names, actor="testing", clock=clock) as cell,
        clock.ticking(cell._host.tick),  # noqa: SLF001 (the shard must see each step)
    ):
        _clocks[cell] = clock
        yield cell


def run_once(actor: Actor, cell: Cell, worlds: Mapping[str, str] | None = None) -> int:
    """Let an actor do what is pending now, in this thread, and return.

    An actor with triggers is updated once per entity whose trigger datum is new to this actor
    object: all existing ones at the first call, those that changed since at the next.  A source,
    or an actor that runs once, is updated once; `lock.tick_ns` of a source is the newest multiple
    of its period by the cell's clock.  One with a `Together` is updated once per complete
    set: at the first call for the newest one.  One with `once` acts on versions that no actor has
    acted on, and none preempts it here: that takes an `ActorThread`.  `start` and `stop` are called
    around it.

    Args:
        actor: The actor.
        cell: Where its world contexts are.
        worlds: Role → name of a world context; None binds each role to the context of its name.

    Returns:
        How often `update` ran.

    Raises:
        Exception: Whatever `update`, the lock or the commit raises; the entities after it stay
            pending.
    """
    bound = BoundActor(actor, cell, worlds)
    actor.start()
    try:
        if not bound.declaration.triggers:
            clock = _clocks.get(cell)
            now_ns = clock.wall_ns() if clock is not None else wall_ns()
            _update(bound, None, tick_before(now_ns, actor.every_s) if actor.every_s else 0)
            return 1
        if bound.declaration.together is not None:
            return _update_sets(actor, bound)
        pending = _pending(actor, bound)
        updates = 0
        if bound.declaration.outcome is not None:
            return _act(actor, bound, pending)
        while trigger := pending.take(0):
            _update(bound, trigger.entity)
            updates += 1
        return updates
    finally:
        actor.stop()


def _act(actor: Actor, bound: BoundActor, pending: PendingTriggers) -> int:
    """Let an actor act on each new version that it has not acted on."""
    once = Once(bound, name_of(actor), Doing(type(actor).__name__))
    updates = 0
    while trigger := pending.take(0):
        acted = once.attempt(trigger.entity)
        if acted.error is not None:
            raise acted.error
        updates += acted.ran
    return updates


def _update(bound: BoundActor, entity: Entity | None, tick_ns: int = 0) -> None:
    with bound.lock(entity, tick_ns=tick_ns) as lock:
        bound.actor.update(lock)


def incomplete_sets(actor: Actor) -> tuple[IncompleteSet, ...]:
    """Return the sets that `run_once` of this actor object gave up so far, with what was missing.

    The newest 16; those from before the first call are not the actor's business.
    """
    pending: PendingSets | None = vars(actor).get("_pending_in_test")
    return tuple(pending.told) if pending is not None else ()


def _update_sets(actor: Actor, bound: BoundActor) -> int:
    """Update an actor once per complete set that is new to this actor object."""
    views = bound.set_views()
    session = session_of(views)
    pending: PendingSets | None = vars(actor).get("_pending_in_test")
    versions = captured_versions(session, views)
    clock = _clocks.get(bound.cell)
    now_ns = clock.monotonic_ns() if clock is not None else monotonic_ns()
    if pending is None:
        pending = bound.pending_sets()
        assert pending is not None
        vars(actor)["_pending_in_test"] = pending
        pending.start(versions, now_ns)
    else:
        pending.captured_all(versions, now_ns)
    updates = 0
    while trigger := pending.take(now_ns):
        lock = bound.lock(None, members=trigger.members)
        with lock:
            absent = lock.absent()
            if not pending.enough(absent):
                pending.gone(trigger.captured_ns, absent)
                continue
            bound.actor.update(lock)
        updates += 1
    return updates


def _pending(actor: Actor, bound: BoundActor) -> PendingTriggers:
    """Return what is pending for this actor object, including the newest states."""
    # Kept with the actor object: that is what "new to this actor" means, and it ends with it.
    pending = vars(actor).setdefault(
        "_pending_in_test", PendingTriggers(per_entity=bound.declaration.per_entity)
    )
    assert isinstance(pending, PendingTriggers)
    for watched in bound.watched():
        found = watched.context.list_slots(str(watched.entities), tuple(watched.triggers))
        for slot in found:
            if not bound.covers(slot.entity):
                continue
            state = (slot.version, slot.position.stamp_ns)
            for index in watched.triggers[slot.aspect]:
                if slot.null_reason:
                    in_set = bound.declaration.triggers[index].access.each
                    pending.vanished(index, slot.entity, state, in_set=in_set)
                else:
                    pending.changed(index, slot.entity, state)
    return pending
