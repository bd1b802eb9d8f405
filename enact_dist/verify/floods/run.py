"""Measures one flood: a cell of its own, the honest client, the attacker, and a restart."""

from __future__ import annotations

import json
import signal
import tempfile
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from enact_dist.access.lock import Lock
from enact_dist.errors import EnactError
from enact_dist.terms import View
from enact_dist.verify.daemons import CellProcesses
from enact_dist.verify.floods.attacker import FIRST, SECOND
from enact_dist.verify.floods.victim import HELD, KEPT, WORLD
from enact_dist.world.connecting import connect

if TYPE_CHECKING:
    from collections.abc import Mapping

    from enact_dist.verify.floods.attacks import Attack

TTL_S: Final = 2.0
UPDATES: Final = 3000
P99_MS_MAX: Final = 10.0
"""Goal for the honest client, on a machine with nothing beside it."""
UPDATES_S: Final = 90.0
"""How long the honest client may take for all updates before it counts as stopped."""
STOP_S: Final = 30.0
VICTIM: Final = "enact_dist.verify.floods.victim"
ATTACKER: Final = "enact_dist.verify.floods.attacking"


@dataclass(slots=True)
class Figures:
    """What one flood came to.

    Attributes:
        name: Name of the attack.
        carrier: How the honest client's calls travel.
        updates: Updates of the honest client, committed and counted once each.
        p50_ms: Median of its updates.
        p99_ms: 99th percentile of its updates.
        longest_ms: The slowest one.
        newcomers_s: From `connect` to the first update, of each client that joined meanwhile.
        tally: Outcomes of the attacker's messages, by name.
        heard: Messages of others that it received.
        counters: The shard's, before it is stopped.
        restart_s: From the start of the daemon on the same folder until it serves; -1 if it does
            not.
        problems: What went wrong, in a sentence each; none if the shard stood the flood.
    """

    name: str
    carrier: str
    updates: int = 0
    p50_ms: float = 0.0
    p99_ms: float = 0.0
    longest_ms: float = 0.0
    newcomers_s: list[float] = field(default_factory=list)
    tally: dict[str, int] = field(default_factory=dict)
    heard: dict[str, int] = field(default_factory=dict)
    counters: dict[str, int] = field(default_factory=dict)
    restart_s: float = -1.0
    problems: list[str] = field(default_factory=list)

    @property
    def met(self) -> bool:
        """Whether the shard stood it, and the goal for the updates was kept."""
        return not self.problems and self.p99_ms <= P99_MS_MAX

    def as_json(self) -> dict[str, object]:
        """Return all of it, with the goal."""
        return {**asdict(self), "p99_ms_max": P99_MS_MAX, "met": self.met}


def measure(attack: Attack, *, carrier: str, updates: int = UPDATES) -> Figures:
    """Let one flood run beside so many updates of an honest client.

    Args:
        attack: The flood.
        carrier: How the honest client's calls travel: "socket" or "zenoh".
        updates: How many it makes.
    """
    figures = Figures(attack.name, carrier)
    shards = (FIRST, SECOND)[: attack.shards]
    with (
        tempfile.TemporaryDirectory(prefix="enact-flood-") as folder,
        CellProcesses(Path(folder), shards, pins={"**": FIRST}, ttl_s=TTL_S) as cell,
    ):
        for shard in shards:
            cell.start_shard(shard)
        try:
            _flood(attack, cell, figures, updates)
        except (EnactError, OSError) as error:
            figures.problems.append(str(error))
        try:
            _restart(cell, figures)
        except (EnactError, OSError) as error:
            figures.problems.append(f"after a restart: {error}")
    return figures


def _flood(attack: Attack, cell: CellProcesses, figures: Figures, updates: int) -> None:
    victim = cell.start_client(VICTIM, str(updates), figures.carrier)
    session = victim.expect("held")
    attacker = cell.start_client(ATTACKER, attack.name, session)
    attacker.expect("begun")
    victim.tell("go")
    try:
        seen = json.loads(victim.expect("updated", timeout_s=UPDATES_S))
        judge(figures, seen, updates)
        _health(cell, figures)
        victim.tell("end")
        kept = victim.expect("kept", timeout_s=STOP_S)
        if kept != "yes":
            figures.problems.append(f"the lock that was held all the time: {kept}")
    finally:
        attacker.tell("")
        told = json.loads(attacker.expect("told"))
        figures.tally, figures.heard = told["tally"], told["heard"]
        cell.end(attacker)
        cell.end(victim)
    judge_attacker(attack, figures)


def judge(figures: Figures, seen: Mapping[str, Any], updates: int) -> None:
    """Note what the honest client has seen, and each thing that it lost."""
    figures.updates = seen["done"]
    figures.p50_ms, figures.p99_ms = seen["p50_ms"], seen["p99_ms"]
    figures.longest_ms, figures.newcomers_s = seen["longest_ms"], seen["newcomers_s"]
    figures.problems += [f"honest client: {n} x {name}" for name, n in seen["failures"].items()]
    if seen["done"] != updates or seen["found"] != updates:
        figures.problems.append(
            f"{seen['done']} of {updates} updates were committed, the number counts {seen['found']}"
        )


def judge_attacker(attack: Attack, figures: Figures) -> None:
    """Record that the attacker received messages of others, or was never refused."""
    if figures.heard:
        figures.problems.append(f"the attacker heard {figures.heard}")
    if attack.expected and not attack.expected & figures.tally.keys():
        wanted = " or ".join(sorted(attack.expected))
        figures.problems.append(f"the attacker was not refused as {wanted}: {figures.tally}")


def _health(cell: CellProcesses, figures: Figures) -> None:
    """Ask, beside the flood, what `enact shard ls` asks."""
    with connect(cell.file, actor="operator", timeout_s=STOP_S) as looking:
        for shard in looking.shards():
            if not shard.reachable:
                figures.problems.append(f"shard {shard.name} cannot be listed: {shard.problem}")
            for name, value in shard.counters.items():
                figures.counters[name] = figures.counters.get(name, 0) + value


def _restart(cell: CellProcesses, figures: Figures) -> None:
    """Stop the shards and start them on the same folders; see what they have kept."""
    for name, daemon in list(cell.shards.items()):
        daemon.signal(signal.SIGTERM)
        if daemon.wait_status(STOP_S) is None:
            figures.problems.append(f"shard {name} does not stop within {STOP_S:g} s")
            daemon.kill()
    begun_s = time.monotonic()
    for name in list(cell.shards):
        cell.start_shard(name)
    with connect(cell.file, actor="operator", timeout_s=STOP_S) as looking:
        kept = View(looking.world(WORLD), HELD, KEPT)
        with Lock(kept, wait_s=STOP_S) as lock:
            found = lock.get(kept, 0)
        if not figures.problems and found != 1:
            figures.problems.append(f"after a restart the held datum is {found}, not 1")
    figures.restart_s = time.monotonic() - begun_s
