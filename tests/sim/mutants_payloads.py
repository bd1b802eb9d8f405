"""Small wrong edits of what comes apart from its commit; the simulator catches each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from enact_dist.link import payload_desk
from enact_dist.link.payload_desk import PayloadDesk

if TYPE_CHECKING:
    from collections.abc import Callable

    Patch = Callable[[Any, str, Any], None]


def adopts_half_a_payload(patch: Patch) -> None:
    """A commit gets a payload of which slices are missing."""
    patch(payload_desk._Draft, "whole", property(lambda _draft: True))


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


def makes_drafts_of_late_slices(patch: Patch) -> None:
    """A late slice of a payload that was adopted and is gone makes a draft of it again."""
    patch(PayloadDesk, "_end", lambda _desk, _file: None)
