"""What client and shard say to each other.  Requests and answers, frozen, validated by `wire`.

Each request is answered by exactly one of the answers named in its docstring, by `EpochChanged`
(the shard does not know this session in this epoch) or by `Refused` (the request itself is wrong).
No answer at all means *unknown*, never *not executed*.

Field types are limited to those that `wire.frames` can carry: int, str, bytes, bool, None,
tuples of these, NamedTuples and dataclasses of this module and of `core.datum`.  The whole protocol
stands in this one file, long as it is, so that a reader has it on one page.
Durations travel, points in time do not (except wall-clock stamps): clocks are never compared.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from enact_dist.core.datum import Datum, LockId, Position, Slot, Token

# ---------------------------------------------------------------- parts


class Item(NamedTuple):
    """One line of a lock or view: `access` is an `enact_dist.terms.Access` number.

    `entity` is a pattern where the access is one of the `…_EACH`.  `known` is the version that
    the client still has from this epoch (0: none): an unchanged datum is not sent again.
    With `captured_ns` (a `VIEW`, or the `READ` that stands for one where there is no cut) the
    newest retained version with that capture stamp is asked instead of the newest one; where there
    is none, the slot shows as null outside retention.
    """

    access: int
    context: str
    entity: str
    aspect: str
    known: int = 0
    captured_ns: int = 0


class SlotState(NamedTuple):
    """The newest committed state of one slot.

    `datum` is None when the slot is null (then `null_reason` says why), when the client knows
    this version already (`same`), or when the datum is large and waits to be fetched (`large`).
    `size` is the body's length in bytes in every case but null.  `captured_ns` is the datum's own
    stamp, in every case but null, too.
    """

    slot: Slot
    version: int
    stamp_ns: int
    size: int
    datum: Datum | None
    same: bool
    large: bool
    null_reason: str
    captured_ns: int = 0


class Holder(NamedTuple):
    """Who holds or awaits a lock, for messages to people."""

    lock: LockId
    number: int
    actor: str
    host: str
    pid: int
    granted: bool
    modes: str
    age_ns: int
    lease_left_ns: int
    hold_left_ns: int
    slots: tuple[str, ...]
    waits_for: tuple[int, ...]


class WriteItem(NamedTuple):
    """One slot to set at commit; `datum` None writes null."""

    slot: Slot
    datum: Datum | None


class SlotVersion(NamedTuple):
    """A slot and one of its versions."""

    slot: Slot
    version: int


class LaneView(NamedTuple):
    """The lowest seq of a lane that its client still cares for."""

    lane: int
    seq: int


class GrantLeft(NamedTuple):
    """A live grant as the shard sees it."""

    lock: LockId
    token: Token
    hold_left_ns: int


class AspectEntry(NamedTuple):
    """An aspect of the catalogue: its type's fingerprint and its durability ("" = unsaid).

    `retention` is how many versions of each slot stay readable, the newest one included (0: unsaid,
    which is 1); of several that ask, the largest counts.
    """

    name: str
    fingerprint: str
    durability: str
    retention: int = 0


class ShardEntry(NamedTuple):
    """A shard of the cell and the endpoints at which it can be reached."""

    name: str
    endpoints: tuple[str, ...]


class Pin(NamedTuple):
    """Entities that a placement keeps on one shard, by name pattern."""

    pattern: str
    shard: str


class PlacementMap(NamedTuple):
    """Which shards there are and which entities are pinned; `version` names this state."""

    version: int
    shards: tuple[ShardEntry, ...]
    pins: tuple[Pin, ...]


class SessionInfo(NamedTuple):
    """One session at a shard, for `enact actor ls` and `enact shard ls`."""

    session: str
    actor: str
    host: str
    pid: int
    lease_left_ns: int
    token_present: bool
    locks: int
    report: bytes


class AuditEntry(NamedTuple):
    """An operator's act at a shard, or what came of one; `kind` is one of `core.forced`."""

    wall_ns: int
    kind: str
    text: str


class Counter(NamedTuple):
    """One named statistic of a shard."""

    name: str
    value: int


# ---------------------------------------------------------------- requests


@dataclass(frozen=True, slots=True)
class Hello:
    """Open a session, or acknowledge an epoch.  Answer: `Welcome`.

    `known_epoch` equal to the shard's epoch means: *all my older grants here are dropped*.
    The client drops first and acknowledges after.  0 means that it knows none.
    An observer never locks: it gets no durable session record.
    """

    session: str
    known_epoch: int
    ttl_ns: int
    actor: str
    host: str
    pid: int
    observer: bool


@dataclass(frozen=True, slots=True)
class Register:
    """Create world contexts and register aspects, idempotently.  Answer: `Registered`."""

    session: str
    worlds: tuple[str, ...]
    aspects: tuple[AspectEntry, ...]


@dataclass(frozen=True, slots=True)
class Acquire:
    """Ask for a set of locks at once, with views beside them.

    Answer: `Granted`, `Waiting`, `Stale` or `WrongShard`.

    Idempotent: the same lock asked again finds its place in the queue or gets its grant again.
    `wait_ns` is how long this one call may be parked (at most `WAIT_SLICE_NS_MAX`), not how long
    the lock may take.  `count` is the session's message counter (see `KeepAlive`).
    `seen_stamp_ns` is the largest commit stamp the client has seen.  `alone` says that the whole
    lock, its views included, lies on this shard, so that its commit decides in one step.
    """

    lock: LockId
    epoch: int
    map_version: int
    count: int
    items: tuple[Item, ...]
    wait_ns: int
    hold_ns: int
    seen_stamp_ns: int
    alone: bool = False


@dataclass(frozen=True, slots=True)
class TakeView:
    """Read committed data without a lock.  Answer: `Viewed` or `WrongShard`.

    Large data stay fetchable for the lock id until it is released or overtaken by its lane.
    With `at_ns` the data are asked as of that stamp: the shard moves its clock past it, waits (at
    most a slice) for undecided commits stamped up to it, and goes back to it where it still can.
    """

    lock: LockId
    epoch: int
    map_version: int
    count: int
    items: tuple[Item, ...]
    seen_stamp_ns: int
    at_ns: int = 0


@dataclass(frozen=True, slots=True)
class Fetch:
    """Ask for a part of a large datum that a grant or view named.  Answer: `Slice` or `Gone`."""

    lock: LockId
    epoch: int
    slot: Slot
    version: int
    offset: int
    length: int


@dataclass(frozen=True, slots=True)
class KeepAlive:
    """Renew the session and say what is still wanted.  Answer: `Alive`.

    The shard frees every grant and waiter of a lane below its `view`: a lost release or an orphan
    grant ends here.  `count` increases with each message of the session; the client remembers when
    it sent which, and believes in its locks from *sending* times only.
    `report` is the actor's own statistics (msgpack), shown by `enact actor ls`.
    """

    session: str
    epoch: int
    count: int
    view: tuple[LaneView, ...]
    report: bytes


@dataclass(frozen=True, slots=True)
class Commit:
    """Publish all writes of a lock and release it.  Answer: `Committed`, `Fenced` or `Changed`.

    Every slot of `expects` must still be at that version, and in nobody's way (see `Commits`).
    Where other shards have prepared writes, they are the `participants`, and the record of this
    commit decides for them too; it is then forced to the disk, whatever its own data survive.
    """

    lock: LockId
    token: Token
    writes: tuple[WriteItem, ...]
    seen_stamp_ns: int
    expects: tuple[SlotVersion, ...] = ()
    participants: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Stage:
    """Bring a payload to the shard apart from the commit that will name it.  Answer: `Staged`.

    The first one, at offset 0 and without a body, makes room for `total` bytes: on the same host
    the client then fills the shard's file by itself.  Where it cannot, slices follow, in order or
    again.  A total of 0 gives the payload up.  Answered by the shard's link, not by its core.
    """

    session: str
    file: str
    offset: int
    total: int
    body: Datum


@dataclass(frozen=True, slots=True)
class Outcome:
    """Ask what became of a commit.  Answer: `OutcomeIs`."""

    lock: LockId


@dataclass(frozen=True, slots=True)
class Validate:
    """Is this lock still continuously held?  If so, release it.

    Answer: `Valid`, `Fenced` or `Changed`.  A token with number 0 stands for a shard where the lock
    holds nothing but expects something.
    """

    lock: LockId
    token: Token
    expects: tuple[SlotVersion, ...] = ()


@dataclass(frozen=True, slots=True)
class Prepare:
    """Keep these writes, and the lock with them, until shard `primary` has decided.

    Answer: `Prepared`, `Fenced` or `Changed`.  From then on neither the client nor the end of a
    lease frees the lock: the shard itself asks the primary, for as long as it takes.
    """

    lock: LockId
    token: Token
    writes: tuple[WriteItem, ...]
    seen_stamp_ns: int
    expects: tuple[SlotVersion, ...]
    primary: str
    primary_token: Token


@dataclass(frozen=True, slots=True)
class Finish:
    """Shard to shard: the lock has committed, apply what was prepared.  Answer: `Finished`."""

    lock: LockId
    position: Position


@dataclass(frozen=True, slots=True)
class Resolve:
    """Shard to shard: what became of a lock that `asker` has prepared?  Answer: `Resolved`."""

    lock: LockId
    primary_token: Token
    asker: str


@dataclass(frozen=True, slots=True)
class Release:
    """Give up a lock, its place in the queue and its pinned views.  Answer: `Released`, always."""

    lock: LockId


@dataclass(frozen=True, slots=True)
class Goodbye:
    """End a session.  Answer: `Released`."""

    session: str


@dataclass(frozen=True, slots=True)
class AwaitStamp:
    """Wait until all commits up to a stamp are visible.  Answer: `Reached` (maybe not yet)."""

    stamp_ns: int
    wait_ns: int


@dataclass(frozen=True, slots=True)
class Survey:
    """List slots without their data.  Answer: `Surveyed`.

    Empty `contexts` or `aspects` mean all; `patterns` are entity patterns, empty means all.
    With `retained` the retained versions of each slot come before its newest one, oldest first.
    """

    contexts: tuple[str, ...]
    patterns: tuple[str, ...]
    aspects: tuple[str, ...]
    retained: bool = False


@dataclass(frozen=True, slots=True)
class ListLocks:
    """List holders and waiters.  Answer: `Locks`."""


@dataclass(frozen=True, slots=True)
class ListSessions:
    """List sessions, catalogue and counters of the shard.  Answer: `Sessions`."""


@dataclass(frozen=True, slots=True)
class Break:
    """Take a lock away by its grant number, by hand.  Answer: `Broken`.

    A restarted shard gives its numbers anew: `epoch` says in which one it was read (0: unsaid), so
    that a late copy breaks nobody else's lock.
    """

    number: int
    reason: str
    epoch: int = 0


@dataclass(frozen=True, slots=True)
class ForceAbort:
    """Give up a prepared lock whose primary is lost for good, by hand.  Answer: `Broken`.

    If the primary had decided to commit after all, the commit is torn: only for an operator who
    knows that it never comes back.  `epoch` is that of `Break`.
    """

    number: int
    reason: str
    epoch: int = 0


@dataclass(frozen=True, slots=True)
class ListAudit:
    """List what operators did here.  Answer: `Audited`.

    A text in `settle` says that somebody has seen to all alarms so far, and how.  `seen_ns` is the
    wall-clock stamp of the newest act that this somebody had seen (0: unsaid): a late copy settles
    no alarm that came since.
    """

    settle: str
    seen_ns: int = 0


# ---------------------------------------------------------------- answers


@dataclass(frozen=True, slots=True)
class Welcome:
    """Who this shard is and what the cell looks like from here."""

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


@dataclass(frozen=True, slots=True)
class Registered:
    """The catalogue after registration."""

    worlds: tuple[str, ...]
    aspects: tuple[AspectEntry, ...]


@dataclass(frozen=True, slots=True)
class Granted:
    """The lock is held.  `states`: every named slot, and every matching one of a pattern.

    `count_seen` is the highest message counter that had arrived from the session; `hold_left_ns`
    counts from when this was sent.  `stamp_ns` is the shard's hybrid logical time, `from_ns` the
    largest stamp of what is shown: views elsewhere must not lie before it.
    """

    lock: LockId
    token: Token
    epoch: int
    count_seen: int
    hold_left_ns: int
    stamp_ns: int
    states: tuple[SlotState, ...]
    from_ns: int = 0


@dataclass(frozen=True, slots=True)
class Waiting:
    """Not yet granted; ask again.  `place` counts from 1, `blockers` are those in the way."""

    lock: LockId
    epoch: int
    place: int
    blockers: tuple[Holder, ...]


@dataclass(frozen=True, slots=True)
class Stale:
    """This seq was granted before, or a newer one of its lane is known: take a new seq."""

    lock: LockId
    epoch: int


@dataclass(frozen=True, slots=True)
class Viewed:
    """Committed data that were current from `from_ns` to `until_ns`, at every stamp between.

    Where the first lies after the second, an undecided commit stands in the way: ask again at
    `from_ns`.
    """

    lock: LockId
    epoch: int
    stamp_ns: int
    states: tuple[SlotState, ...]
    from_ns: int = 0
    until_ns: int = 0


@dataclass(frozen=True, slots=True)
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


@dataclass(frozen=True, slots=True)
class Gone:
    """The asked version is neither current nor pinned by this lock."""

    slot: Slot
    version: int


@dataclass(frozen=True, slots=True)
class Alive:
    """The session is renewed; these are its live grants."""

    epoch: int
    count_seen: int
    notice_number: int
    stamp_ns: int
    grants: tuple[GrantLeft, ...]


@dataclass(frozen=True, slots=True)
class Committed:
    """All writes of the lock are visible."""

    lock: LockId
    position: Position
    versions: tuple[SlotVersion, ...]


@dataclass(frozen=True, slots=True)
class Staged:
    """So much of a payload has come in slices, from its begin on, without a hole.

    `shared` says that it is a file in the shard's folder, to be filled there, too.
    """

    file: str
    have: int
    shared: bool


@dataclass(frozen=True, slots=True)
class Fenced:
    """The lock is no longer held (or never was in this epoch); nothing was written."""

    lock: LockId
    cause: str


@dataclass(frozen=True, slots=True)
class Changed:
    """An expected slot has moved on to this version; nothing was written, the lock is released.

    The expected version itself means: another lock holds the slot for writing now.
    """

    lock: LockId
    slot: Slot
    version: int


@dataclass(frozen=True, slots=True)
class Prepared:
    """The writes are kept until the primary decides; their stamp is at least this one.

    They outlast a power cut even where their data are `os` or volatile: so do the reads beside
    them, on which the decision relies.
    """

    lock: LockId
    stamp_ns: int
    versions: tuple[SlotVersion, ...]


@dataclass(frozen=True, slots=True)
class Finished:
    """Nothing of the lock waits for a decision here any more, and that survives."""

    lock: LockId


@dataclass(frozen=True, slots=True)
class Resolved:
    """What the primary has decided: `kind` is one of `RESOLVED_*`."""

    lock: LockId
    kind: str
    position: Position


RESOLVED_COMMITTED = "committed"
RESOLVED_ABORTED = "aborted"
RESOLVED_OPEN = "open"


@dataclass(frozen=True, slots=True)
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


@dataclass(frozen=True, slots=True)
class Valid:
    """The lock was held without interruption until now; it is released."""

    lock: LockId


@dataclass(frozen=True, slots=True)
class Released:
    """Nothing of the lock or session is left here."""


@dataclass(frozen=True, slots=True)
class Reached:
    """Whether all commits up to the asked stamp are visible."""

    reached: bool
    stamp_ns: int


@dataclass(frozen=True, slots=True)
class Surveyed:
    """Slots without data, and the notice number up to which they are current."""

    epoch: int
    notice_number: int
    stamp_ns: int
    states: tuple[SlotState, ...]


@dataclass(frozen=True, slots=True)
class Locks:
    """Holders and waiters, oldest first."""

    epoch: int
    holders: tuple[Holder, ...]


@dataclass(frozen=True, slots=True)
class Sessions:
    """Sessions, catalogue and counters of a shard."""

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


@dataclass(frozen=True, slots=True)
class Broken:
    """Whether a lock of that number was live, and what it was."""

    found: bool
    holder: Holder | None


@dataclass(frozen=True, slots=True)
class Audited:
    """The newest acts of operators, oldest first, and how many alarms nobody has seen to."""

    alarms: int
    entries: tuple[AuditEntry, ...]


@dataclass(frozen=True, slots=True)
class EpochChanged:
    """The shard is in this epoch and does not know the session there: drop, say Hello, go on."""

    epoch: int


@dataclass(frozen=True, slots=True)
class WrongShard:
    """The request was placed by another map than the shard's."""

    placement: PlacementMap


@dataclass(frozen=True, slots=True)
class Refused:
    """The request cannot be carried out as it is; `code` names the error class to raise."""

    code: str
    text: str


# ---------------------------------------------------------------- notices (published, best effort)


class Change(NamedTuple):
    """One committed write, without its data; `captured_ns` is the datum's own stamp (0: none)."""

    slot: Slot
    version: int
    stamp_ns: int
    null: bool
    captured_ns: int = 0


@dataclass(frozen=True, slots=True)
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
    | Survey
    | ListLocks
    | ListSessions
    | Break
    | ForceAbort
    | ListAudit
    | Stage
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
    | Surveyed
    | Locks
    | Sessions
    | Broken
    | Audited
    | Staged
    | EpochChanged
    | WrongShard
    | Refused
)
Message = Request | Answer | Notice
