"""The answers and notices of a shard; see `core.protocol.messages` for the rules."""

from __future__ import annotations

from typing import NamedTuple

from enact_dist.core.protocol.datum import Datum, LockId, Position, Slot, Token, message
from enact_dist.core.protocol.parts import (
    NOT_KEPT,
    START,
    AspectEntry,
    AuditEntry,
    Counter,
    Cursor,
    GrantLeft,
    Holder,
    PlacementMap,
    RefusalEntry,
    SessionInfo,
    ShardEntry,
    SlotState,
    SlotVersion,
    VersionEntry,
    WorldEntry,
)
from enact_dist.core.protocol.refused import Refused


@message
class Welcome:
    """Which shard this is, and what it knows of the cell."""

    shard: str
    epoch: int
    open: bool
    ttl_ns: int
    wall_ns: int
    notice_number: int
    placement: PlacementMap
    worlds: tuple[str, ...]
    aspects: tuple[AspectEntry, ...]
    shared: str = ""
    shared_nonce: bytes = b""
    forks: tuple[WorldEntry, ...] = ()


@message
class Registered:
    """The catalogue after registration."""

    worlds: tuple[str, ...]
    aspects: tuple[AspectEntry, ...]
    forks: tuple[WorldEntry, ...] = ()


@message
class Granted:
    """The lock is held.  `states`: every named slot, and every matching one of a pattern.

    `count_seen` is the highest message counter that had arrived from the session; `hold_left_ns`
    counts from the sending of this answer.  `stamp_ns` is the shard's hybrid logical time,
    `from_ns` the largest timestamp in `states`: views at other shards must not be older.
    `waited_ns` is how long the lock stood in the queue.
    """

    lock: LockId
    token: Token
    epoch: int
    count_seen: int
    hold_left_ns: int
    stamp_ns: int
    states: tuple[SlotState, ...]
    from_ns: int = 0
    waited_ns: int = 0


@message
class Waiting:
    """Not yet granted; ask again.  `place` counts from 1, `blockers` are the locks ahead.

    The place is 0 while no datum has changed that the lock waits for (`Acquire.seen`).
    """

    lock: LockId
    epoch: int
    place: int
    blockers: tuple[Holder, ...]


@message
class Stale:
    """This seq was granted before, or a newer one of its lane is known: take a new seq."""

    lock: LockId
    epoch: int


@message
class Viewed:
    """Committed data that were current from `from_ns` to `until_ns`, at every stamp between.

    If the first is later than the second, an undecided commit blocks the view: ask again at
    `from_ns`.
    """

    lock: LockId
    epoch: int
    stamp_ns: int
    states: tuple[SlotState, ...]
    from_ns: int = 0
    until_ns: int = 0


@message
class Slice:
    """A part of a datum's body."""

    slot: Slot
    version: int
    encoding: bytes
    stamp_ns: int
    total: int
    offset: int
    body: Datum
    """Body bytes of this part, carried as the body of a datum without encoding."""


@message
class Gone:
    """The asked version is neither current nor pinned by this lock."""

    slot: Slot
    version: int


@message
class Alive:
    """The session is renewed; these are its live grants."""

    epoch: int
    count_seen: int
    notice_number: int
    stamp_ns: int
    grants: tuple[GrantLeft, ...]


@message
class Committed:
    """All writes of the lock are visible.

    `kept` says whether the grant is over (`NOT_KEPT`, `PROVE`) or stays with the session: then it
    is `PLACES` plus the cell of its session's page that holds its number as long as it lives, or
    `FAR` for a session that listens for recalls.
    """

    lock: LockId
    position: Position
    versions: tuple[SlotVersion, ...]
    kept: int = NOT_KEPT


@message
class Staged:
    """How much of a payload has arrived in slices, from its start and without a gap.

    `shared` says that it is a file in the shard's folder, to be filled there, too.  Shards of
    earlier releases called it `draft` there until its commit; "" stands for `file`.
    """

    file: str
    have: int
    shared: bool
    draft: str = ""


@message
class Fenced:
    """The lock is no longer held (or never was in this epoch); nothing was written."""

    lock: LockId
    cause: str


@message
class Changed:
    """An expected slot has moved on to this version; nothing was written, the lock is released.

    If `version` is the expected one, another lock holds the slot for writing now.
    """

    lock: LockId
    slot: Slot
    version: int


@message
class Prepared:
    """The writes are kept until the primary decides; their stamp is at least this one.

    They survive a power cut even if their data are `os` or volatile; so do the reads beside them,
    on which the decision relies.
    """

    lock: LockId
    stamp_ns: int
    versions: tuple[SlotVersion, ...]


@message
class Finished:
    """Nothing of the lock waits for a decision here any more, not even after a restart."""

    lock: LockId


@message
class Resolved:
    """What the primary has decided: `kind` is one of `RESOLVED_*`."""

    lock: LockId
    kind: str
    position: Position


RESOLVED_COMMITTED = "committed"
RESOLVED_ABORTED = "aborted"
RESOLVED_OPEN = "open"


@message
class OutcomeIs:
    """What became of a commit: `kind` is one of `OUTCOME_*`."""

    lock: LockId
    epoch: int
    kind: str
    position: Position
    versions: tuple[SlotVersion, ...]


OUTCOME_COMMITTED = "committed"
OUTCOME_PENDING = "pending"
OUTCOME_UNSEEN = "unseen"
OUTCOME_EXPIRED = "expired"


@message
class Valid:
    """The lock was held without interruption until now.  It is released, or `kept`: `Committed`."""

    lock: LockId
    kept: int = NOT_KEPT


@message
class Released:
    """Nothing of the lock or session is left here."""


@message
class Reached:
    """Whether all commits up to the asked stamp are visible."""

    reached: bool
    stamp_ns: int


@message
class Pong:
    """This shard runs: since when, and whether it grants locks (`core.state.clock`).

    It stays this small whatever the shard holds.  Every start of a daemon has another `start`,
    which tells two daemons with the same name apart.
    """

    shard: str
    epoch: int
    open: bool
    state: str
    uptime_ns: int
    start: int = 0


@message
class Places:
    """Where the answering shard expects each shard of the cell, itself included."""

    shards: tuple[ShardEntry, ...]


@message
class Surveyed:
    """Slots without data, and the notice number up to which they are current."""

    epoch: int
    notice_number: int
    stamp_ns: int
    states: tuple[SlotState, ...]
    more: Cursor = START


@message
class Locks:
    """Holders and waiters, oldest first."""

    epoch: int
    holders: tuple[Holder, ...]
    more: Cursor = START


@message
class Sessions:
    """Sessions, catalogue and counters of a shard; the catalogue is on the first page only."""

    shard: str
    epoch: int
    open: bool
    uptime_ns: int
    wall_ns: int
    slots: int
    bytes: int
    sessions: tuple[SessionInfo, ...]
    worlds: tuple[str, ...]
    aspects: tuple[AspectEntry, ...]
    counters: tuple[Counter, ...]
    more: Cursor = START


@message
class Broken:
    """Whether there was a lock of that number, and its description."""

    found: bool
    holder: Holder | None


@message
class Audited:
    """The newest acts of operators, oldest first, and the number of unacknowledged alarms."""

    alarms: int
    entries: tuple[AuditEntry, ...]
    more: Cursor = START


@message
class Refusals:
    """Which rights clients lacked, the latest at the end."""

    entries: tuple[RefusalEntry, ...]


@message
class EpochChanged:
    """The shard is in this epoch and does not know the session: drop its grants, send `Hello`."""

    epoch: int


@message
class WrongShard:
    """The client placed the request by another map than the shard's."""

    placement: PlacementMap


@message
class Versions:
    """Versions of slots: slot by slot, oldest first."""

    epoch: int
    stamp_ns: int
    entries: tuple[VersionEntry, ...]
    more: Cursor = START


@message
class Forgotten:
    """The state of a slot as of the requested timestamp has left its retention.

    Everything that was requested of this shard is known from `oldest_ns` on.
    """

    slot: Slot
    oldest_ns: int


@message
class Forked:
    """The fork exists; `slots` is how many slots it has."""

    world: str
    slots: int
    stamp_ns: int


@message
class Dropped:
    """The world context does not exist (any more); `slots` is how many slots were deleted now."""

    world: str
    slots: int


@message
class Kept:
    """Which versions a label pins now, and which of the requested ones were already forgotten.

    The pinned versions come page by page, ordered by slot and version.
    """

    versions: tuple[SlotVersion, ...]
    forgotten: tuple[SlotVersion, ...]
    more: Cursor = START


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
    | Refusals
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

# ---------------------------------------------------------------- notices (published, best effort)


class SlotChange(NamedTuple):
    """One committed write; `captured_ns` is the datum's own stamp (0: none).

    `datum` travels only to a watch that asked for data, and only where it is small.
    """

    slot: Slot
    version: int
    stamp_ns: int
    null: bool
    captured_ns: int = 0
    datum: Datum | None = None


@message
class Notice:
    """What one commit changed; `number` counts notices of a shard's epoch without a gap."""

    shard: str
    epoch: int
    number: int
    changes: tuple[SlotChange, ...]
