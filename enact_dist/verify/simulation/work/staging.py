"""Large data that clients bring in slices before their commit, on a bad network."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.datum import Datum
from enact_dist.core.protocol.messages import Stage, Staged
from enact_dist.verify.simulation.hosts.client_host import (
    ClientNode,
    ParallelCalls,
    Sleep,
    Steps,
    Thread,
)
from enact_dist.verify.simulation.hosts.payloads import DRAFT_NS
from enact_dist.wire.limits import PAYLOAD_BYTES_MIN

if TYPE_CHECKING:
    from random import Random

    from enact_dist.core.protocol.messages import WriteItem
    from enact_dist.verify.simulation.hosts.world import SimulatedWorld

SLICES: Final = 3
TRIES: Final = 8
RARE_NS: Final = DRAFT_NS * 2 // 3
"""Slices that come so seldom keep their draft."""


class Stager:
    """Brings large data to their shards before their commit."""

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world
        self._made = 0

    def staged(
        self,
        host: ClientNode,
        shard: str,
        writes: list[WriteItem],
        luck: Random,
        *,
        rests_ns: int = 0,
    ) -> Steps[list[WriteItem]]:
        """Return writes that name what was staged; of some, that only a part or nothing was.

        With `rests_ns` all is staged, with so long a rest after the first slice.
        """
        found: list[WriteItem] = []
        for write in writes:
            datum = write.datum
            small = datum is None or datum.size <= PAYLOAD_BYTES_MIN
            if small or (not rests_ns and luck.random() < 0.2):
                found.append(write)
                continue
            assert datum is not None
            file = self._new_name(host)
            hasty = not rests_ns and luck.random() < 0.2
            tries = luck.randrange(SLICES) if hasty else TRIES
            whole = yield from self._stage(host, shard, file, datum, tries=tries, rests_ns=rests_ns)
            named = whole or hasty
            self._world.tally["payloads named too early"] += named and not whole
            found.append(write._replace(datum=replace(datum, file=file)) if named else write)
        return found

    def _new_name(self, host: ClientNode) -> str:
        self._made += 1
        return f"{host.client.session}-{self._made:x}"

    def given_up(self, host: ClientNode, shard: str, datum: Datum) -> Thread:
        """Send two slices with a long time between them, and nothing more, under no lock."""
        file = self._new_name(host)
        yield from self._stage(host, shard, file, datum, tries=2, rests_ns=RARE_NS)

    def _stage(
        self,
        host: ClientNode,
        shard: str,
        file: str,
        datum: Datum,
        *,
        tries: int,
        rests_ns: int = 0,
    ) -> Steps[bool]:
        """Send slices from where the shard is, whatever is lost; return whether it has them all."""
        have, step = 0, datum.size // SLICES + 1
        for attempt in range(tries):
            if attempt == 1 and rests_ns:
                yield Sleep(rests_ns)
            here = datum.body[have : have + step]
            part = Datum(b"", here, len(here))
            stage = Stage(host.client.session, file, have, datum.size, part)
            (answer,) = yield ParallelCalls([(shard, stage)])
            if isinstance(answer, Staged):
                have = answer.have
            elif answer is not None:
                break
            else:
                self._world.tally["slices sent again"] += 1
            if have == datum.size:
                return True
        return False
