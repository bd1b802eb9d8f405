"""Benches in a cell that runs: what they make there goes at their end, and pushes nothing out.

World contexts that a run has made are dropped at its end, over a connection of its own, so that no
lock of the run stands in the way, however it ended.  Those that were there before stay, be it on
one shard alone: one that keeps nothing on disk forgets them when it restarts, the others do not.

At the cap of shared memory a shard lets its oldest history go for what is new.  That of the cell is
worth more than a figure: a bench for whose data there is no room under the cap is left out.
"""

from __future__ import annotations

import shlex
import time
from typing import TYPE_CHECKING, Final

from enact_dist.errors import EnactError, MisuseError
from enact_dist.world.forks import drop_world

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from enact_dist.world.cell import Cell
    from enact_dist.world.listings import ShardInfo

PEAK_BYTES: Final = {
    "layers": 60_000_000,
    "durable": 150_000_000,
    "fetch": 450_000_000,
    "publish": 700_000_000,
    "wakeup": 30_000_000,
    "history": 120_000_000,
    "pipeline": 200_000_000,
    "stopped": 70_000_000,
}
"""What the large data of a bench take at most of the shared memory of one shard: measured, and a
quarter more.  Drafts are in it, what is replaced and what takes a moment to leave.  Other benches
have none."""
UNLOCKED_S: Final = 10.0
"""A worker that was killed is a holder for a lease's time."""
PAUSE_S: Final = 0.1


class Visit:
    """The world contexts that a run uses in a cell that runs.

    Args:
        target: What the cell is called.
        connected: Joins it anew.
        said: Called with what a person should know.
    """

    def __init__(
        self, target: str, *, connected: Callable[[], Cell], said: Callable[[str], None]
    ) -> None:
        self._target, self._connected, self._said = target, connected, said
        self._made: dict[str, bool] = {}

    def uses(self, cell: Cell, name: str) -> None:
        """Note, before it is made, whether a world context is there already."""
        if name not in self._made:
            self._made[name] = not anywhere(cell, name)

    def leave(self) -> None:
        """Drop what was made; say what stays, and how to drop it."""
        if not self._made:
            return
        left = dict(self._made)
        try:
            with self._connected() as cell:
                for name, made in self._made.items():
                    there = anywhere(cell, name)
                    if there and made:
                        _drop(cell, name)
                    if made or not there:
                        del left[name]
            why = "was there before this run and stays"
        except EnactError as error:
            why = f"may still be there: {error}"
        except BaseException:
            self._stay(left, "may still be there")
            raise
        self._stay(left, why)

    def _stay(self, names: dict[str, bool], why: str) -> None:
        cell = shlex.quote(self._target)
        for name in names:
            self._said(
                f"world context {name!r} {why}; `enact world drop {name} --cell {cell}` drops it"
                " with all its data"
            )


def anywhere(cell: Cell, name: str) -> bool:
    """Whether any shard has a world context, or a part of one, of that name.

    Raises:
        ShardUnreachableError: A shard does not answer.
    """
    cell.worlds()  # greets every shard, but lists only what all of them have
    return bool(cell._client.worlds_at(name))  # noqa: SLF001 - as each shard has just said


def _drop(cell: Cell, name: str) -> None:
    """Drop a world context, after the locks of processes that have just ended."""
    deadline_s = time.monotonic() + UNLOCKED_S
    while True:
        try:
            drop_world(cell._session, name)  # noqa: SLF001 - whatever lock this thread was interrupted in
        except MisuseError:
            if time.monotonic() >= deadline_s:
                raise
            time.sleep(PAUSE_S)
        else:
            return


# ---------------------------------------------------------------- room


def without_room(shards: Sequence[ShardInfo], names: Sequence[str]) -> dict[str, str]:
    """Return which of some benches would push history out, and why, in their order."""
    refused: dict[str, str] = {}
    taken = 0
    capped = [shard for shard in shards if shard.counters.get("payload_bytes_max")]
    for name in names:
        peak = PEAK_BYTES.get(name, 0)
        tight = [shard for shard in capped if peak and _room(shard) < taken + peak]
        if not tight:
            taken += peak
            continue
        least = min(tight, key=_room)
        cap = least.counters["payload_bytes_max"]
        before = f", and benches before it take up to {_mb(taken)}" if taken else ""
        refused[name] = (
            f"{name} writes up to {_mb(peak)} of large data, and shard {least.name} has"
            f" {_mb(_room(least))} left of its cap of {_mb(cap)}{before}: its oldest history would"
            " go; raise shared_bytes_max, or measure a cell of the bench's own (without --connect)"
        )
    return refused


def _room(shard: ShardInfo) -> int:
    used, cap = (shard.counters.get(f"payload_{name}", 0) for name in ("bytes", "bytes_max"))
    return max(0, cap - used)


def _mb(size_bytes: int) -> str:
    return f"{size_bytes / 1e6:.0f} MB"
