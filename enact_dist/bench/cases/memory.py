"""Bench `memory`: what one slot costs a shard beside its payload, and one commit for good.

Its daemon has served nothing before: a process does not show which freed memory it uses.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

from enact_dist.access.lock import Lock
from enact_dist.bench.place import Place, fresh_place
from enact_dist.bench.rows import Row, value_row
from enact_dist.bench.usage import private_bytes, slope
from enact_dist.terms import Aspect, Durability, Entity, Write

if TYPE_CHECKING:
    from enact_dist.bench.run import Run

SLOTS_PER_S: Final = 7_000
"""Slots that are made per second of measuring time: 21,000 by default."""
SLOTS_MIN: Final = 2_000
AT_ONCE: Final = 100
SETTLE_S: Final = 4.0
"""For so long replaced states are kept, and with them what a commit takes for a moment."""
SAMPLES: Final = 24
SLOT_BYTES_MAX: Final = 2_000
COMMIT_BYTES_MAX: Final = 16.0
"""What noise may look like: an outcome or a record that stayed would be hundreds of bytes."""
COUNT: Final = Aspect("memory_count", int, Durability.VOLATILE)
WAIT_S: Final = 30.0


def run_memory(run: Run) -> None:
    """Slots that hold a number, then commits over and over to some of them."""
    with fresh_place(run.place.carrier) as (place, _):
        _measure(run, place)


def _measure(run: Run, place: Place) -> None:
    world = place.world(place.carrier)
    (pid,) = place.daemon_pids()[:1]
    shard = place.shard_names[0]
    wanted = max(SLOTS_MIN, int(SLOTS_PER_S * run.seconds_s))
    wanted -= wanted % AT_ONCE
    writes = [Write(world, Entity(f"{shard}/memory/{n}"), COUNT) for n in range(wanted + AT_ONCE)]
    _write(writes[:AT_ONCE])  # whatever comes once
    time.sleep(SETTLE_S)
    before = private_bytes(pid)
    for first in range(AT_ONCE, len(writes), AT_ONCE):
        run.told(f"memory: {first} slots")
        _write(writes[first : first + AT_ONCE])
    time.sleep(SETTLE_S)
    per_slot = (private_bytes(pid) - before) / wanted
    run.add_row(
        value_row(
            "memory",
            "shard, one slot that holds a number",
            round(per_slot),
            "bytes",
            wanted,
            "≤ 2 kB",
            met=per_slot <= SLOT_BYTES_MAX,
            note=f"the daemon has {private_bytes(pid) / 1e6:.1f} MB",
        )
    )
    run.add_row(_commits_row(run, pid, writes[:4]))


def _commits_row(run: Run, pid: int, writes: list[Write[int]]) -> Row:
    commits = 0
    points: list[tuple[float, float]] = []
    total_s = SETTLE_S + run.seconds_s
    begin_s = time.perf_counter()
    while (passed_s := time.perf_counter() - begin_s) < total_s or len(points) < 2:
        _write(writes[commits % 4 : commits % 4 + 1])
        commits += 1
        due_s = SETTLE_S + len(points) * run.seconds_s / SAMPLES
        if passed_s >= due_s:
            run.told(f"memory: {commits} commits")
            points.append((float(commits), float(private_bytes(pid))))
    grown = slope(points)
    return value_row(
        "memory",
        "shard, growth with commits",
        round(grown, 2) + 0.0,
        "bytes/commit",
        commits,
        f"none (≤ {COMMIT_BYTES_MAX:g} bytes)",
        met=grown <= COMMIT_BYTES_MAX,
    )


def _write(writes: list[Write[int]]) -> None:
    with Lock(*writes, wait_s=WAIT_S) as lock:
        for write in writes:
            lock[write] = 1
