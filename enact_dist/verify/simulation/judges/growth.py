"""The rules of an aspect whose type grows: who may write it, and that the newer type stays.

What counts is what a shard has acknowledged: from the first answer that shows the newer type.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.datum_types import succeeds
from enact_dist.core.protocol.messages import (
    DATUM_TYPE,
    NEWER_TYPE,
    Acquire,
    Refused,
    Register,
    Registered,
    Welcome,
)
from enact_dist.core.protocol.records import Reply

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from enact_dist.core.protocol.datum import Datum, Slot
    from enact_dist.core.protocol.messages import AspectEntry
    from enact_dist.core.protocol.records import Effect
    from enact_dist.verify.simulation.hosts.client_host import ClientNode
    from enact_dist.verify.simulation.hosts.shard_host import ShardNode
    from enact_dist.verify.simulation.hosts.world import SimulatedWorld
    from enact_dist.verify.simulation.judges.history import Entry
    from enact_dist.verify.simulation.judges.picture import ShardPicture

OLDER: Final = "Number{value:int}"
NEWER: Final = "Number{value:int,unit:str=}"
NEWER_ENCODING: Final = b"text with a unit"
"""How a datum of the newer type is encoded; those of the older one are not."""


class GrowthJudge:
    """Looks at the types that a shard shows, lets in and refuses."""

    def __init__(self, world: SimulatedWorld) -> None:
        self._world, self._fail = world, world.violation

    def handled(
        self, host: ShardNode, message: object, effects: Sequence[Effect], picture: ShardPicture
    ) -> None:
        """Judge one step of a shard; before its locks are judged, which notes who has come."""
        if isinstance(message, Acquire) and picture.grown:
            came = message.lock in host.shard.state.tenures.by_lock
            if came and message.lock not in picture.arrivals:
                picture.late[message.lock] = None
        for effect in effects:
            if not isinstance(effect, Reply):
                continue
            asked, answer = host.asked.get(effect.reply_to), effect.answer
            if isinstance(answer, Welcome | Registered):
                self._check_shown(host.name, answer.aspects, picture)
                if isinstance(asked, Register):
                    self._check_let_in(host.name, asked.aspects, picture)
            elif isinstance(answer, Refused):
                self._check_refused(host, asked, answer, picture)

    def _check_shown(
        self, shard: str, aspects: Iterable[AspectEntry], picture: ShardPicture
    ) -> None:
        """The newer type is shown with the one that it succeeds, for good."""
        shown = {entry.name: entry for entry in aspects}
        for name, known in picture.grown.items():
            if shown.get(name) != known:
                self._fail("a newer type stays", shard, shown.get(name), known)
        for entry in shown.values():
            if entry.fingerprint == NEWER and entry.name not in picture.grown:
                if entry.older != (OLDER,):
                    self._fail("a newer type names the older one", shard, entry)
                picture.grown[entry.name] = entry
                self._world.tally["types that have grown"] += 1

    def _check_let_in(
        self, shard: str, aspects: Iterable[AspectEntry], picture: ShardPicture
    ) -> None:
        for entry in aspects:
            known = picture.grown.get(entry.name)
            if known is not None and not entry.reads and succeeds(NEWER, entry.fingerprint):
                self._fail("a writer of the older type is refused", shard, entry)

    def _check_refused(
        self, host: ShardNode, asked: object, answer: Refused, picture: ShardPicture
    ) -> None:
        shard = host.name
        if isinstance(asked, Acquire) and answer.code == NEWER_TYPE:
            if asked.successions == host.shard.state.catalogue.successions:
                self._fail("a writer of the newer type is let in", shard, asked, answer)
        elif isinstance(asked, Register) and answer.code == DATUM_TYPE:
            older = [e for e in asked.aspects if not e.reads and e.fingerprint == OLDER]
            if not older:
                self._fail("a writer of the newer type is let in", shard, asked, answer)
            if OLDER not in answer.text or NEWER not in answer.text:
                self._fail("a refusal names both types", shard, answer)

    def booted(self, host: ShardNode, picture: ShardPicture) -> None:
        """A shard started: it knows each newer type that it had acknowledged."""
        self._world.tally["newer types over a restart"] += len(picture.grown)
        self._check_shown(host.name, host.shard.state.catalogue.aspects.values(), picture)

    def committed(
        self,
        entry: Entry,
        slot: Slot,
        before: Datum | None,
        datum: Datum | None,
        picture: ShardPicture,
    ) -> None:
        """A datum became visible, in place of another one."""
        if slot.aspect not in picture.grown or entry.newer == slot.aspect:
            return
        if picture.origin(entry.id) in picture.late:
            self._fail("a writer of the older type is refused", slot, entry.id)
        if datum is not None and before is not None and before.encoding == NEWER_ENCODING:
            self._fail("a new field is not dropped", slot, entry.id)
        self._world.tally["locks of an older type that ended later"] += 1

    def client_refused(self, host: ClientNode, entry: AspectEntry, answer: Refused) -> None:
        """A client was refused what it would write."""
        if entry.fingerprint != OLDER or answer.code != DATUM_TYPE:
            self._fail("nothing is refused", host.name, entry, answer)
        self._world.tally["writers of an older type refused"] += 1

    @staticmethod
    def explains(entry: Entry) -> bool:
        """Whether a lock was refused because its client had to look at a newer type first."""
        return getattr(entry.lock.refusal, "code", "") == NEWER_TYPE
