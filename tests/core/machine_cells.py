"""The cells of the shard's machine: in which states a lock may be, and what may happen to it."""

from __future__ import annotations

STATES = (
    "unseen",
    "waiting",
    "parked",
    "untold",
    "granted",
    "kept",
    "recalled",
    "committing",
    "deciding",
    "preparing",
    "prepared",
    "finishing",
    "aborting",
    "decided",
    "committed",
    "forgotten",
    "finished",
    "forced",
    "alarm",
    "aborted",
    "taken",
    "given back",
    "validated",
    "dropped",
    "lost",
)
LIVE = STATES[1:13]
OVER = STATES[13:]
PAST = (STATES[0], STATES[0], *OVER, "committed", "validated")
AT_DISK = ("committing", "deciding", "preparing", "finishing", "aborting", "alarm")
ABOUT_NO_LOCK = ("welcome", "told")
"""What the disk works on without any lock waiting for it."""
HELD = STATES[3:13]
BY_LOCK = (
    "acquire",
    "commit",
    "decide",
    "expect",
    "overreach",
    "forge",
    "outcome",
    "validate",
    "prepare",
    "finish",
    "told committed",
    "told aborted",
    "told open",
    "peer finished",
    "resolve",
    "release",
    "fetch",
    "view",
    "broken",
    "force abort",
)
BY_GRANT = ("keep", "use", "look", "late use", "used", "unused")
"""Of grants that stay: later blocks name a token, and marks are taken and given back."""
BY_SESSION = ("hello", "keep alive", "unwanted", "newer", "goodbye", "token seen", "token gone")
BY_TIME = ("tick", "lease end", "hold end", "slice end", "stall")
BY_HOST = ("persisted", "kill", "power cut", "drain")
EVENTS = BY_LOCK + BY_GRANT + BY_SESSION + BY_TIME + BY_HOST


def _unreachable() -> dict[tuple[str, str], str]:
    cells = {}
    for state in STATES:
        if state not in AT_DISK:
            cells[state, "persisted"] = "nothing of it is at the disk"
        if state not in HELD:
            cells[state, "hold end"] = "no hold limit runs before the grant or after the end"
        if state not in ("kept", "recalled", "committing"):
            for event in ("used", "unused"):
                cells[state, event] = "a client marks what it was told to keep, and nothing else"
        if state != "parked":
            cells[state, "slice end"] = "no request of it is parked"
    for state in ("finishing", "finished", "alarm"):
        cells[state, "told aborted"] = "its primary has committed, and decides once"
    return cells


UNREACHABLE = _unreachable()
