"""Large data that clients bring before their commit: in slices on a bad network, or as files."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.datum import Datum
from enact_dist.core.protocol.messages import Item, Stage, Staged
from enact_dist.link.memory.names import FIRST_STAGED
from enact_dist.terms import Access
from enact_dist.verify.simulation.cells import CONTEXTS
from enact_dist.verify.simulation.hosts.client_host import (
    ClientNode,
    ParallelCalls,
    Sleep,
    Steps,
    Thread,
)
from enact_dist.verify.simulation.hosts.keeping import Stop
from enact_dist.verify.simulation.hosts.payloads import DRAFT_NS
from enact_dist.verify.simulation.hosts.world import MS
from enact_dist.wire.limits import PAYLOAD_BYTES_MIN

if TYPE_CHECKING:
    from random import Random

    from enact_dist.core.client.lock import MultiLock
    from enact_dist.core.protocol.messages import WriteItem
    from enact_dist.verify.simulation.hosts.world import SimulatedWorld

SLICES: Final = 3
TRIES: Final = 8
ASKS: Final = 3
RESTS_NS: Final = tuple(ms * MS for ms in (0, 0, 1, 5, 30, 200, 800))
"""How long a client rests before it fills a file, and before it commits it."""
LARGE: Final = {"frame": 0.2}
LARGE_IN_FOLDERS: Final = {"frame": 0.95, "note": 0.5}
BURSTS: Final = 0.1
"""Share of the jobs that are bursts, in runs with shared folders."""
BURST_TIMES: Final = (6, 10, 16)
FORKS: Final = 0.05
"""Share of the files at which their client forks before it has filled them."""
GIVES_UP: Final = 0.05
"""Share of the filled files that are not committed, because something else takes their place."""
RARE_NS: Final = DRAFT_NS * 2 // 3
"""Slices that come so seldom keep their draft."""


class Stager:
    """Brings large data to their shards before their commit.

    Attributes:
        large: Share of the data of an aspect that are large.
    """

    def __init__(self, world: SimulatedWorld, *, folders: bool) -> None:
        self._world, self._folders = world, folders
        self.large = LARGE_IN_FOLDERS if folders else LARGE
        self._made = 0

    def burst(
        self, host: ClientNode, lane: int, luck: Random
    ) -> tuple[tuple[Item, ...], int] | None:
        """Draw what a client publishes many times in a row, as a camera does: mostly nothing."""
        if not self._folders or luck.random() >= BURSTS:
            return None
        context = CONTEXTS[lane % len(CONTEXTS)]
        item = Item(Access.WRITE, context, f"camera/{host.name}", "frame")
        return (item,), luck.choice(BURST_TIMES)

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
            file = yield from self._filled(host, shard, datum, luck)
            if file:
                found.append(write._replace(datum=replace(datum, file=file)))
                continue
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
        return f"{host.client.session}-{FIRST_STAGED + self._made:x}"

    def _filled(self, host: ClientNode, shard: str, datum: Datum, luck: Random) -> Steps[str]:
        """Fill a file of the shard's folder; return its name, or "" if slices have to do."""
        files = host.files
        draft = files.payloads.begin(shard, datum.size)
        if isinstance(draft, Stage):
            asked, answer = draft, None
            for _ in range(ASKS):
                (answer,) = yield ParallelCalls([(shard, asked)])
                if answer is not None:
                    break
            draft = files.begun(shard, asked, answer)
        if draft is None:
            return ""
        files.takes(draft, bytes(datum.body))
        host.kept.stands(shard)
        yield Stop(luck.choice(RESTS_NS))
        if luck.random() < FORKS:
            files.fork(shard, datum.size)
        files.fill(draft)
        host.kept.stands(shard)
        yield Stop(luck.choice(RESTS_NS))
        if luck.random() < GIVES_UP:
            files.ended(shard, draft.file, committed=False)
            return ""
        return draft.file

    @staticmethod
    def ended(host: ClientNode, lock: MultiLock) -> None:
        """Give up the files that were filled for a lock and not committed."""
        committed = lock.phase in (Phase.COMMITTED, Phase.UNKNOWN)
        for shard, writes in (lock.finishing.writes if lock.finishing else {}).items():
            for write in writes:
                if write.datum is not None and write.datum.file:
                    host.files.ended(shard, write.datum.file, committed=committed)

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
