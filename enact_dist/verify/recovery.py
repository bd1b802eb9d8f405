"""How long locks are away after something died: real daemons, real clients, SIGKILL.

======================  =========================================  ==============================
figure                  from                                       to
======================  =========================================  ==============================
restart, all alive      the start of the new daemon's process      a waiting client's grant
restart, one dead       the moment in which it serves again        a waiting client's grant
holder killed           the signal that kills the holder           a waiting client's grant
in doubt                the end of a client that had prepared      a grant on both shards
======================  =========================================  ==============================

With one client dead a restarted shard has to outwait the lease that the dead one may still believe
in, and 2 % of it for clocks that differ, counted from its own start: nothing older tells it when
its predecessor ended.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from enact_dist.cli.text.output import print_json, print_table
from enact_dist.cli.verbs import DONE, FAILED
from enact_dist.verify.daemons import CellProcesses, LineProcess

TTL_S: Final = 2.0
ROUNDS: Final = 5
CLIENT: Final = "enact_dist.verify.recovery_client"
SHARD: Final = "left"
RESTARTED: Final = "shard restarted, all clients alive"
KILLED_FAR: Final = "holder killed, seen over a network"
KILLED_NEAR: Final = "holder killed on the shard's host"
PINS: Final = {"left": "left", "right": "right"}


@dataclass(frozen=True, slots=True)
class RecoveryFigure:
    """One figure with its goal; times in seconds, smallest first."""

    name: str
    times_s: tuple[float, ...]
    goal_s: float

    def share_s(self, share: float) -> float:
        """Return the time that a share of the rounds stayed at or below."""
        return self.times_s[min(len(self.times_s) - 1, int(len(self.times_s) * share))]

    @property
    def met(self) -> bool:
        """Whether 99 of 100 rounds, all below a hundred, kept the goal."""
        return self.share_s(0.99) <= self.goal_s

    def as_json(self) -> dict[str, object]:
        """Return the figure with every single time, in seconds."""
        return {
            "name": self.name,
            "rounds": len(self.times_s),
            "p50_s": self.share_s(0.5),
            "p99_s": self.share_s(0.99),
            "max_s": self.times_s[-1],
            "goal_s": self.goal_s,
            "met": self.met,
            "times_s": self.times_s,
        }

    def as_row(self) -> tuple[object, ...]:
        """Return the figure as a line of a table."""
        p50, p99, longest, goal = (
            f"{value_s:.3f} s"
            for value_s in (self.share_s(0.5), self.share_s(0.99), self.times_s[-1], self.goal_s)
        )
        return self.name, len(self.times_s), p50, p99, longest, goal, "yes" if self.met else "NO"


def measure(
    rounds: int = ROUNDS,
    *,
    ttl_s: float = TTL_S,
    only: Sequence[str] = (),
    say: Callable[[str], None] = lambda _: None,
) -> list[RecoveryFigure]:
    """Measure all figures, `rounds` times each.

    Args:
        rounds: How often something is killed per figure.
        ttl_s: Session TTL of the cell.
        only: Names of the figures; none means all.
        say: Takes one line per figure as it begins.

    Raises:
        LinkError: A process ended or hung; the message quotes its log.
    """
    measured = []
    for name, carrier, shards, goal_s, run in (
        (RESTARTED, "auto", (SHARD,), 0.5, _all_alive),
        ("shard restarted, one client dead", "auto", (SHARD,), ttl_s + 0.1, _one_dead),
        (KILLED_FAR, "zenoh", (SHARD,), ttl_s + 0.1, _holder_killed),
        (KILLED_NEAR, "auto", (SHARD,), 0.1, _holder_killed),
        ("client killed in doubt", "auto", ("left", "right"), 2 * ttl_s, _in_doubt),
    ):
        if only and name not in only:
            continue
        say(f"{name}: {rounds} rounds")
        pins = {entity: shard if shard in shards else SHARD for entity, shard in PINS.items()}
        with (
            tempfile.TemporaryDirectory(prefix="enact-recovery-") as folder,
            CellProcesses(Path(folder), shards, pins=pins, ttl_s=ttl_s, carrier=carrier) as cell,
        ):
            for shard in shards:
                cell.start_shard(shard)
            _client(cell, "stay", "staying")
            asker = _client(cell, "ask", "ready")
            times_s = [run(cell, asker) for _ in range(rounds)]
        measured.append(RecoveryFigure(name, tuple(sorted(times_s)), goal_s))
    return measured


def run(arguments: argparse.Namespace) -> int:
    """Measure and print all figures; status 1 if one missed its goal.

    Raises:
        LinkError: A process ended or hung.
    """
    figures = measure(arguments.rounds, say=_say)
    if arguments.json:
        print_json([figure.as_json() for figure in figures])
    else:
        print_table(
            ("after", "rounds", "p50", "p99", "longest", "goal", "met"),
            [figure.as_row() for figure in figures],
            empty="nothing measured",
        )
    return DONE if all(figure.met for figure in figures) else FAILED


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _client(cell: CellProcesses, role: str, word: str) -> LineProcess:
    client = cell.start_client(CLIENT, role)
    client.expect(word)
    return client


def _granted_s(asker: LineProcess) -> float:
    granted_s = float(asker.expect("granted"))
    asker.expect("done")
    return granted_s


def _all_alive(cell: CellProcesses, asker: LineProcess) -> float:
    cell.shards[SHARD].kill()
    asker.tell("ask")
    asker.expect("asking")
    daemon = cell.start_shard(SHARD)
    return _granted_s(asker) - daemon.started_s


def _one_dead(cell: CellProcesses, asker: LineProcess) -> float:
    dead = _client(cell, "stay", "staying")
    dead.kill()
    cell.shards[SHARD].kill()
    asker.tell("ask")
    asker.expect("asking")
    daemon = cell.start_shard(SHARD)
    granted_s = _granted_s(asker)
    cell.end(dead)
    return granted_s - daemon.ready_s


def _holder_killed(cell: CellProcesses, asker: LineProcess) -> float:
    holder = _client(cell, "hold", "holding")
    asker.tell("ask")
    asker.expect("asking")
    killed_s = holder.kill()
    granted_s = _granted_s(asker)
    cell.end(holder)
    return granted_s - killed_s


def _in_doubt(cell: CellProcesses, asker: LineProcess) -> float:
    client = cell.start_client(CLIENT, "vanish")
    client.expect("vanishing")
    killed_s = client.wait_ended()
    asker.tell("ask")
    granted_s = _granted_s(asker)
    cell.end(client)
    return granted_s - killed_s
