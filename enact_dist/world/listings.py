"""Listings of a cell for people: its aspects, locks, shards, actors and acts of operators."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

from enact_dist.access.asking import answers_to, ask_all, expected
from enact_dist.core.protocol.messages import (
    NO_LIMIT,
    PERMISSION,
    Audited,
    ListAudit,
    ListLocks,
    ListRefusals,
    ListSessions,
    Locks,
    Refusals,
    Refused,
    Sessions,
    Survey,
    Surveyed,
    Welcome,
)
from enact_dist.core.state.retention import limits_of
from enact_dist.errors import LinkError
from enact_dist.link.refusals import error_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from enact_dist.access.session import Session
    from enact_dist.core.protocol.messages import Answer, AspectEntry, Holder, SlotState
    from enact_dist.link.client.locks import CellClient


@dataclass(frozen=True, slots=True)
class AspectInfo:
    """One aspect, as some shards know it in the same way.

    Attributes:
        aspect: Its name.
        type: The fingerprint of its type; "" if there are slots but no type is registered.  A ``=``
            marks fields that have a default.
        durability: What its data survive; "" if no type is registered.
        versions: How many versions of each slot are retained, the newest included; None: no limit.
        age_s: How long a version is retained after it was replaced; None: no limit.
        history_bytes: How many bytes of replaced data are retained; None: no limit.
        shards: The shards that know it so.
        slots: How many slots it has on these shards, null ones included.
        data: How many of these are not null.
        size_bytes: Size of the newest data, each counted as in `SlotInfo`.
        older_types: The fingerprints of the types that this one has succeeded, the oldest first.
    """

    aspect: str
    type: str = ""
    durability: str = ""
    versions: int | None = None
    age_s: float | None = None
    history_bytes: int | None = None
    shards: tuple[str, ...] = ()
    slots: int = 0
    data: int = 0
    size_bytes: int = 0
    older_types: tuple[str, ...] = ()


def aspect_infos(session: Session, world: str = "") -> tuple[AspectInfo, ...]:
    """Return the aspects of all shards; if shards know one differently, one entry for each way.

    Args:
        session: The session that asks.
        world: Only slots of this world context count; "": those of all.

    Raises:
        ShardUnreachableError: A shard does not answer.
    """
    client = session.client
    hellos = [(shard, client.core.hello(shard)) for shard in client.shards()]
    welcomes = answers_to(client, Welcome, hellos)
    surveys = ask_all(client, Surveyed, Survey((world,) if world else (), (), ()))
    found: dict[AspectInfo, AspectInfo] = {}
    for (shard, welcome), (_, survey) in zip(welcomes, surveys, strict=True):
        infos = {entry.name: _info(entry) for entry in welcome.aspects}
        states: dict[str, list[SlotState]] = {name: [] for name in infos}
        for state in survey.states:
            states.setdefault(state.slot.aspect, []).append(state)
        for name, some in states.items():
            info = infos.get(name) or AspectInfo(name)
            before = found.get(info, info)
            found[info] = replace(
                info,
                shards=(*before.shards, shard),
                slots=before.slots + len(some),
                data=before.data + sum(not state.null_reason for state in some),
                size_bytes=before.size_bytes + sum(state.size for state in some),
            )
    return tuple(sorted(found.values(), key=lambda info: (info.aspect, info.shards)))


def _info(entry: AspectEntry) -> AspectInfo:
    versions, age_ns, size = (None if one == NO_LIMIT else one for one in limits_of(entry))
    return AspectInfo(
        entry.name,
        entry.fingerprint,
        entry.durability,
        versions,
        None if age_ns is None else age_ns / 1e9,
        size,
        older_types=entry.older,
    )


RUNNING: Final = ("starting", "running", "stuck")
"""States in the report of an actor that has not ended."""


@dataclass(frozen=True, slots=True)
class LockInfo:
    """One lock that is held or awaited at a shard; times in seconds.

    Attributes:
        number: What `Cell.break_lock` takes; unique within the shard's epoch.
        modes: "read", "write" or both.
        hold_left_s: None of a kept grant: each of its blocks has its `hold_s` from its begin on,
            which its shard does not know.
        waits_for: Numbers of the locks that block it.
        kept: How a grant is used that stays with its session between two blocks: "unused" (it ends
            as soon as another lock asks for its data), "used", "far" (on a host without memory in
            common, so the shard does not know), or "recalled" (another lock waits for it: it ends
            with its block, or once a far session has heard); "" of any other lock.
    """

    shard: str
    number: int
    lock_id: str
    actor: str
    host: str
    pid: int
    granted: bool
    modes: str
    age_s: float
    lease_left_s: float
    hold_left_s: float | None
    slots: tuple[str, ...]
    waits_for: tuple[int, ...]
    kept: str = ""

    @property
    def state(self) -> str:
        """How it stands, as `enact lock ls` shows it; "kept" delays no other lock for long."""
        if not self.granted:
            return "waits"
        return _STATES.get(self.kept, "held")


_STATES: Final = {"unused": "kept", "far": "kept", "used": "kept, used", "recalled": "recalled"}


@dataclass(frozen=True, slots=True)
class ShardInfo:
    """One shard of the cell; `reachable` False leaves everything else at zero.

    Attributes:
        reachable: Whether it answers, over a carrier that this process may use.
        open: Whether it grants locks; False while it waits for older leases to end after a start,
            and while it ends.
        size_bytes: Size of the newest data, each counted as in `SlotInfo`.
        clock_ahead_s: How far its wall clock is ahead of ours, corrected by half a round trip.
        round_trip_s: Duration of the call that asked.
        carrier: How this process reaches it: "socket", or "zenoh" and why.
        counters: Its statistics by name.
        problem: Why it is not reachable; empty if it just does not answer.
    """

    name: str
    endpoint: str
    reachable: bool
    epoch: int = 0
    open: bool = False
    uptime_s: float = 0.0
    slots: int = 0
    size_bytes: int = 0
    sessions: int = 0
    locks: int = 0
    clock_ahead_s: float = 0.0
    round_trip_s: float = 0.0
    carrier: str = ""
    counters: dict[str, int] = field(default_factory=dict)
    problem: str = ""


@dataclass(frozen=True, slots=True)
class ActorInfo:
    """One session of a named actor, as the shards see it.

    Attributes:
        lease_left_s: Below 0: time since its lease expired without contact to a shard.
        report: The actor's own statistics; empty if it sends none.
        namesakes: Other sessions, none of them silent, with an actor of the same name.
    """

    actor: str
    host: str
    pid: int
    session: str
    shards: tuple[str, ...]
    lease_left_s: float
    locks: int
    report: dict[str, Any] = field(default_factory=dict)
    namesakes: tuple[str, ...] = ()

    @property
    def silent(self) -> bool:
        """Whether its lease is over, so that its last report no longer describes its state."""
        return self.lease_left_s < 0.0

    def rows(self) -> list[dict[str, Any]]:
        """Return the reports of its actors that have a name; a client may send anything."""
        rows = self.report.get("actors")
        rows = rows if isinstance(rows, (list, tuple)) else ()
        return [row for row in rows if isinstance(row, dict) and row.get("name")]

    def names(self) -> frozenset[str]:
        """Return the names of the actors that run in this session, as they report it."""
        return frozenset(str(row["name"]) for row in self.rows() if row.get("state") in RUNNING)


@dataclass(frozen=True, slots=True)
class AuditInfo:
    """An act of an operator at a shard, or its outcome.

    Attributes:
        stamp_s: When, by the shard's wall clock, seconds since 1970.
        kind: "broken" or "forced" (the act), "confirmed" or "alarm" (the answer of a lost shard
            once it was back), "settled" (an operator has settled all earlier alarms).
        text: Who or what, and the reason that was given.
        identity: Who asked for it, as actor@host:pid; empty for the shard's own findings.
    """

    shard: str
    stamp_s: float
    kind: str
    text: str
    identity: str = ""


@dataclass(frozen=True, slots=True)
class RefusalInfo:
    """A right that a client of a shard lacked.

    Attributes:
        shard: The shard that refused.
        identity: Whose rights the requests used; "-" for clients whose names are not proven.
        right: The right that was missing; "write" if any of its parts would have sufficed.
        what: On what, as rules in `cell.toml` name it, such as "online:plan/*/joints".
        count: How often, since the shard's start.
        first_s: When first, by the shard's wall clock, seconds since 1970.
        last_s: When last.
    """

    shard: str
    identity: str
    right: str
    what: str
    count: int
    first_s: float
    last_s: float


def lock_infos(client: CellClient, shards: Iterable[str] | None) -> tuple[LockInfo, ...]:
    """Return all locks of some shards (None: all), oldest first within each."""
    return tuple(
        lock_info(shard, holder)
        for shard, answer in ask_all(client, Locks, ListLocks(), shards)
        for holder in answer.holders
    )


def audit_infos(client: CellClient, shards: Iterable[str] | None) -> tuple[AuditInfo, ...]:
    """Return the acts of operators at some shards (None: all), oldest first."""
    found = [
        AuditInfo(shard, entry.wall_ns / 1e9, entry.kind, entry.text, entry.identity)
        for shard, answer in ask_all(client, Audited, ListAudit(""), shards)
        for entry in answer.entries
    ]
    return tuple(sorted(found, key=lambda entry: entry.stamp_s))


def settle_alarms(client: CellClient, shard: str, how: str) -> None:
    """Acknowledge all alarms of a shard so far."""
    ((_, seen),) = ask_all(client, Audited, ListAudit(""), (shard,))
    newest_ns = max((entry.wall_ns for entry in seen.entries), default=0)
    expected(Audited, ListAudit, client.call(shard, ListAudit(how, newest_ns)))


def refusal_infos(client: CellClient, shards: Iterable[str] | None) -> tuple[RefusalInfo, ...]:
    """Return the rights that clients of some shards (None: all) lacked."""
    return tuple(
        RefusalInfo(
            shard, one.subject, one.right, one.what, one.times,
            one.first_ns / 1e9, one.last_ns / 1e9,
        )
        for shard, answer in ask_all(client, Refusals, ListRefusals(), shards)
        for one in answer.entries
    )  # fmt: skip


def actor_infos(answers: Iterable[tuple[str, Answer | None]]) -> tuple[ActorInfo, ...]:
    """Return the sessions of named actors, from the answers of all shards that answered."""
    found: dict[str, ActorInfo] = {}
    for shard, answer in answers:
        for info in answer.sessions if isinstance(answer, Sessions) else ():
            if not info.actor:
                continue
            before = found.get(info.session)
            left_s = info.lease_left_ns / 1e9
            found[info.session] = ActorInfo(
                info.actor,
                info.host,
                info.pid,
                info.session,
                (*(before.shards if before else ()), shard),
                max(left_s, before.lease_left_s) if before else left_s,
                info.locks + (before.locks if before else 0),
                unpacked_report(info.report) or (before.report if before else {}),
            )
    infos = sorted(found.values(), key=lambda info: (info.actor, info.session))
    return tuple(_with_namesakes(infos))


def sessions_named(client: CellClient, name: str) -> tuple[ActorInfo, ...]:
    """Return the other sessions of actors of a name that are not silent."""
    shards = client.shards()
    answers = client.call_once([(shard, ListSessions()) for shard in shards])
    return tuple(
        info
        for info in actor_infos(zip(shards, answers, strict=True))
        if name in (info.actor, *info.names())
        and not info.silent
        and info.session != client.core.session
    )


def _with_namesakes(infos: list[ActorInfo]) -> Iterator[ActorInfo]:
    sessions: dict[str, list[str]] = {}
    for info in infos:
        for name in info.names() if not info.silent else ():
            sessions.setdefault(name, []).append(info.session)
    for info in infos:
        same = {other for name in info.names() for other in sessions.get(name, ())}
        others = tuple(sorted(same - {info.session}))
        yield replace(info, namesakes=others) if others else info


def unpacked_report(encoded: bytes) -> dict[str, Any]:
    """Return an actor's report; empty if invalid, since a client may send anything."""
    import msgpack

    try:
        report = msgpack.unpackb(encoded) if encoded else {}
    except (ValueError, msgpack.UnpackException):
        return {}
    return report if isinstance(report, dict) else {}


def lock_info(shard: str, holder: Holder) -> LockInfo:
    """Return a shard's description of a lock in seconds."""
    return LockInfo(
        shard,
        holder.number,
        str(holder.lock),
        holder.actor,
        holder.host,
        holder.pid,
        holder.granted,
        holder.modes,
        holder.age_ns / 1e9,
        holder.lease_left_ns / 1e9,
        None if holder.kept else holder.hold_left_ns / 1e9,
        holder.slots,
        holder.waits_for,
        holder.kept,
    )


def shard_info(client: CellClient, shard: str) -> ShardInfo:
    """Return what is known of a shard; one that cannot be asked is described with why."""
    try:
        return _asked_info(client, shard)
    except LinkError as error:
        return away_info(client, shard, str(error))


def _asked_info(client: CellClient, shard: str) -> ShardInfo:
    question = (shard, ListSessions())
    if client.core.needs_hello(shard):
        # Its welcome names the carrier of later calls.  A silent shard is waited for only once.
        hello = (shard, client.core.hello(shard))
        if client.call_once([hello, question])[1] is None:
            return away_info(client, shard, client.carrier.reason_away(shard))
    started_s = time.monotonic()
    answer = client.call_once([question])[0]
    round_trip_s = time.monotonic() - started_s
    raise_denied(answer)
    if not isinstance(answer, Sessions):
        return away_info(client, shard, client.carrier.reason_away(shard))
    return answered_info(client, shard, answer, round_trip_s)


def raise_denied(answer: Answer | None) -> None:
    """Raise if a shard answers, and this client has no right to ask that.

    Raises:
        PermissionDeniedError: It has none; a listing would otherwise show the shard as away.
    """
    if isinstance(answer, Refused) and answer.code == PERMISSION:
        raise error_of(answer)


def away_info(client: CellClient, shard: str, problem: str) -> ShardInfo:
    """Return what is known of a shard that does not answer."""
    endpoint = client.carrier.endpoint_of(shard)
    return ShardInfo(shard, endpoint, reachable=False, problem=problem)


def answered_info(
    client: CellClient, shard: str, answer: Sessions, round_trip_s: float
) -> ShardInfo:
    """Return what the answer of a shard tells about it; the call took `round_trip_s`."""
    ahead_ns = answer.wall_ns - time.time_ns() + round_trip_s * 1e9 / 2
    return ShardInfo(
        shard,
        client.carrier.endpoint_of(shard),
        reachable=True,
        epoch=answer.epoch,
        open=answer.open,
        uptime_s=answer.uptime_ns / 1e9,
        slots=answer.slots,
        size_bytes=answer.bytes,
        sessions=len(answer.sessions),
        locks=sum(session.locks for session in answer.sessions),
        clock_ahead_s=ahead_ns / 1e9,
        round_trip_s=round_trip_s,
        carrier=client.carrier.transport_of(shard),
        counters={counter.name: counter.value for counter in answer.counters},
    )
