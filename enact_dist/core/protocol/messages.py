"""What clients and shards say to each other: the one place to import a message or its parts from.

Each request is answered by exactly one of the answers named in its docstring, by `EpochChanged`
(the shard does not know this session in this epoch) or by `Refused` (the request itself is wrong).
No answer at all means *unknown*, never *not executed*.

Field types are limited to those that `wire.frames` can carry: int, str, bytes, bool, None, tuples
of these, NamedTuples and the dataclasses of this package.

::

    datum       addresses, identities, the datum, and the decorator of all messages
    parts       the parts of several messages
    requests    the requests, each with the name of its answer, and those with pages
    answers     the answers of a shard, and its notices
    refused     a refusal, and its codes

Durations are sent, points in time are not (except wall-clock stamps): clocks are never compared.

Listings come in pages (see `core.protocol.pages`): if an answer has a cursor in `more`, repeat the
request with that cursor in `after`.  A cursor of an earlier epoch is answered `EpochChanged`: list
again from the start.
"""

from __future__ import annotations

from enact_dist.core.protocol.answers import (
    OUTCOME_COMMITTED,
    OUTCOME_EXPIRED,
    OUTCOME_PENDING,
    OUTCOME_UNSEEN,
    RESOLVED_ABORTED,
    RESOLVED_COMMITTED,
    RESOLVED_OPEN,
    Alive,
    Answer,
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
    Notice,
    OutcomeIs,
    Places,
    Pong,
    Prepared,
    Reached,
    Refusals,
    Registered,
    Released,
    Resolved,
    Sessions,
    Slice,
    SlotChange,
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
from enact_dist.core.protocol.parts import (
    CAUSE_COMMIT,
    CAUSE_FORK,
    FAR,
    HOLD_NS_MAX,
    INLINE_BYTES_MAX,
    ITEMS_MAX,
    MERELY_KEPT,
    NO_LIMIT,
    NO_PLACE,
    NOT_KEPT,
    PLACES,
    PROVE,
    READS_MAX,
    REPORT_BYTES_MAX,
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
    RefusalEntry,
    SessionInfo,
    ShardEntry,
    SlotState,
    SlotVersion,
    VersionEntry,
    WorldEntry,
    WriteItem,
)
from enact_dist.core.protocol.refused import (
    CLOCK_SKEW,
    DAMAGED,
    DATUM_TYPE,
    HELD,
    NEWER_TYPE,
    NO_PAYLOAD,
    NO_ROOM,
    NOT_PROVEN,
    OVERLOAD,
    PERMISSION,
    PROTOCOL,
    TOO_LONG,
    UNKNOWN_ASPECT,
    UNKNOWN_WORLD,
    VALUE,
    Refused,
)
from enact_dist.core.protocol.requests import (
    PAGED,
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
    ListRefusals,
    ListSessions,
    Outcome,
    Ping,
    Prepare,
    Register,
    Release,
    Request,
    Resolve,
    Stage,
    Survey,
    TakeView,
    Validate,
)

Message = Request | Answer | Notice
