"""What client and shard say to each other.  Requests and answers, frozen, validated by `wire`.

Each request is answered by exactly one of the answers named in its docstring, by `EpochChanged`
(the shard does not know this session in this epoch) or by `Refused` (the request itself is wrong).
No answer at all means *unknown*, never *not executed*.

Field types are limited to those that `wire.frames` can carry: int, str, bytes, bool, None, tuples
of these, NamedTuples and dataclasses of the protocol's four files and of `core.protocol.datum`.

::

    message_parts      the parts of several messages
    requests           the requests, each with the name of its answer
    answers            the answers of a shard
    messages           notices, and all names of the protocol

Durations travel, points in time do not (except wall-clock stamps): clocks are never compared.

Listings come in pages (see `core.protocol.pages`): an answer with a cursor in `more` is asked on
with that cursor in `after`.  A cursor of an earlier epoch is answered `EpochChanged`: list from the
begin.
"""

from __future__ import annotations

from typing import NamedTuple

from enact_dist.core.protocol.answers import (
    OUTCOME_COMMITTED,
    OUTCOME_EXPIRED,
    OUTCOME_PENDING,
    OUTCOME_UNSEEN,
    RESOLVED_ABORTED,
    RESOLVED_COMMITTED,
    RESOLVED_OPEN,
    Alive,
    Audited,
    Broken,
    Changed,
    Committed,
    Dropped,
    EpochChanged,
    Fenced,
    Finished,
    Forgotten,
    Forked,
    Gone,
    Granted,
    Kept,
    Locks,
    OutcomeIs,
    Places,
    Pong,
    Prepared,
    Reached,
    Refused,
    Registered,
    Released,
    Resolved,
    Sessions,
    Slice,
    Staged,
    Stale,
    Surveyed,
    Valid,
    Versions,
    Viewed,
    Waiting,
    Welcome,
    WrongShard,
)
from enact_dist.core.protocol.datum import Slot
from enact_dist.core.protocol.message import message
from enact_dist.core.protocol.parts import (
    START,
    AspectEntry,
    AuditEntry,
    Cause,
    Counter,
    Cursor,
    DatumRead,
    GrantLeft,
    Holder,
    Item,
    LaneView,
    Pin,
    PlacementMap,
    SessionInfo,
    ShardEntry,
    SlotState,
    SlotVersion,
    VersionEntry,
    WorldEntry,
    WriteItem,
)
from enact_dist.core.protocol.requests import (
    Acquire,
    AwaitStamp,
    Break,
    Commit,
    DropWorld,
    Explain,
    Fetch,
    FindEffects,
    Finish,
    ForceAbort,
    Fork,
    Goodbye,
    Hello,
    KeepAlive,
    KeepVersions,
    ListAudit,
    ListHistory,
    ListLocks,
    ListPlaces,
    ListSessions,
    Outcome,
    Ping,
    Prepare,
    Register,
    Release,
    Resolve,
    Stage,
    Survey,
    TakeView,
    Validate,
)

# ---------------------------------------------------------------- notices (published, best effort)


class Change(NamedTuple):
    """One committed write, without its data; `captured_ns` is the datum's own stamp (0: none)."""

    slot: Slot
    version: int
    stamp_ns: int
    null: bool
    captured_ns: int = 0


@message
class Notice:
    """What one commit changed; `number` counts notices of a shard's epoch without a gap."""

    shard: str
    epoch: int
    number: int
    changes: tuple[Change, ...]


Request = (
    Hello
    | Register
    | Acquire
    | TakeView
    | Fetch
    | KeepAlive
    | Commit
    | Outcome
    | Validate
    | Prepare
    | Finish
    | Resolve
    | Release
    | Goodbye
    | AwaitStamp
    | Ping
    | ListPlaces
    | Survey
    | ListLocks
    | ListSessions
    | Break
    | ForceAbort
    | ListAudit
    | Stage
    | ListHistory
    | Explain
    | FindEffects
    | Fork
    | DropWorld
    | KeepVersions
)
Answer = (
    Welcome
    | Registered
    | Granted
    | Waiting
    | Stale
    | Viewed
    | Slice
    | Gone
    | Alive
    | Committed
    | Fenced
    | Changed
    | Prepared
    | Finished
    | Resolved
    | OutcomeIs
    | Valid
    | Released
    | Reached
    | Pong
    | Places
    | Surveyed
    | Locks
    | Sessions
    | Broken
    | Audited
    | Staged
    | Versions
    | Forgotten
    | Forked
    | Dropped
    | Kept
    | EpochChanged
    | WrongShard
    | Refused
)
Message = Request | Answer | Notice
PAGED = (
    *(Survey, ListLocks, ListSessions, ListAudit, ListHistory, Explain, FindEffects),
    KeepVersions,
)
"""Requests with a cursor: their answers come in pages."""

__all__ = [
    "OUTCOME_COMMITTED",
    "OUTCOME_EXPIRED",
    "OUTCOME_PENDING",
    "OUTCOME_UNSEEN",
    "PAGED",
    "RESOLVED_ABORTED",
    "RESOLVED_COMMITTED",
    "RESOLVED_OPEN",
    "START",
    "Acquire",
    "Alive",
    "Answer",
    "AspectEntry",
    "AuditEntry",
    "Audited",
    "AwaitStamp",
    "Break",
    "Broken",
    "Cause",
    "Change",
    "Changed",
    "Commit",
    "Committed",
    "Counter",
    "Cursor",
    "DatumRead",
    "DropWorld",
    "Dropped",
    "EpochChanged",
    "Explain",
    "Fenced",
    "Fetch",
    "FindEffects",
    "Finish",
    "Finished",
    "ForceAbort",
    "Forgotten",
    "Fork",
    "Forked",
    "Gone",
    "Goodbye",
    "GrantLeft",
    "Granted",
    "Hello",
    "Holder",
    "Item",
    "KeepAlive",
    "KeepVersions",
    "Kept",
    "LaneView",
    "ListAudit",
    "ListHistory",
    "ListLocks",
    "ListPlaces",
    "ListSessions",
    "Locks",
    "Message",
    "Notice",
    "Outcome",
    "OutcomeIs",
    "Pin",
    "Ping",
    "PlacementMap",
    "Places",
    "Pong",
    "Prepare",
    "Prepared",
    "Reached",
    "Refused",
    "Register",
    "Registered",
    "Release",
    "Released",
    "Request",
    "Resolve",
    "Resolved",
    "SessionInfo",
    "Sessions",
    "ShardEntry",
    "Slice",
    "SlotState",
    "SlotVersion",
    "Stage",
    "Staged",
    "Stale",
    "Survey",
    "Surveyed",
    "TakeView",
    "Valid",
    "Validate",
    "VersionEntry",
    "Versions",
    "Viewed",
    "Waiting",
    "Welcome",
    "WorldEntry",
    "WriteItem",
    "WrongShard",
]
