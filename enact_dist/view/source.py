"""Where the data come from: the cell, read by an observer, which takes no lock."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol, TypeVar

from enact_dist.access.asking import expected, explained, in_parts
from enact_dist.access.snapshot import HeldView
from enact_dist.core.protocol.datum import Slot
from enact_dist.core.protocol.messages import (
    PERMISSION,
    Item,
    ListHistory,
    Ping,
    Refused,
    SlotVersion,
    Versions,
)
from enact_dist.errors import (
    ForgottenError,
    LeaseLostError,
    LinkError,
    PermissionDeniedError,
    ShardUnreachableError,
)
from enact_dist.link.client.calls import CALL_S
from enact_dist.recording.exact import Recorded
from enact_dist.terms import Access
from enact_dist.world.cell import session_behind
from enact_dist.world.version_data import Wanted, found_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from enact_dist.core.protocol.datum import Datum
    from enact_dist.core.protocol.messages import VersionEntry
    from enact_dist.world.cell import Cell
    from enact_dist.world.lineage import CauseTree, EffectTree

T = TypeVar("T")

TOGETHER_MAX: Final = 512
"""Most slots of one view."""
AGAIN_S: Final = 1.0
"""Pause before a shard that did not answer is asked again."""
PING_S: Final = 0.2
"""How long such a shard has to answer, so that it delays nothing else."""

Histories = dict["Slot", list[tuple[int, int]]]
"""Version and stamp of every known version, oldest first, by slot."""


class FoundData(NamedTuple):
    """The data of one moment.

    Attributes:
        data: By slot; a datum that was null then has none.
        forgotten: Slots whose state of that moment has left its retention.
        denied: Slots that this program may not read, each with the text of the refusal.
    """

    data: dict[Slot, Recorded]
    forgotten: tuple[Slot, ...]
    denied: tuple[tuple[Slot, str], ...] = ()


class DataSource(Protocol):
    """A cell, or a recording of one."""

    def of_page(self) -> DataSource:
        """Return the source for one page."""

    @property
    def away(self) -> dict[str, str]:
        """Why shards are not asked now, by their names."""

    def data_at(
        self, slots: Sequence[Slot], at_ns: int, before: Mapping[Slot, Recorded] = {}
    ) -> FoundData:
        """Return data as of a moment; `before` holds versions that need not be fetched again."""

    def histories(self, slots: Sequence[Slot]) -> Histories:
        """Return which versions of these slots are known."""

    def samples(self, slot: Slot, most: int, bytes_max: int) -> list[tuple[int, Datum]]:
        """Return stamps and data of some versions of a slot, no nulls, none larger, in order."""

    def tree_of(self, way: str, recorded: Recorded, depth: int) -> CauseTree | EffectTree:
        """Return the causes (``why``) or the effects (``impact``) of a version."""


class CellSource:
    """A running cell.  Its session reads only; every view is one of the past, which waits for none.

    A shard that does not answer takes no other with it: what the others have is returned, and
    `away` names it.

    Args:
        cell: An observer's connection.
    """

    def __init__(self, cell: Cell) -> None:
        self.cell = cell
        self.session = session_behind(cell)
        self._away: dict[str, tuple[float, str]] = {}

    def of_page(self) -> CellSource:
        """Return this one: all pages share it."""
        return self

    def tree_of(self, way: str, recorded: Recorded, depth: int) -> CauseTree | EffectTree:
        """Return the causes (``why``) or the effects (``impact``) of a version.

        Raises:
            ForgottenError: The version has left its retention.
            ShardUnreachableError: A shard does not answer.
        """
        follow = self.cell.why if way == "why" else self.cell.impact
        return follow(*recorded.slot, recorded.version, depth=depth)

    # ------------------------------------------------------------ shards

    def shard_of(self, slot: Slot) -> str:
        """Return the shard that stores a slot."""
        return self.session.client.shard_of(slot.entity)

    @property
    def away(self) -> dict[str, str]:
        """Why shards are not asked now, by their names."""
        return {shard: why for shard, (_, why) in self._away.copy().items()}

    def still_away(self) -> dict[str, str]:
        """Return `away` without the shards that answer again, some time after they did not."""
        for shard, (until_s, why) in self._away.copy().items():
            if time.monotonic() < until_s:
                continue
            if self._is_there(shard):
                self._away.pop(shard, None)
            else:
                self._away[shard] = (time.monotonic() + AGAIN_S, why)
        return self.away

    def _is_there(self, shard: str) -> bool:
        try:
            return self.session.client.call_once([(shard, Ping())], timeout_s=PING_S)[0] is not None
        except LinkError:
            return False

    def refresh(self) -> list[str]:
        """Learn the aspects and world contexts of the shards that answer; return the contexts."""
        client, away = self.session.client, self.still_away()
        asked = [shard for shard in client.shards() if shard not in away]
        answers = client.call_once([(shard, client.core.hello(shard)) for shard in asked])
        for shard, answer in zip(asked, answers, strict=True):
            if answer is None and not self._is_there(shard):
                self._miss(shard, client.unreachable(shard, CALL_S))
        return sorted(client.worlds())

    def _miss(self, shard: str, error: ShardUnreachableError) -> None:
        self._away[shard] = (time.monotonic() + AGAIN_S, str(error))

    def _of_those_there(self, slots: Iterable[Slot], ask: Callable[[list[Slot]], T]) -> T:
        """Ask for slots; without those of a shard that does not answer, if there is one."""
        away = self.still_away()
        left = [slot for slot in slots if self.shard_of(slot) not in away]
        while True:
            try:
                return ask(left)
            except ShardUnreachableError as error:
                fewer = [slot for slot in left if self.shard_of(slot) != error.shard]
                if len(fewer) == len(left):
                    raise
                self._miss(error.shard, error)
                left = fewer

    # ------------------------------------------------------------ data

    def data_at(
        self, slots: Sequence[Slot], at_ns: int, before: Mapping[Slot, Recorded] = {}
    ) -> FoundData:
        """Return data as of a moment, over all shards that answer.

        Args:
            slots: The slots.
            at_ns: The moment.
            before: Versions that are known: they are not fetched again.

        Raises:
            LockTimeoutError: A commit before the moment is still undecided.
        """
        return self._of_those_there(slots, lambda there: self._data_at(there, at_ns, before))

    def _data_at(
        self, slots: Sequence[Slot], at_ns: int, before: Mapping[Slot, Recorded]
    ) -> FoundData:
        data: dict[Slot, Recorded] = {}
        forgotten: list[Slot] = []
        denied: list[tuple[Slot, str]] = []
        left = [*in_parts(slots, TOGETHER_MAX)]
        while left:
            some = left.pop()
            try:
                data |= self._viewed(some, at_ns, before)
            except ForgottenError:
                if len(some) == 1:
                    forgotten += some
                else:
                    left += in_parts(some, -(-len(some) // 2))
            except PermissionDeniedError as error:
                refused = Slot(error.world, error.entity, error.aspect)
                rest = tuple(slot for slot in some if slot != refused)
                if len(rest) == len(some):
                    raise
                denied.append((refused, str(error)))
                left += [rest] if rest else []
        return FoundData(data, tuple(sorted(forgotten)), tuple(denied))

    def _viewed(
        self, slots: Sequence[Slot], at_ns: int, before: Mapping[Slot, Recorded]
    ) -> dict[Slot, Recorded]:
        try:
            return self._viewed_once(slots, at_ns, before)
        except LeaseLostError:  # the data of the view were removed before they were fetched
            return self._viewed_once(slots, at_ns, before)

    def _viewed_once(
        self, slots: Sequence[Slot], at_ns: int, before: Mapping[Slot, Recorded]
    ) -> dict[Slot, Recorded]:
        items = [Item(int(Access.VIEW), *slot) for slot in slots]
        with HeldView(self.session, items, past_ns=at_ns) as view:
            found: dict[Slot, Recorded] = {}
            new = []
            for reading in view.states:
                state = reading.state
                known = before.get(state.slot)
                if known is not None and known.state == (state.version, state.stamp_ns):
                    found[state.slot] = known
                else:
                    new.append(reading)
            data = view.fetch([one for one in new if not one.state.null_reason])
            for shard, _, state in new:
                facts = (state.slot, state.version, state.stamp_ns, shard, 0)
                found[state.slot] = Recorded(*facts, data.get(state.slot), state.null_reason)
            return found

    def histories(self, slots: Sequence[Slot]) -> Histories:
        """Return which versions of these slots the shards that answer still know.

        Slots that this program may not read are left out; `data_at` names them.
        """
        return self._of_those_there(slots, self._histories)

    def _histories(self, slots: Sequence[Slot]) -> Histories:
        client = self.session.client
        wanted = set(slots)
        groups: dict[tuple[str, str, str], list[str]] = {}
        for slot in slots:
            place = (self.shard_of(slot), slot.context, slot.aspect)
            groups.setdefault(place, []).append(slot.entity)
        calls = [
            (shard, ListHistory((context,), entities, (aspect,)))
            for (shard, context, aspect), each in groups.items()
            for entities in in_parts(each)
        ]
        found: Histories = {}
        for answer in client.call_all(calls):
            if isinstance(answer, Refused) and answer.code == PERMISSION:
                continue  # asked about one slot alone; of several the shard leaves such ones out
            for entry in expected(Versions, ListHistory, answer).entries:
                state = entry.state
                if state.slot in wanted and state.version:
                    found.setdefault(state.slot, []).append((state.version, state.stamp_ns))
        return {slot: sorted(each, key=lambda one: one[1]) for slot, each in found.items()}

    def samples(self, slot: Slot, most: int, bytes_max: int) -> list[tuple[int, Datum]]:
        """Return stamps and data of the newest versions of a slot, as far as they are kept.

        Raises:
            ShardUnreachableError: Its shard does not answer.
        """
        shard, versions = self.shard_of(slot), self.histories([slot]).get(slot, [])[-most:]
        wanted = [Wanted(stamp_ns, slot, version, shard) for version, stamp_ns in versions]
        found = found_of(self.session, wanted)
        data = [(one.stamp_ns, found[one].datum) for one in wanted if one in found]
        return [(at_ns, one) for at_ns, one in data if one is not None and one.size <= bytes_max]

    def explained(self, versions: Mapping[Slot, int]) -> dict[Slot, VersionEntry]:
        """Return size and writer of a version of each of some slots whose shards answer."""

        def ask(slots: list[Slot]) -> list[Versions]:
            asked = [SlotVersion(slot, versions[slot]) for slot in slots]
            return explained(self.session.client, asked)

        answers = self._of_those_there(versions, ask)
        return {entry.state.slot: entry for answer in answers for entry in answer.entries}
