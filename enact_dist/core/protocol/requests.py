"""The requests of clients and of other shards; see `core.protocol.messages` for the rules."""

from __future__ import annotations

from enact_dist.core.protocol.datum import Datum, LockId, Position, Slot, Token, message
from enact_dist.core.protocol.parts import (
    START,
    AspectEntry,
    Cursor,
    DatumRead,
    Item,
    LaneView,
    ShardEntry,
    SlotVersion,
    WriteItem,
)


@message
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


@message
class Register:
    """Create world contexts and register aspects, idempotently.  Answer: `Registered`.

    More than a catalogue can hold (`core.state.catalogue`) is refused as "overload".
    """

    session: str
    worlds: tuple[str, ...]
    aspects: tuple[AspectEntry, ...]


@message
class Acquire:
    """Ask for a set of locks at once, with views beside them.

    Answer: `Granted`, `Waiting`, `Stale` or `WrongShard`.

    Idempotent: the same lock asked again finds its place in the queue or gets its grant again.
    `wait_ns` is how long this one call may be parked (at most `WAIT_SLICE_NS_MAX`), not how long
    the lock may take.  `count` is the session's message counter (see `KeepAlive`).
    `seen_stamp_ns` is the largest commit stamp the client has seen.  `alone` says that the whole
    lock, its views included, lies on this shard, so that its commit decides in one step.
    `successions` says how many successions of datum types the client knows of at this shard: if it
    has missed one of an aspect that it would write, the shard refuses it with ``newer_type``.
    `seen` are data that the client has seen: while none of these slots shows a newer datum, the
    lock gets no place in the queue, and the answer after `wait_ns` is `Waiting` with the place 0.
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
    successions: int = 0
    seen: tuple[DatumRead, ...] = ()


@message
class TakeView:
    """Read committed data without a lock.  Answer: `Viewed`, `Forgotten` or `WrongShard`.

    Large data stay fetchable for the lock id until it is released or overtaken by its lane.
    `at_ns` asks for the data as of that timestamp: the shard moves its clock past it, waits (at
    most a slice) for undecided commits up to it, and shows that moment if it still can.  With
    `strict` it never shows the present instead: a forgotten state is answered `Forgotten`, and a
    timestamp further ahead than clocks may differ is refused.  If the answer ends before `at_ns`
    (`until_ns`), an undecided commit blocks the view: ask again.
    """

    lock: LockId
    epoch: int
    map_version: int
    count: int
    items: tuple[Item, ...]
    seen_stamp_ns: int
    at_ns: int = 0
    strict: bool = False


@message
class Fetch:
    """Ask for a part of a large datum that a grant or view named.  Answer: `Slice` or `Gone`."""

    lock: LockId
    epoch: int
    slot: Slot
    version: int
    offset: int
    length: int


@message
class KeepAlive:
    """Renew the session and name the locks that are still wanted.  Answer: `Alive`.

    The shard frees every grant and waiter of a lane below its `view`: a lost release or an orphan
    grant ends here.  `count` increases with each message of the session; the client remembers when
    it sent which, and trusts its locks by *sending* times only.
    `report` is the actor's own statistics (msgpack), shown by `enact actor ls`.
    With `wait_ns` the session listens for recalls: the shard keeps the request so long, at most a
    slice, unless one of its grants is recalled whose number is not in `heard`.
    """

    session: str
    epoch: int
    count: int
    view: tuple[LaneView, ...]
    report: bytes
    wait_ns: int = 0
    heard: tuple[int, ...] = ()


@message
class Commit:
    """Publish all writes of a lock and release it.  Answer: `Committed`, `Fenced` or `Changed`.

    Every slot of `expects` must still be at that version, without a writer (see `Commits`).
    Where other shards have prepared writes, they are the `participants`, and the record of this
    commit decides for them too; it is then forced to the disk, whatever its own data survive.
    `reads` and `reads_left_out` are the lineage of the writes (see `Cause`).
    `keep` asks to keep the grant (see `Committed`).  Under a kept grant, which `token` names,
    `lock` is a later lock of the session, held for `held_ns` as its client knows.
    """

    lock: LockId
    token: Token
    writes: tuple[WriteItem, ...]
    seen_stamp_ns: int
    expects: tuple[SlotVersion, ...] = ()
    participants: tuple[str, ...] = ()
    reads: tuple[DatumRead, ...] = ()
    reads_left_out: int = 0
    keep: bool = False
    held_ns: int = 0


@message
class Stage:
    """Bring a payload to the shard apart from the commit that will name it.  Answer: `Staged`.

    The first one, at offset 0 and without a body, makes room for `total` bytes: on the same host
    the client then fills the shard's file itself.  If it cannot, slices follow, in order; they may
    be repeated.  A total of 0 discards the payload.  Answered by the shard's link, not its core.

    `ahead` asks for so many further files of that length under the next numbers, and for another
    one whenever a commit has named one of them.  Each appears when and if the shard has room: a
    client opens it, and asks for what is not there.
    """

    session: str
    file: str
    offset: int
    total: int
    body: Datum
    ahead: int = 0


@message
class Outcome:
    """Ask what became of a commit.  Answer: `OutcomeIs`."""

    lock: LockId


@message
class Validate:
    """Is this lock still held, without interruption?  If so, release it.

    Answer: `Valid`, `Fenced` or `Changed`.  A token with number 0 stands for a shard where the lock
    holds nothing but expects something.  `keep` is that of `Commit`.
    """

    lock: LockId
    token: Token
    expects: tuple[SlotVersion, ...] = ()
    keep: bool = False


@message
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
    reads: tuple[DatumRead, ...] = ()
    reads_left_out: int = 0


@message
class Finish:
    """Shard to shard: the lock has committed, apply what was prepared.  Answer: `Finished`."""

    lock: LockId
    position: Position


@message
class Resolve:
    """Shard to shard: what became of a lock that `asker` has prepared?  Answer: `Resolved`."""

    lock: LockId
    primary_token: Token
    asker: str


@message
class Release:
    """Give up a lock, its place in the queue and its pinned views.  Answer: `Released`, always."""

    lock: LockId


@message
class Goodbye:
    """End a session.  Answer: `Released`."""

    session: str


@message
class AwaitStamp:
    """Wait until all commits up to a stamp are visible.  Answer: `Reached` (maybe not yet).

    The shard waits only for a session, in the epoch that it knows, at most `WAIT_SLICE_NS_MAX`;
    without one it answers at once.  If a session has more than 64 such questions, the oldest one is
    answered early.
    """

    stamp_ns: int
    wait_ns: int
    session: str = ""
    epoch: int = 0


@message
class Ping:
    """Is a shard there, and does it grant?  Answer: `Pong`, at once; no session is needed."""


@message
class ListPlaces:
    """Where does the shard expect each shard of the cell?  Answer: `Places`; no session is needed.

    A serving shard gives its own name in `shard` (then only that shard itself may ask), and in
    `shards` where it expects each shard, itself included.
    """

    shard: str = ""
    shards: tuple[ShardEntry, ...] = ()


@message
class Survey:
    """List slots without their data.  Answer: `Surveyed`.

    Empty `contexts` or `aspects` mean all; `patterns` are entity patterns, empty means all.
    With `retained` the retained versions of each slot come before its newest one, oldest first.
    Where a watch names with it what it wants, `data` asks for small data in the notices.
    A listing of several pages is no consistent snapshot: each page shows its slots as they are when
    it is requested.
    """

    contexts: tuple[str, ...]
    patterns: tuple[str, ...]
    aspects: tuple[str, ...]
    retained: bool = False
    after: Cursor = START
    data: bool = False


@message
class ListLocks:
    """List holders and waiters.  Answer: `Locks`."""

    after: Cursor = START


@message
class ListSessions:
    """List sessions, catalogue and counters of the shard.  Answer: `Sessions`."""

    after: Cursor = START


@message
class Break:
    """Take a lock away by its grant number, on behalf of an operator.  Answer: `Broken`.

    A restarted shard starts its numbers again: `epoch` is the one in which the number was read (0:
    not stated), so a late copy breaks no other lock.
    """

    number: int
    reason: str
    epoch: int = 0


@message
class ForceAbort:
    """Abort a prepared lock whose primary is permanently lost.  Answer: `Broken`.

    If the primary had decided to commit after all, only a part of the commit takes effect.  Only
    for an operator who knows that the primary never comes back.  `epoch` is that of `Break`.
    """

    number: int
    reason: str
    epoch: int = 0


@message
class ListAudit:
    """List what operators did here.  Answer: `Audited`.

    A text in `settle` acknowledges all alarms so far and describes how they were settled.
    `seen_ns` is the wall-clock stamp of the newest act that the operator had seen (0: unknown), so
    a late copy settles no later alarm.
    """

    settle: str
    seen_ns: int = 0
    after: Cursor = START


@message
class ListRefusals:
    """List which rights clients lacked since the shard's start.  Answer: `Refusals`."""


@message
class ListHistory:
    """List the known versions of slots, oldest first, without their data.  Answer: `Versions`.

    Empty `contexts`, `patterns` or `aspects` mean all.  Only versions that were current after
    `since_ns` (0: all), of each slot the newest `count_max` (0: all).  With `kept` only versions
    that some label keeps.
    """

    contexts: tuple[str, ...]
    patterns: tuple[str, ...]
    aspects: tuple[str, ...]
    since_ns: int = 0
    count_max: int = 0
    kept: bool = False
    after: Cursor = START


@message
class Explain:
    """Ask for these versions with their causes (version 0: the newest).  Answer: `Versions`.

    Forgotten versions are left out.
    """

    versions: tuple[SlotVersion, ...]
    after: Cursor = START


@message
class FindEffects:
    """Ask for all known versions that one of these data went into.  Answer: `Versions`."""

    reads: tuple[DatumRead, ...]
    after: Cursor = START


@message
class Fork:
    """Make a world context with the data of `source` as of a stamp.

    Answer: `Forked`, `Forgotten`, or `Refused` if the context exists and is no such fork.

    Copies no data.  Idempotent: a repeated request gets the same answer.  Like a view as of a
    timestamp it waits a little for undecided commits; if that is not enough, it is refused as
    "overload" and may be repeated.  `epoch` and `count` are those of `Acquire` (0: unknown): with
    them a late copy does not recreate a context that was dropped meanwhile.
    """

    session: str
    world: str
    source: str
    at_ns: int
    epoch: int = 0
    count: int = 0


@message
class DropWorld:
    """Forget a world context with all its data and their history.

    Answer: `Dropped`, or `Refused` while a lock is held in it.  Idempotent.  `epoch` and `count`
    are those of `Fork`: a late copy drops no context that was made since.
    """

    session: str
    world: str
    epoch: int = 0
    count: int = 0


@message
class KeepVersions:
    """Pin versions under a label; without versions: unpin those of the label.

    Answer: `Kept`.  A second request with the same label adds versions.  `epoch` and `count` are
    those of `Fork`: a late copy pins nothing that was unpinned since.  With `after` it changes
    nothing and asks for the next page of the pinned versions.
    """

    session: str
    label: str
    versions: tuple[SlotVersion, ...]
    epoch: int = 0
    count: int = 0
    after: Cursor = START


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
    | ListRefusals
    | Stage
    | ListHistory
    | Explain
    | FindEffects
    | Fork
    | DropWorld
    | KeepVersions
)
PAGED = (
    *(Survey, ListLocks, ListSessions, ListAudit, ListHistory, Explain, FindEffects),
    KeepVersions,
)
"""Requests with a cursor: their answers come in pages."""
