"""The benches of `enact bench`: their names, and what its help says of each."""

from __future__ import annotations

from typing import Final, NamedTuple


class BenchHelp(NamedTuple):
    """What `--help` says of a bench.

    Attributes:
        alone: Whether it can be `--embedded`: within one process.
        guest: Whether it can `--connect` to a cell that runs.
        minutes: Whether it takes more than a minute with the measuring time that is usual.
        named: Whether it runs only where it is named: it needs an extra.
    """

    what: str
    alone: bool = True
    guest: bool = True
    minutes: bool = False
    named: bool = False


BENCHES: Final = {
    "floor": BenchHelp(
        "the machine and the bare transports: Zenoh, Unix socket, memory, disk", minutes=True
    ),
    "core": BenchHelp("a shard's decisions alone: a lock and its commit, hand-over among 1,000"),
    "update": BenchHelp(
        "lock, read, write, release, by durability, over each carrier", minutes=True
    ),
    "layers": BenchHelp(
        "where the time of an update, a fetch and a wake-up goes, layer by layer", minutes=True
    ),
    "multi": BenchHelp("up to 32 slots in a lock, 8 threads side by side, slots on several shards"),
    "durable": BenchHelp("commits that survive a power cut: one, from several threads, of 10 MB"),
    "waiters": BenchHelp(
        "hand-over of a slot to 2 to 32 waiting threads; updates of 1 and 4 clients", alone=False
    ),
    "fetch": BenchHelp(
        "reading arrays of 1 kB to 100 MB, seen before, new, from afar", minutes=True
    ),
    "publish": BenchHelp(
        "writing arrays of 1 kB to 100 MB, and committing what was filled in place"
    ),
    "wakeup": BenchHelp("from a commit in one process to its array in another", alone=False),
    "history": BenchHelp(
        "what kept versions cost an update; looks at the past, forks, 8 cameras whose history"
        " fills memory (not with --connect)",
        minutes=True,
    ),
    "pipeline": BenchHelp(
        "17 processes: 8 cameras at 10 Hz, 8 workers, a reader of whole sets",
        alone=False,
        minutes=True,
    ),
    "stopped": BenchHelp("updates beside a reader of 50 MB that stands still", alone=False),
    "memory": BenchHelp("a daemon's memory per slot and per commit", alone=False, guest=False),
    "recovery": BenchHelp(
        "how soon locks are back after a holder or a shard was killed",
        alone=False,
        guest=False,
        minutes=True,
    ),
    "security": BenchHelp(
        "what keys and rights cost a call, an update and large data; needs the extra 'keys'",
        alone=False,
        guest=False,
        named=True,
    ),
    "view": BenchHelp(
        "`enact view` of 8 cameras, a hull and two robots at 10 Hz: updates shown, what one costs,"
        " the cell with and without it; needs the extra 'view'",
        alone=False,
        guest=False,
        minutes=True,
        named=True,
    ),
    "workcell": BenchHelp(
        "eight cameras, hull, speed and path of `enact demo workcell`, scored on its truth;"
        " --embedded plays twelve scenarios in simulated time, which no load changes, for its"
        " quality alone",
        guest=False,
        minutes=True,
        named=True,
    ),
    "palletizing": BenchHelp(
        "robot, gripper and depth sensors pack --packages in simulated physics and time, scored on"
        " what physics did: placements, verdicts by kind, recoveries, damage, cycle",
        guest=False,
        minutes=True,
        named=True,
    ),
}
"""The benches, in the order in which they run and stand in the table."""
