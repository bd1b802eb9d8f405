"""Small wrong edits of history: what was, what is kept, what is forgotten; the simulator catches each."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from enact_dist.core.protocol.messages import TakeView
from enact_dist.core.shard.on_history import HistoryHandler
from enact_dist.core.shard.on_view import ViewHandler
from enact_dist.core.state.history import History
from enact_dist.core.state.retention import SlotHistory
from enact_dist.core.state.slots import SlotMap

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    Patch = Callable[[Any, str, Any], None]


def shows_what_was_before_a_stamp(patch: Patch) -> None:
    """As of exactly its stamp a version does not count yet (`<` for `<=`)."""

    def wrong(self: SlotHistory, at_ns: int) -> Any:
        index = bisect_left(self.states, at_ns, key=lambda state: state.stamp_ns)
        return self.states[index - 1] if index else self.kept_at(at_ns)

    patch(SlotHistory, "at", wrong)


def shows_the_present_for_what_is_forgotten(patch: Patch) -> None:
    """A strict view takes the newest version where that of its stamp is gone."""
    patch(SlotMap, "forgotten", lambda _slots, _items, _at_ns: None)


def leaves_out_what_was_deleted_since(patch: Patch) -> None:
    """A pattern as of a stamp matches only slots that are not null now."""
    asked = SlotMap._asked

    def wrong(self: SlotMap, item: Any) -> Any:
        return [found for found in asked(self, item) if found[1].datum is not None]

    patch(SlotMap, "_asked", wrong)


def takes_what_was_lost_for_null(patch: Patch) -> None:
    """What a restart has lost was null before the restart, too."""
    known_since_ns = SlotMap.known_since_ns

    def wrong(self: SlotMap, slot: Any, newest: Any) -> int:
        since_ns = known_since_ns(self, slot, newest)
        return 0 if slot in self._lost and since_ns == self._since_ns else since_ns

    patch(SlotMap, "known_since_ns", wrong)


def answers_about_the_past_at_once(patch: Patch) -> None:
    """A view as of a stamp waits for no commit that may get a stamp before it."""
    on_take_view = ViewHandler.on_take_view

    def wrong(self: ViewHandler, message: TakeView, reply_to: int) -> Iterator[Any]:
        self._undecided_ns = lambda _items: 1 << 62  # type: ignore[method-assign]
        yield from on_take_view(self, message, reply_to)
        del self._undecided_ns

    patch(ViewHandler, "on_take_view", wrong)


def loses_history_at_a_restart(patch: Patch) -> None:
    """A restart finds the newest versions only."""
    patch(SlotMap, "recover_history", lambda _slots, _replaced, _kept: None)


def puts_no_history_on_the_disk(patch: Patch) -> None:
    """A version that is replaced is put away by the store, as if its aspect had no history."""
    patch(History, "will_hold", lambda _history, _slot, _old: False)


def forgets_on_the_disk_what_is_kept(patch: Patch) -> None:
    """What leaves its retention is forgotten by the store, label or not."""
    release = History._release

    def wrong(self: History, found: Any) -> None:
        kept, found.kept = found.kept, {}
        release(self, found)
        found.kept = kept

    patch(History, "_release", wrong)


def keeps_labels_in_memory(patch: Patch) -> None:
    """A label is told of before the store has it, which it never does."""
    record = HistoryHandler._record
    patch(HistoryHandler, "_record", lambda self, label: replace(record(self, label), versions=()))


def lets_go_of_what_others_keep(patch: Patch) -> None:
    """The end of one label is the end of what it kept, whoever else keeps it."""
    let_go = History._let_go

    def wrong(self: History, label: str, found: Any, version: int) -> None:
        for other in sorted(found.kept[version].labels - {label}):
            let_go(self, other, found, version)
        let_go(self, label, found, version)

    patch(History, "_let_go", wrong)


def indexes_captures_as_they_come(patch: Patch) -> None:
    """The index by capture stamp is in the order of commits: a datum that came late is not found."""

    def wrong(self: SlotHistory, content: Any) -> None:
        self._captures.append((content.datum.stamp_ns, content.version))

    patch(SlotHistory, "index", wrong)
    patch(
        SlotHistory,
        "unindex",
        lambda self, old: self._captures.remove((old.datum.stamp_ns, old.version)),
    )
