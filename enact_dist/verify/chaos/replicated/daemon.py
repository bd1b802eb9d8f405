"""A shard daemon that tells when it takes its shard over, and when it lets answers out.

``python -m enact_dist.verify.chaos.replicated.daemon AHEAD_NS ANSWERS shard run NAME …``; it says
``fenced EPOCH NS`` once the shard is its own, with the time at which it asked the database for it.
What it does is what `enact` does.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from enact_dist.cli import main
from enact_dist.core.protocol.records import Effect, LogEvent, Persist
from enact_dist.link.lease import AnswerGate
from enact_dist.link.postgres import opening
from enact_dist.link.postgres.address import FreeShard
from enact_dist.verify.chaos.replicated.answers import AnswerTimes

MODULE: Final = "enact_dist.verify.chaos.replicated.daemon"
FENCED: Final = "fenced "
_INSIDE: Final = (Persist, LogEvent)
"""Effects that reach no client and no other shard."""


def watch(times: AnswerTimes, now_ns: Callable[[], int]) -> None:
    """Let this process take note of its takeover and of its answers."""
    take_over, passing = opening.take_over, AnswerGate.passing

    def taken(free: FreeShard, *, unix_s: int) -> opening.HeldShard:
        sent_ns = now_ns()
        held = take_over(free, unix_s=unix_s)
        times.serves(held.epoch)
        print(f"{FENCED}{held.epoch} {sent_ns}", flush=True)
        return held

    def passed(gate: AnswerGate, effects: Sequence[Effect]) -> Sequence[Effect]:
        # Taken before the lease is looked at: what comes between the two delays the answer only.
        asked_ns = now_ns()
        found = passing(gate, effects)
        if any(type(effect) not in _INSIDE for effect in found):
            times.add(asked_ns)
        return found

    opening.__dict__["take_over"] = taken
    AnswerGate.passing = passed  # type: ignore[method-assign, assignment]


def run(words: Sequence[str]) -> int:
    """Run `enact` with `words[2:]`; see the module for the others."""
    ahead_ns = int(words[0])
    watch(AnswerTimes(Path(words[1])), lambda: time.monotonic_ns() - ahead_ns)
    return main.main(words[2:])


if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
