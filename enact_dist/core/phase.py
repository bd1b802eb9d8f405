"""Where a client's lock is in its life; the drawing is at the top of `multilock`."""

from __future__ import annotations

import enum


class Phase(enum.Enum):
    """Where a lock is in its life; see the drawing in `multilock`."""

    ACQUIRING = "acquiring"
    VIEWING = "viewing"
    HELD = "held"
    VALIDATING = "validating"
    COMMITTING = "committing"
    COMMITTED = "committed"
    RELEASED = "released"
    LOST = "lost"
    CHANGED = "changed"
    TIMED_OUT = "timed out"
    UNREACHABLE = "unreachable"
    REFUSED = "refused"
    MISPLACED = "misplaced"
    UNKNOWN = "unknown"

    busy: bool
    """Whether the lock has calls to make before it rests."""

    def __init__(self, text: str) -> None:
        self.busy = text in ("acquiring", "viewing", "validating", "committing")
