"""Small wrong edits of what comes apart from its commit; the simulator catches each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from enact_dist.link.memory import payload_handler
from enact_dist.link.memory.ahead import NamesAhead
from enact_dist.link.memory.names import UsedNames
from enact_dist.link.memory.payload_client import SharedPayloads
from enact_dist.link.memory.payload_handler import PayloadHandler

if TYPE_CHECKING:
    from collections.abc import Callable

    Patch = Callable[[Any, str, Any], None]


def adopts_half_a_payload(patch: Patch) -> None:
    """A commit gets a payload of which slices are missing."""
    patch(payload_handler.Drafted, "whole", property(lambda _draft: True))


def keeps_what_was_adopted(patch: Patch) -> None:
    """The handler itself holds on to payloads."""
    adopt = PayloadHandler._adopt

    def wrong(self: PayloadHandler, file: str, size: int) -> Any:
        memory = adopt(self, file, size)
        self.counters.setdefault("kept", []).append(memory)
        return memory

    patch(PayloadHandler, "_adopt", wrong)


def never_gives_up_drafts(patch: Patch) -> None:
    """A draft outlives the session that will not commit it any more."""
    patch(PayloadHandler, "sweep", lambda _handler, _lives, _works: None)


def keeps_drafts_without_slices(patch: Patch) -> None:
    """A draft of a client that has given it up stays as long as its session."""
    patch(payload_handler, "DRAFT_NS", 1 << 62)


def counts_from_the_first_slice(patch: Patch) -> None:
    """The time of a draft runs from its first slice, whatever comes later."""
    take = PayloadHandler._take

    def wrong(self: PayloadHandler, file: str, draft: Any, offset: int, slice_: Any) -> Any:
        begun_ns = draft.touched_ns
        answer = take(self, file, draft, offset, slice_)
        draft.touched_ns = begun_ns
        return answer

    patch(PayloadHandler, "_take", wrong)


def gives_up_drafts_of_holders(patch: Patch) -> None:
    """A draft without slices is given up though its client holds a lock."""
    sweep = PayloadHandler.sweep
    patch(
        PayloadHandler,
        "sweep",
        lambda handler, lives, _works: sweep(handler, lives, lambda _: False),
    )


def makes_drafts_of_late_slices(patch: Patch) -> None:
    """A late slice of a payload that was adopted and is gone makes a draft of it again."""
    patch(UsedNames, "add", lambda _names, _name: None)


# ---------------------------------------------------------------- files ahead


def makes_a_file_again_that_was_taken_back(patch: Patch) -> None:
    """What was taken back is forgotten: its name comes again, with an empty file."""
    remove = PayloadHandler._remove

    def wrong(self: PayloadHandler, files: list[str]) -> Any:
        gone = remove(self, files)
        self._taken_back = UsedNames()
        return gone

    patch(PayloadHandler, "_remove", wrong)


def leaves_files_ahead_to_both_of_a_fork(patch: Patch) -> None:
    """A forked child goes on with the numbers of its parent."""
    patch(SharedPayloads, "leave_pages", lambda _payloads: None)


def gives_a_number_to_two_threads(patch: Patch) -> None:
    """A number is used again while the file ahead of it is there."""
    take = NamesAhead.take

    def wrong(self: NamesAhead, size: int, now_s: float) -> tuple[int, bool]:
        number, ready = take(self, size, now_s)
        self._rows[size].number -= ready
        return number, ready

    patch(NamesAhead, "take", wrong)


def makes_ahead_into_the_room_of_others(patch: Patch) -> None:
    """Files ahead take all of the room, not half of it."""
    made_ahead = PayloadHandler._made_ahead

    def wrong(self: PayloadHandler, file: str, wanted: Any) -> bool:
        self._bytes_max *= 2
        try:
            return made_ahead(self, file, wanted)
        finally:
            self._bytes_max //= 2

    patch(PayloadHandler, "_made_ahead", wrong)


def keeps_files_ahead_of_the_dead(patch: Patch) -> None:
    """A file that nobody has asked for outlives its session."""
    given_up = payload_handler.given_up

    def wrong(drafts: Any, *others: Any) -> list[str]:
        return [file for file in given_up(drafts, *others) if drafts[file].asked]

    patch(payload_handler, "given_up", wrong)


def leaves_the_files_of_what_is_gone(patch: Patch) -> None:
    """Bytes are no longer counted, and their file stays."""
    ended = PayloadHandler._ended
    patch(
        PayloadHandler,
        "_ended",
        lambda handler, file, _disk, size: ended(handler, file, None, size),
    )


def counts_no_files_ahead(patch: Patch) -> None:
    """Files made ahead take room that nobody counts."""
    made_ahead = PayloadHandler._made_ahead

    def wrong(self: PayloadHandler, file: str, wanted: Any) -> bool:
        used = self._bytes
        made = made_ahead(self, file, wanted)
        self._bytes = used
        return made

    patch(PayloadHandler, "_made_ahead", wrong)


def publishes_what_its_client_may_still_fill(patch: Patch) -> None:
    """A commit that names no payload gets the newest file of its session."""
    adopt = PayloadHandler._adopt

    def wrong(self: PayloadHandler, file: str, size: int) -> Any:
        others = [name for name, draft in self._drafts.items() if draft.size == size]
        return adopt(self, file if file in self._drafts or not others else others[-1], size)

    patch(PayloadHandler, "_adopt", wrong)
