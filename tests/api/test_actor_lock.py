"""The lock of an update takes what the actor declares, in each of its methods."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from enact_dist.access.lock import Lock
from enact_dist.access.trigger import Triggered
from enact_dist.actor.actor import Actor
from enact_dist.actor.binding import BoundActor, joined
from enact_dist.errors import MisuseError, ReadonlyError
from enact_dist.terms import Aspect, Entities, Entity, Read, View, World, Write
from enact_dist.world.connecting import local

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from enact_dist.actor.lock import ActorLock

pytestmark = pytest.mark.carrier("local", "drawn")

VIEWS, A, PANEL = Entities("view/*"), Entity("view/a"), Entity("panel")
CLOUD, SURFACE = Aspect("cloud", np.ndarray), Aspect("surface", np.ndarray)
LIMIT, COUNT = Aspect("limit", float), Aspect("count", int)
NUMBERS = np.arange(3.0)


class Meshing(Actor):
    """Declares a pattern that stands for the triggering entity, and data of fixed entities."""

    model = World("model")
    cloud = View(model, VIEWS, CLOUD)
    surface = Write(model, VIEWS, SURFACE)
    limit = Read(model, PANEL, LIMIT)
    count = Write(model, PANEL, COUNT)
    triggers = (cloud,)

    def update(self, lock: Lock) -> None:
        """Do nothing: the test takes the lock by itself."""


def put(lock: ActorLock) -> None:
    lock.put(Meshing.surface, NUMBERS, stamp_ns=7)
    assert lock.get(Meshing.surface).sum() == 3.0


def new(lock: ActorLock) -> None:
    filled = lock.new(Meshing.surface, (3,), np.float64)
    filled[:] = NUMBERS
    assert lock[Meshing.surface].sum() == 3.0


def assign(lock: ActorLock) -> None:
    lock[Meshing.count] = 4
    assert lock[Meshing.count] == 4


def delete(lock: ActorLock) -> None:
    lock[Meshing.count] = 4
    del lock[Meshing.count]
    assert lock.is_null(Meshing.count)


CALLS: dict[str, Callable[[ActorLock], Any]] = {
    "__getitem__": lambda lock: lock[Meshing.limit] == 0.5,
    "__setitem__": assign,
    "__delitem__": delete,
    "get": lambda lock: lock.get(Meshing.limit) == 0.5,
    "put": put,
    "new": new,
    "expect": lambda lock: lock.expect(Meshing.cloud),
    "is_null": lambda lock: lock.is_null(Meshing.surface),
    "version": lambda lock: lock.version(Meshing.cloud) == 1,
    "stamp_ns": lambda lock: lock.stamp_ns(Meshing.cloud) == 11,
}
WITHOUT_REQUEST = {
    "check", "entity", "missing", "newer", "running", "statistics", "tick_ns", "token", "valid"
}  # fmt: skip
INDEXING = {"__getitem__", "__setitem__", "__delitem__"}


@pytest.fixture
def bound() -> Iterator[BoundActor]:
    """The actor with its role `model` bound to the world context `training`."""
    with local(worlds=["training"]) as cell:
        training = cell.world("training")
        training.init(PANEL, LIMIT, 0.5)
        with Lock(Write(training, A, CLOUD)) as lock:
            lock.put(Write(training, A, CLOUD), NUMBERS, stamp_ns=11)
        yield BoundActor(Meshing(), cell, {"model": "training"})


def test_each_public_method_of_a_lock_is_called_here():
    """A method that comes to be has to say here how an actor calls it."""
    public = {name for name in {**vars(Triggered), **vars(Lock)} if name[0] != "_"}
    assert public | INDEXING == set(CALLS) | WITHOUT_REQUEST


@pytest.mark.parametrize("method", CALLS)
def test_method_takes_a_declared_request_of_a_pattern_and_a_renamed_role(bound, method):
    """The pattern stands for the triggering entity, the role for the context it is bound to."""
    with bound.lock(A) as lock:
        assert CALLS[method](lock) in (None, True)


def test_declared_request_that_only_reads_is_refused_where_it_would_write(bound):
    """The error names the datum of this update, not the role."""
    with bound.lock(A) as lock, pytest.raises(ReadonlyError, match=r"training.*panel"):
        lock.new(Meshing.limit, (3,))


def test_an_actor_may_be_a_dataclass_that_compares_by_value() -> None:
    """Such a one cannot be hashed; two equal ones run in cells of their own."""

    @dataclass
    class Counting(Meshing):
        step: int = 1

    with local(worlds=["model"]) as one, local(worlds=["model"]) as other:
        first, second = Counting(), Counting()
        BoundActor(first, one, {"model": "model"})
        BoundActor(second, other, {"model": "model"})
        assert (joined(first).cell, joined(second).cell) == (one, other)


def test_an_actor_knows_its_cell_for_what_is_done_beside_its_lock() -> None:
    """It forks the context that a role is bound to, in another thread; before it runs it cannot."""
    actor = Meshing()
    with pytest.raises(MisuseError, match="Meshing runs in no cell yet"):
        joined(actor)
    with local(worlds=["other"]) as cell:
        BoundActor(actor, cell, {"model": "other"})
        where = joined(actor)
        assert where.cell is cell
        where.worlds["model"].fork("what_if")
        assert set(cell.worlds()) == {"other", "what_if"}
