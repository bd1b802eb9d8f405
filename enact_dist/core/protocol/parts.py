"""The parts of several messages; see `core.protocol.messages`."""

from __future__ import annotations

from typing import Final, NamedTuple

from enact_dist.core.protocol.datum import Datum, LockId, Slot, Token


class Cursor(NamedTuple):
    """Where a listing continues: made by a shard for itself, and returned to it unchanged.

    Epoch 0 means the start in a request, and the end of the listing in an answer.
    The other fields name the last entry: by `names` and `number`, and among the versions of one
    slot by `version`.
    """

    epoch: int = 0
    names: tuple[str, ...] = ()
    number: int = 0
    version: int = 0


START: Final = Cursor()
"""The start of a listing; in an answer, its end."""

NO_LIMIT: Final = 1 << 62
"""Represents "no limit"; below the wire's largest integer, since messages may carry it."""


ITEMS_MAX: Final = 4096
"""Most lines of one lock and most writes of one commit.  A shard grants a lock, and applies a
commit, in one step, which is what makes them atomic, and serves no other client meanwhile: about
8 us for each slot, so 30 ms for so many, and half a second for 65,536."""
HOLD_NS_MAX: Final = 24 * 3600 * 1_000_000_000
"""A lock is held for a day at most; then the client must request it again."""
REPORT_BYTES_MAX: Final = 4096
"""Longest report of an actor that a shard keeps; a client refuses to send a longer one."""
INLINE_BYTES_MAX: Final = 64 << 10
"""Data up to this size travel with their commit and their grant; larger ones are payloads, and are
fetched when they are read."""


class Item(NamedTuple):
    """One line of a lock or view: `access` is an `enact_dist.terms.Access` number.

    `entity` is a pattern if the access is one of the `…_EACH`.  `known` is the version that the
    client still has from this epoch (0: none): an unchanged datum is not sent again.
    `captured_ns` (in a `VIEW`, or in a `READ` that replaces one because no consistent snapshot was
    found) asks for the newest retained version with that capture stamp; if there is none, the slot
    shows as null outside retention.  `nearest` asks for the version whose capture stamp is nearest
    to `captured_ns`; if two are equally near, for the later one.
    """

    access: int
    context: str
    entity: str
    aspect: str
    known: int = 0
    captured_ns: int = 0
    nearest: bool = False


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
    """The holder or waiter of a lock, for messages to people.

    `kept` says of a grant that stays with its session between two blocks how it is used: "unused",
    "used", "far" (its session shares no memory with the shard, which does not know), or "recalled"
    (another lock waits for one that was used or far); "" of any other.
    """

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
    kept: str = ""


class WriteItem(NamedTuple):
    """One slot to set at commit; `datum` None writes null."""

    slot: Slot
    datum: Datum | None


class SlotVersion(NamedTuple):
    """A slot and one of its versions."""

    slot: Slot
    version: int


class DatumRead(NamedTuple):
    """One datum that went into a commit.

    Versions of a volatile slot start again with its shard; the stamp tells them apart.
    """

    slot: Slot
    version: int
    stamp_ns: int


READS_MAX: Final = 1024
"""Most data that one commit names as read; further ones are only counted."""


class Cause(NamedTuple):
    """Where a version comes from: who committed it, when, and what went in.

    Attributes:
        lock: The lock that committed it; over several shards all causes of a commit name the same.
        kind: One of `CAUSE_*`.
        actor: Name of the session, "" if it has none.
        stamp_ns: Stamp of the commit.
        held_ns: How long the lock had been held when its commit, or its promise, reached the shard.
        reads: Every datum that the lock read or viewed; of a pattern, and of replaced data, those
            that its block accessed.
        reads_left_out: Number of further ones beyond the limit of a message.
        writes: What the commit set on this shard.
    """

    lock: LockId
    kind: str
    actor: str
    host: str
    pid: int
    stamp_ns: int
    held_ns: int
    reads: tuple[DatumRead, ...]
    reads_left_out: int
    writes: tuple[SlotVersion, ...]


CAUSE_COMMIT = "commit"
CAUSE_FORK = "fork"


class VersionEntry(NamedTuple):
    """One version of a slot's history, without its datum.

    `until_ns` is the stamp of the version that replaced it (0: it is the newest; its own stamp if
    a label pins it and the next one is forgotten).  `kept` are the labels that pin it.  `cause` is
    None if it is not known.  A version that a restart has lost is version 0.
    """

    state: SlotState
    until_ns: int
    kept: tuple[str, ...]
    cause: Cause | None


class WorldEntry(NamedTuple):
    """A world context; a fork names its source and the timestamp of the fork."""

    name: str
    source: str = ""
    at_ns: int = 0


class LaneView(NamedTuple):
    """The lowest seq of a lane that its client still wants."""

    lane: int
    seq: int


class GrantLeft(NamedTuple):
    """A live grant as the shard sees it.

    `far`: it is kept `FAR`.  A client that does not know of it, because the answer that said so
    was lost, gives it back, by a `Release` of `lock`.
    `recalled`: it is far, and another lock waits for it: it is to be given back once no block uses
    it.
    """

    lock: LockId
    token: Token
    hold_left_ns: int
    far: bool = False
    recalled: bool = False


NO_PLACE: Final = 0
"""The place of a lock that waits for news and has not entered the queue."""
NOT_KEPT: Final = 0
"""Of a grant that is over."""
PROVE: Final = 1
"""It is over, too, and the client shall first lock byte 0 of its page, which proves that the shard
sees the locks of this client's files; or it shall ask for word of recalls (`KeepAlive.wait_ns`)."""
PLACES: Final = 2
"""From here on: the grant stays with its session, and its number stands in the cell of this number
less `PLACES`."""
FAR: Final = 255
"""It stays without a cell: client and shard share no memory, and word tells when it is recalled."""
MERELY_KEPT: Final = ("unused", "far")
"""What `Holder.kept` says of a grant that ends when another lock asks, as far as known."""


class AspectEntry(NamedTuple):
    """An aspect of the catalogue: its type's fingerprint and its durability ("" = not stated).

    `older` are the fingerprints of the types that this one has succeeded, the oldest first
    (`core.protocol.datum_types`).  `reads` says in a registration that its client only reads: it
    does not change the type of a known aspect.

    The rest says how much of each slot's history stays: `retention` versions, the newest one
    included, replaced at most `age_ns` ago, of `size` bytes of replaced data.  0 means not
    stated: if all three are 0, `terms.Retention()` holds, else a figure of 0 means no limit.  Of
    several requests, the largest figures count.
    """

    name: str
    fingerprint: str
    durability: str
    retention: int = 0
    age_ns: int = 0
    size: int = 0
    older: tuple[str, ...] = ()
    reads: bool = False


class ShardEntry(NamedTuple):
    """A shard of the cell and the endpoints at which it can be reached."""

    name: str
    endpoints: tuple[str, ...]


class Pin(NamedTuple):
    """Entities that a placement keeps on one shard, by name pattern."""

    pattern: str
    shard: str


class PlacementMap(NamedTuple):
    """The shards of the cell and its pinned entities; `version` names this state."""

    version: int
    shards: tuple[ShardEntry, ...]
    pins: tuple[Pin, ...]


class SessionInfo(NamedTuple):
    """One session at a shard, for `enact actor ls` and `enact shard ls`.

    `lease_left_ns` below 0 is the time since its lease ended.
    """

    session: str
    actor: str
    host: str
    pid: int
    lease_left_ns: int
    token_present: bool
    locks: int
    report: bytes


class AuditEntry(NamedTuple):
    """An operator's act at a shard, or its outcome.

    `kind` is one of `core.shard.forced_aborts`.
    `identity` is who asked for it ("": the shard itself, or a release before this one kept it).
    """

    wall_ns: int
    kind: str
    text: str
    identity: str = ""


class RefusalEntry(NamedTuple):
    """A right that a client lacked, how often, and when first and last by the wall clock.

    `what` is on what, as rules in `cell.toml` name it.
    """

    subject: str
    right: str
    what: str
    times: int
    first_ns: int
    last_ns: int


class Counter(NamedTuple):
    """One named statistic of a shard."""

    name: str
    value: int
