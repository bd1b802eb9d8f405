"""Small wrong edits of what comes apart from its commit; the simulator catches each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from enact_dist.link.memory import payload_desk
from enact_dist.link.memory.names import UsedNames
from enact_dist.link.memory.payload_desk import PayloadDesk

if TYPE_CHECKING:
    from collections.abc import Callable

    Patch = Callable[[Any, str, Any], None]


def adopts_half_a_payload(patch: Patch) -> None:
    """A commit gets a payload of which slices are missing."""
    patch(payload_desk.Drafted, "whole", property(lambda _draft: True))


def keeps_what_was_adopted(patch: Patch) -> None:
    """The desk itself holds on to payloads."""
    adopt = PayloadDesk._adopt

    def wrong(self: PayloadDesk, file: str, size: int) -> Any:
        memory = adopt(self, file, size)
        self.counters.setdefault("kept", []).append(memory)
        return memory

    patch(PayloadDesk, "_adopt", wrong)


def never_gives_up_drafts(patch: Patch) -> None:
    """A draft outlives the session that will not commit it any more."""
    patch(PayloadDesk, "sweep", lambda _desk, _lives, _works: None)


def keeps_drafts_without_slices(patch: Patch) -> None:
    """A draft of a client that has given it up stays as long as its session."""
    patch(payload_desk, "DRAFT_NS", 1 << 62)


def counts_from_the_first_slice(patch: Patch) -> None:
    """The time of a draft runs from its first slice, whatever comes later."""
    take = PayloadDesk._take

    def wrong(self: PayloadDesk, file: str, draft: Any, offset: int, slice_: Any) -> Any:
        begun_ns = draft.touched_ns
        answer = take(self, file, draft, offset, slice_)
        draft.touched_ns = begun_ns
        return answer

    patch(PayloadDesk, "_take", wrong)


def gives_up_drafts_of_holders(patch: Patch) -> None:
    """A draft without slices is given up though its client holds a lock."""
    sweep = PayloadDesk.sweep
    patch(PayloadDesk, "sweep", lambda desk, lives, _works: sweep(desk, lives, lambda _: False))


def makes_drafts_of_late_slices(patch: Patch) -> None:
    """A late slice of a payload that was adopted and is gone makes a draft of it again."""
    patch(UsedNames, "add", lambda _names, _name: None)
