"""Small wrong edits of what readers are shown by capture stamp; the simulator catches each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from enact_dist.core.client.client import Client
from enact_dist.core.client.own_commits import Unsettled
from enact_dist.core.state.history import History
from enact_dist.core.state.retention import SlotHistory
from enact_dist.core.state.slots import Shown, SlotMap

if TYPE_CHECKING:
    from collections.abc import Callable

    Patch = Callable[[Any, str, Any], None]


def shows_the_first_of_a_stamp(patch: Patch) -> None:
    """Of two versions with one stamp the older one is shown."""

    def wrong(self: SlotHistory, captured_ns: int, *, version_max: int) -> Any:
        for old in self.retained():
            stamp_ns = old.datum.stamp_ns if old.datum is not None else 0
            if stamp_ns == captured_ns and old.version <= version_max:
                return old
        return None

    patch(SlotHistory, "captured", wrong)


def shows_the_newest_for_what_is_gone(patch: Patch) -> None:
    """What is outside retention shows as the newest version."""
    captured = SlotMap.captured

    def wrong(self: SlotMap, slot: Any, newest: Any, captured_ns: int, **options: Any) -> Any:
        found = captured(self, slot, newest, captured_ns, **options)
        return found if found.datum is not None else newest

    patch(SlotMap, "captured", wrong)


def retains_one_version_less(patch: Patch) -> None:
    """A version leaves retention one commit too early."""
    append = History._append

    def wrong(self: History, found: Any, old: Any, limits: Any) -> None:
        append(self, found, old, limits._replace(versions=limits.versions - 1))

    patch(History, "_append", wrong)


def shows_what_was_deleted_outside_retention(patch: Patch) -> None:
    """A slot that is null now shows nothing of what it retains."""
    captured = SlotMap.captured

    def wrong(self: SlotMap, slot: Any, newest: Any, captured_ns: int, **options: Any) -> Any:
        null = newest.datum is None
        return newest if null else captured(self, slot, newest, captured_ns, **options)

    patch(SlotMap, "captured", wrong)


def counts_a_set_from_its_capture(patch: Patch) -> None:
    """A view by stamp claims to be current from the commit of the old version that it shows."""
    shown = SlotMap.shown

    def wrong(self: SlotMap, items: Any, at_ns: int = 0, **options: Any) -> Shown:
        items = tuple(items)
        right = shown(self, items, at_ns, **options)
        if not any(item.captured_ns for item in items):
            return right
        return right._replace(from_ns=max((s.stamp_ns for s in right.states), default=0))

    patch(SlotMap, "shown", wrong)


def forgets_large_data_that_a_stamp_named(patch: Patch) -> None:
    """Only the newest version of a large datum stays fetchable for the lock that it was shown to."""
    shown = SlotMap.shown

    def wrong(self: SlotMap, items: Any, at_ns: int = 0, **options: Any) -> Shown:
        right = shown(self, items, at_ns, **options)
        pins = {key: datum for key, datum in right.pins.items() if self[key[0]].version == key[1]}
        return right._replace(pins=pins)

    patch(SlotMap, "shown", wrong)


def surveys_before_its_own_commits(patch: Patch) -> None:
    """A client does not wait until a participant shows what it has committed itself."""
    patch(Client, "unsettled_ns", lambda _self, _shard: 0)


def takes_one_slot_for_the_whole_shard(patch: Patch) -> None:
    """A shard that shows one slot as of now counts as showing all that this process committed."""

    def wrong(self: Unsettled, shard: str, _states: Any, *, until_ns: int = 0) -> None:
        self.reached(shard, until_ns)

    patch(Unsettled, "shown", wrong)
