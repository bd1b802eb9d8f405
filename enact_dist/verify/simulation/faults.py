"""What may go wrong in a run.  A seed draws one set of options; a test may give its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from random import Random


@dataclass(frozen=True, slots=True)
class Faults:
    """Rates are per simulated second of the whole cell, shares lie between 0 and 1."""

    loss: float = 0.0
    """Share of messages that vanish."""
    duplication: float = 0.0
    """Share of messages that arrive twice."""
    delay: float = 0.0
    """Share of messages that are late, by 0.8 s on average; they are overtaken then."""
    late_answers: float = 0.0
    """Share of answers that are delivered although their caller has given up on the call."""
    triggered: float = 0.0
    """Share of decisive messages and disk writes that set off a fault at that very moment."""
    at_decision: float = 0.0
    """Share of commits over shards at which one of the shards dies, just before or just after."""
    crashes_per_s: float = 0.0
    """Shards that die and start again."""
    power_cut: float = 0.0
    """Share of crashes that also lose what was written but not synced, from any record on."""
    kills_per_s: float = 0.0
    """Client processes that are killed; another one starts in their place."""
    pauses_per_s: float = 0.0
    """Processes that stand still for up to seven TTLs while their messages queue up."""
    stalls_per_s: float = 0.0
    """Shards whose dispatcher is stuck for up to three TTLs while their disk goes on."""
    suspended: float = 0.0
    """Share of pauses of a shard in which its steady clock stands still too (a suspended host)."""
    busy: float = 0.0
    """Share of pauses of a client in which its liveliness token stays (a held interpreter lock)."""
    tokens: bool = True
    """Whether shards see liveliness tokens; without them keep-alives alone renew."""
    starves_per_s: float = 0.0
    """Clients that send no keep-alive for up to 10 s, because the thread that does it starves."""
    partitions_per_s: float = 0.0
    """Links that are cut for a while, in one direction or in both."""
    slow_disk: float = 0.0
    """Share of disk batches that take up to half a second."""
    drift_ppm: int = 0
    """Largest rate error of a clock, in millionths; 10,000 is the 1 % that the core assumes."""
    wall_jumps_per_s: float = 0.0
    """Wall clocks that are set forward or back."""
    wall_jump_s: float = 0.0
    """How far they are set at most."""


NONE = Faults()
"""Nothing goes wrong."""


def drawn(random: Random, *, shards: int) -> Faults:
    """Draw the faults of one run.

    Over several shards wall clocks stay within the second that stamps may differ by: beyond it
    commits are refused by design.
    """
    if random.random() < 0.05:
        return NONE
    loss, duplication, delay = random.choice(
        ((0.0, 0.0, 0.0), (0.02, 0.02, 0.02), (0.05, 0.1, 0.05), (0.15, 0.1, 0.1))
    )
    return Faults(
        loss=loss,
        duplication=duplication,
        delay=delay,
        late_answers=random.choice((0.0, 0.5)),
        triggered=random.choice((0.0, 0.005, 0.02, 0.05)),
        at_decision=random.choice((0.0, 0.0, 0.03, 0.1)) if shards > 1 else 0.0,
        crashes_per_s=random.choice((0.0, 0.1, 0.4)),
        power_cut=random.choice((0.0, 0.5, 1.0)),
        kills_per_s=random.choice((0.0, 0.1)),
        pauses_per_s=random.choice((0.0, 0.2, 0.5)),
        busy=random.choice((0.0, 0.5)),
        tokens=random.random() < 0.6,
        stalls_per_s=random.choice((0.0, 0.0, 0.2)),
        suspended=random.choice((0.0, 0.3)),
        starves_per_s=random.choice((0.0, 0.0, 0.2, 0.6)),
        partitions_per_s=random.choice((0.0, 0.2)),
        slow_disk=random.choice((0.0, 0.05)),
        drift_ppm=random.choice((0, 9_900)),
        wall_jumps_per_s=random.choice((0.0, 0.2)),
        wall_jump_s=3600.0 if shards == 1 else 0.3,
    )
