"""What a refused program is told: which datum, who, from when on, and what to do instead."""

import os
import threading
from dataclasses import dataclass

import numpy as np
import pytest

from enact_dist import (
    Aspect,
    Difference,
    Entities,
    Entity,
    Lock,
    View,
    ViewEach,
    Write,
    WriteEach,
    testing,
)
from enact_dist.core.protocol.datum import Position
from enact_dist.errors import (
    ChangedError,
    DatumTypeError,
    ForgottenError,
    LeaseLostError,
    LockTimeoutError,
)

SPEED = Aspect("speed", float)
NAME = Aspect("name", str)
COUNT = Aspect("count", int, retention=2)
robot = Entity("robot")


@dataclass(frozen=True)
class Scan:
    points_m: np.ndarray
    count: int


SCAN = Aspect("scan", Scan)


def write_times(world, entity: Entity, times: int) -> Position:
    """Write a count several times; return the position of the first."""
    write, first = Write(world, entity, COUNT), None
    for number in range(times):
        with Lock(write) as lock:
            lock[write] = number
        first = first or lock.position
    return first


def test_datum_of_another_type_names_its_slot(online):
    """Of several writes the one that does not fit is named: by request, pattern and `new`."""
    speed, name = Write(online, robot, SPEED), Write(online, robot, NAME)
    scan, each = Write(online, robot, SCAN), WriteEach(online, Entities("cup/*"), SPEED)
    with Lock(speed, name, scan, each) as lock:
        lock[name] = "fine"
        with pytest.raises(DatumTypeError, match=r"^online:robot/speed is not set: float: asked"):
            lock[speed] = "fast"
        with pytest.raises(DatumTypeError, match=r"^online:cup/1/speed is not set: float: asked"):
            lock[each][Entity("cup/1")] = "fast"
        with pytest.raises(DatumTypeError, match=r"^online:robot/scan is not set: "):
            lock.new(scan, {"points_m": 3})


def test_lock_held_too_long_is_told_to_raise_its_limit():
    """Redoing the same work would end in the same way, and is not advised."""
    clock = testing.ManualClock()
    with testing.worlds("online", clock=clock) as cell:
        speed = Write(cell.world("online"), robot, SPEED)
        with pytest.raises(LeaseLostError) as lost, Lock(speed, hold_s=5.0) as lock:
            lock[speed] = 2.0
            clock.advance(6.0)
    assert "held longer than its limit of 5 s" in str(lost.value)
    assert "raise hold_s, or shorten the block" in str(lost.value)
    assert "redo the work" not in str(lost.value)


@pytest.mark.parametrize("order", [("left", "right"), ("right", "left")])
def test_forgotten_says_from_when_on_all_of_it_is_known(two_shards, loose, order):
    """Whoever follows it asks again once: over all shards, for a view and a fork."""
    online = two_shards.cell.world("online")
    firsts = [write_times(online, Entity(f"{side}/box"), 5) for side in order]
    loose.end()
    for side in order:
        write_times(online, Entity(f"{side}/box"), 2)
    then = firsts[0]
    past = online.at(then)
    with pytest.raises(ForgottenError) as viewed:
        past.view(ViewEach(past, Entities("**"), COUNT))
    with pytest.raises(ForgottenError) as forked:
        online.fork("copy", at=then)

    for error in (viewed.value, forked.value):
        assert "everything requested is known from" in str(error)
        later = online.at(Position(error.oldest_ns, then.shard))
        found = later.view(every := ViewEach(later, Entities("**"), COUNT))[every]
        assert len(found) == 2
    copy = online.fork("copy", at=Position(forked.value.oldest_ns, then.shard))
    assert len(copy.entities()) == 2


def test_fork_that_would_miss_a_kept_version_is_told_a_moment_that_has_all(cell, online, loose):
    """What a label keeps is known as of then, and may be unknown just after."""
    a, b = Entity("a"), Entity("b")
    write_times(online, a, 1)
    cell.pin("first", online.history(a, COUNT))
    then = write_times(online, b, 1)
    write_times(online, a, 1)
    write_times(online, b, 2)
    write_times(online, a, 3)
    loose.end()
    write_times(online, b, 1)
    write_times(online, a, 1)
    with pytest.raises(ForgottenError) as refused:
        online.fork("copy", at=then)

    fork = online.fork("copy", at=Position(refused.value.oldest_ns, then.shard))
    assert len(fork.entities()) == 2


def test_changed_view_says_who_changed_it_and_what_to_do(online):
    """The version that was committed instead, by whom, and a remedy."""
    online.init(robot, SPEED, 1.0)
    view, name = View(online, robot, SPEED), Write(online, robot, NAME)
    other = Write(online, robot, SPEED)

    def slip_in() -> None:
        with Lock(other) as beside:
            beside[other] = 2.0

    with pytest.raises(ChangedError) as changed, Lock(view, name) as lock:
        lock.expect(view)
        lock[name] = "x"
        thread = threading.Thread(target=slip_in)
        thread.start()
        thread.join()
    text = str(changed.value)
    assert "has moved on to version 2" in text
    assert f" pid {os.getpid()}; nothing was written" in text
    assert "take the lock again" in text
    assert "Read" in text


def test_view_that_is_about_to_be_written_is_told_as_such(two_shards):
    """Where another lock holds the expected slot for writing there is no version to name yet."""
    online, left, right = two_shards.cell.world("online"), Entity("left/arm"), Entity("right/arm")
    online.init(left, SPEED, 1.0)
    view, name = View(online, left, SPEED), Write(online, left, NAME)
    held, done = threading.Event(), threading.Event()

    def hold() -> None:
        with Lock(Write(online, left, SPEED), Write(online, right, SPEED)):
            held.set()
            done.wait(60.0)

    holder = threading.Thread(target=hold)
    try:
        told = pytest.raises(ChangedError, match="is about to be written; nothing was")
        with told, Lock(view, name) as lock:
            lock.expect(view)
            lock[name] = "x"
            holder.start()
            assert held.wait(60.0)
    finally:
        done.set()
        holder.join()


def test_view_that_finds_no_moment_waits_for_locks_and_says_who_holds_them(two_shards, monkeypatch):
    """Read locks stand in for a cut; a view has no `wait_s` to raise."""
    cell = two_shards.cell
    online, left, right = cell.world("online"), Entity("left/arm"), Entity("right/arm")
    held, done = threading.Event(), threading.Event()
    monkeypatch.setattr("enact_dist.core.client.lock.ROUNDS_MAX", 0)
    monkeypatch.setattr("enact_dist.core.client.cut.Cut.settled", lambda *_, **__: None)
    monkeypatch.setattr(cell._client, "request_timeout_s", 1.0)

    def hold() -> None:
        with Lock(Write(online, left, SPEED)):
            held.set()
            done.wait(60.0)

    holder = threading.Thread(target=hold)
    holder.start()
    try:
        assert held.wait(60.0)
        with pytest.raises(LockTimeoutError, match=r"left/arm/speed \(write\) held by") as told:
            online.view(View(online, left, SPEED), View(online, right, SPEED))
    finally:
        done.set()
        holder.join()
    assert str(told.value).endswith("try again, or raise request_timeout_s of connect(…)")
    assert len(told.value.holders) == 1


def test_excess_over_a_tolerance_is_not_rounded_away():
    """Two figures that differ are shown with as many digits as that takes."""
    assert "0.05 m apart (0.05 m" not in str(Difference(0.0500001, 0.05, crossed=True, unit="m"))
    assert str(Difference(0.0500001, 0.05, crossed=True, unit="m")) == (
        "0.0500001 m apart (0.05 m allowed)"
    )
    assert str(Difference(3.0, 0.5, crossed=True, unit="mm")) == "3 mm apart (0.5 mm allowed)"
    assert str(Difference(0.049999999, 0.05)) == "0.05 apart (0.05 allowed)"
