"""Where versions come from: one `Cause` for all that a lock writes at a shard.

The client says what it has read; who it is and how long it has held the lock, the shard knows
itself.  All slots of a commit share the object, and it goes with the last version that bears it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import Cause
from enact_dist.core.protocol.parts import CAUSE_COMMIT

if TYPE_CHECKING:
    from enact_dist.core.protocol.messages import Commit, Prepare, SlotVersion
    from enact_dist.core.protocol.records import PreparedRecord
    from enact_dist.core.state.sessions import Session


READ_BYTES: Final = 400
"""About what one datum that a cause names takes in memory: its slot, version and stamp."""


def cause_bytes(cause: Cause) -> int:
    """Return about how much memory one of the versions that share a cause takes for it."""
    return READ_BYTES * len(cause.reads) // max(1, len(cause.writes))


def cause_of(
    message: Commit | Prepare,
    session: Session,
    versions: tuple[SlotVersion, ...],
    stamp_ns: int,
    held_ns: int,
) -> Cause:
    """Return the cause of what a lock, held for so long, is about to write here."""
    return Cause(
        message.lock,
        CAUSE_COMMIT,
        session.actor,
        session.host,
        session.pid,
        stamp_ns,
        held_ns,
        message.reads,
        message.reads_left_out,
        versions,
    )


def decided_cause(record: PreparedRecord, *, stamp_ns: int) -> Cause | None:
    """Return the cause of what was prepared, now that its stamp and its versions are certain."""
    if record.cause is None:
        return None
    return record.cause._replace(stamp_ns=stamp_ns, writes=record.versions)
