"""Records that a shard stores and recovers, its effects, and its events that are no requests.

A store has one duty: `Persist` is applied whole or not at all, in order, and reported done only
when it survives what its durability promises.  Everything else is decided in the core.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Final

from enact_dist.core.protocol.datum import Datum, LockId, Position, Slot, Token, message
from enact_dist.core.protocol.messages import AspectEntry, Cause, Item, SlotVersion, WriteItem
from enact_dist.terms import Durability, NullReason


@message
class SessionRecord:
    """A session that may hold locks: after a restart the grace waits for it.

    `identity` is its owner ("" if an older release, which stored none, has written the record).
    """

    session: str
    ttl_ns: int
    identity: str = ""


@message
class SessionEnded:
    """A session that ended or stayed away: drop it, and later its outcomes."""

    session: str
    wall_ns: int


@message
class WorldRecord:
    """A world context exists; a fork names its source and timestamp."""

    name: str
    source: str = ""
    at_ns: int = 0


@message
class WorldDropped:
    """A world context and all states of its slots are gone.

    If it is made again, its versions start above `version_base`: none is ever used twice.  Those of
    `entity_bases` were moved here with slots of another shard, where they started above these.
    """

    name: str
    version_base: int
    entity_bases: tuple[tuple[str, int], ...] = ()


@message
class AspectForgotten:
    """An aspect is no longer registered, and all states of its slots are gone.

    If it is registered again, versions of its slots start above `version_base`: none is ever used
    twice.  What they were up to the stamp `at_ns` is not known.  For the entities of `entity_bases`
    it is another version and another stamp: these are from a shard that forgot the aspect at
    another time, or never.
    """

    name: str
    version_base: int
    at_ns: int
    entity_bases: tuple[tuple[str, int, int], ...] = ()


@message
class BasesMoved:
    """The version bases of a dropped context or aspect, when entities move; drops nothing."""

    base: WorldDropped | AspectForgotten


@message
class EntitiesMoved:
    """All slots of these entities lie at another shard: forget them with their history."""

    entities: tuple[str, ...]


@message
class AspectRecord:
    """An aspect is registered (again)."""

    entry: AspectEntry


@message
class SlotRecord:
    """The new state of a slot, replacing the previous one, which stays if `history` is set.

    `volatile` records only say that the slot exists: neither version nor datum is kept.  Where the
    bytes are those of another version that is stored here, `same_as` names it, so that they need
    not be stored twice.
    """

    slot: Slot
    version: int
    stamp_ns: int
    datum: Datum | None
    null_reason: str
    volatile: bool = False
    history: bool = False
    cause: Cause | None = None
    same_as: SlotVersion | None = None


@message
class Content:
    """The committed state of one slot; replaced, never changed.

    `bytes` is what `own_bytes` says of it, or -1 as long as that has not been counted.
    """

    version: int
    stamp_ns: int
    datum: Datum | None
    null_reason: NullReason
    cause: Cause | None = None
    bytes: int = field(default=-1, compare=False)


NOTHING: Final = Content(0, 0, None, NullReason.NEVER_SET)
"""The state of a slot that was never written."""
LOST: Final = Content(0, 0, None, NullReason.LOST)
"""The state of a volatile slot after a restart of its shard."""


READ_BYTES: Final = 400
"""About what one datum that a cause names takes in memory: its slot, version and stamp."""


def cause_bytes(cause: Cause) -> int:
    """Return about how much memory one of the versions that share a cause takes for it."""
    return READ_BYTES * len(cause.reads) // max(1, len(cause.writes))


def own_bytes(content: Content) -> int:
    """Return the bytes that a state holds in the memory of the shard alone, lineage included.

    Data that a restart has found in a file are mapped, and read when they are asked for.
    """
    if content.bytes >= 0:
        return content.bytes
    datum, cause = content.datum, content.cause
    size = datum.size if datum is not None and not datum.file and datum.fault is None else 0
    return size if cause is None or not cause.reads else size + cause_bytes(cause)


def content_of(record: SlotRecord) -> Content:
    """Return the state that a record has kept; of a volatile slot, that it is lost."""
    if record.volatile:
        return LOST
    reason = NullReason[record.null_reason] if record.null_reason else NullReason.DELETED
    return Content(record.version, record.stamp_ns, record.datum, reason, record.cause)


@message
class HistoryForgotten:
    """Replaced versions that are kept no longer."""

    versions: tuple[SlotVersion, ...]


@message
class KeptRecord:
    """Versions that stay, whatever their retention, while the label does; replaces its last one.

    No versions: the label is gone.
    """

    label: str
    versions: tuple[SlotVersion, ...]


@message
class OutcomeRecord:
    """What a lane's newest commit did; replaces the lane's one before."""

    lock: LockId
    position: Position
    versions: tuple[SlotVersion, ...]


@message
class PreparedRecord:
    """Writes of a lock that another shard decides about; a restart restores it with its locks.

    `items` is what the lock holds here, reads included.  `writes` carry their data whatever their
    aspect's durability: a commit that is reported later must not have lost them to a restart.
    """

    lock: LockId
    token: Token
    items: tuple[Item, ...]
    writes: tuple[WriteItem, ...]
    versions: tuple[SlotVersion, ...]
    stamp_ns: int
    primary: str
    primary_token: Token
    cause: Cause | None = None


@message
class PreparedEnded:
    """A prepared lock was decided about; forget its record."""

    lock: LockId


@message
class DecisionRecord:
    """This shard has committed a lock for all its participants too, which must be notified."""

    lock: LockId
    position: Position
    participants: tuple[str, ...]


@message
class DecisionDone:
    """Every participant has finished; forget the decision."""

    lock: LockId


@message
class AuditRecord:
    """An operator's action or its outcome, stored permanently.

    `kind` is one of `core.state.audit`.
    `identity` is who asked for it; "" for what the shard found by itself.
    """

    wall_ns: int
    text: str
    kind: str = "broken"
    identity: str = ""


@message
class ForcedRecord:
    """A prepared lock that an operator aborted: its primary must still be asked for its decision.

    `slots` are those that it would have written here.
    """

    lock: LockId
    primary: str
    primary_token: Token
    slots: tuple[Slot, ...]


@message
class ForcedEnded:
    """The primary has reported its decision on such a lock; forget the record."""

    lock: LockId


Record = (
    SessionRecord
    | SessionEnded
    | WorldRecord
    | WorldDropped
    | AspectForgotten
    | BasesMoved
    | EntitiesMoved
    | AspectRecord
    | SlotRecord
    | HistoryForgotten
    | KeptRecord
    | OutcomeRecord
    | PreparedRecord
    | PreparedEnded
    | DecisionRecord
    | DecisionDone
    | AuditRecord
    | ForcedRecord
    | ForcedEnded
)


@dataclass(slots=True)
class Recovered:
    """Everything a store held when it was opened.  `epoch` is already the new, durable one.

    `slots` are the newest states, `history` the replaced ones, oldest first within each slot.
    """

    epoch: int
    sessions: list[SessionRecord] = field(default_factory=list)
    worlds: list[WorldRecord] = field(default_factory=list)
    dropped: list[WorldDropped] = field(default_factory=list)
    aspects: list[AspectEntry] = field(default_factory=list)
    forgotten: list[AspectForgotten] = field(default_factory=list)
    slots: list[SlotRecord] = field(default_factory=list)
    history: list[SlotRecord] = field(default_factory=list)
    kept: list[KeptRecord] = field(default_factory=list)
    outcomes: list[OutcomeRecord] = field(default_factory=list)
    prepared: list[PreparedRecord] = field(default_factory=list)
    decisions: list[DecisionRecord] = field(default_factory=list)
    forced: list[ForcedRecord] = field(default_factory=list)
    audit: list[AuditRecord] = field(default_factory=list)


# ---------------------------------------------------------------- effects of the shard


@message
class Reply:
    """Answer the request that came in under this handle."""

    reply_to: int
    answer: object


@message
class Persist:
    """Keep these records; report `Persisted(ticket)` when done (ticket 0: no report wanted)."""

    ticket: int
    records: tuple[Record, ...]
    durability: Durability


@message
class Publish:
    """Publish a notice to the watchers."""

    notice: object


@message
class Call:
    """Ask another shard, once; an answer comes back as `Called`, none needs no report."""

    shard: str
    request: object


@message
class Compare:
    """Ask which daemons serve a shard at these places; the answer comes back as `Served`."""

    shard: str
    places: tuple[str, ...]


@message
class LogEvent:
    """One line for the log: what the shard decided and about whom; `grave` needs people."""

    event: str
    text: str
    grave: bool = False


Effect = Reply | Persist | Publish | Call | Compare | LogEvent
Then = Callable[[int], Iterable[Effect]]
"""How the shard goes on once records are kept: the time by then, to further effects."""


# ---------------------------------------------------------------- events that are no requests


@message
class Persisted:
    """The store has done what `Persist(ticket)` asked for."""

    ticket: int


@message
class Called:
    """Another shard has answered what `Call` asked it."""

    shard: str
    request: object
    answer: object


@message
class ShardReturned:
    """Another shard has come (back) into reach; a hint, which may come late, twice or never."""

    shard: str


@message
class Served:
    """The daemons that serve a shard at the places of a `Compare`, each by its random start number.

    `text` is for the operator: where they are, and what to do.
    """

    shard: str
    starts: tuple[int, ...]
    text: str


@message
class SessionSeen:
    """A session's liveliness token, declared under this identity, appeared or vanished."""

    session: str
    present: bool
    identity: str = ""


@message
class SessionDied:
    """The kernel has reported that a session's process has ended; no message can do that.

    The reporter must be sure: a lost connection alone proves nothing.
    """

    session: str


@message
class SessionBarred:
    """The name of a session may not use this shard any more, as the transport enforces."""

    session: str


@message
class Tick:
    """Time has passed; the inbox was empty."""


@message
class Drain:
    """The shard is about to stop: grant nothing new, answer parked requests."""


@message
class MakeRoom:
    """The cap of shared memory is reached: release this many bytes of history, oldest first."""

    bytes: int


Event = (
    Persisted
    | Called
    | ShardReturned
    | Served
    | SessionSeen
    | SessionDied
    | SessionBarred
    | Tick
    | Drain
    | MakeRoom
)
