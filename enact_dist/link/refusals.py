"""The errors that a user gets for calls and locks that did not succeed, and their texts.

Each text states what was requested, what was found, who holds it and what to do.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

from enact_dist.core.client.lock import MultiLock
from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.messages import (
    CLOCK_SKEW,
    DAMAGED,
    DATUM_TYPE,
    HELD,
    NO_ROOM,
    OVERLOAD,
    PERMISSION,
    PROTOCOL,
    TOO_LONG,
    UNKNOWN_ASPECT,
    UNKNOWN_WORLD,
    VALUE,
    Answer,
    Forgotten,
    Holder,
    Item,
    Refused,
)
from enact_dist.core.state.grants import HELD_TOO_LONG
from enact_dist.errors import (
    SHARD_RESTARTED,
    ChangedError,
    ClockSkewError,
    CommitUnknownError,
    DatumTypeError,
    EnactError,
    ForgottenError,
    LeaseLostError,
    LinkError,
    LockTimeoutError,
    MisuseError,
    NoRoomError,
    PermissionDeniedError,
    ProtocolError,
    ShardUnreachableError,
    StoreError,
    UnknownWorldError,
)
from enact_dist.terms import ACCESSES

if TYPE_CHECKING:
    from enact_dist.link.carrier import Carrier


_CLASSES: Final[dict[str, type[EnactError]]] = {
    DATUM_TYPE: DatumTypeError,
    UNKNOWN_ASPECT: MisuseError,
    VALUE: MisuseError,
    HELD: MisuseError,
    PROTOCOL: ProtocolError,
    TOO_LONG: MisuseError,
    OVERLOAD: LinkError,
    NO_ROOM: NoRoomError,
    DAMAGED: StoreError,
}
"""The exception of each code of a refusal; any other code is a `LinkError`."""

_OF_A_RIGHT: Final = ("identity", "right", "rule", "world", "entity", "aspect")
"""The facts of a missing right, as attributes of its error."""


def unreachable(
    shard: str, waited_s: float, carrier: Carrier, *, runs: bool = False
) -> ShardUnreachableError:
    """Return the error for a shard that does not answer, though it may run (`runs`)."""
    endpoint = carrier.endpoint_of(shard)
    refused = carrier.reason_away(shard)
    advice = refused or (
        f"is it running? (enact shard ls; enact shard run {shard})"
        if not runs
        else "it runs, so its disk may be stalled: see its log"
    )
    return ShardUnreachableError(
        f"shard {shard} at {endpoint} did not answer for {waited_s:.1f} s; {advice}",
        shard=shard,
        endpoint=endpoint,
    )


def not_granted(
    lock: MultiLock,
    waited_s: float,
    carrier: Carrier,
    asked: tuple[Item, ...],
) -> EnactError:
    """Return the error for a lock, or a view, that ended before it was granted."""
    if lock.phase is Phase.REFUSED and lock.refusal is not None:
        return error_of(lock.refusal)
    if lock.phase is Phase.UNREACHABLE:
        return unreachable(lock.silent_shard, waited_s, carrier)
    wanted = _wanted(lock)
    if lock.plan.past_ns:
        return LockTimeoutError(
            f"waited {waited_s:.1f} s to see {wanted} as of {moment_name(lock.plan.past_ns)}: a"
            " commit with an earlier timestamp is still undecided, or a shard keeps restarting; the"
            " shard that decides it may be away (enact shard ls; enact lock ls)",
            waited_s=waited_s,
        )
    holders = tuple(holder_line(holder) for holder in lock.blockers)
    if lock.phase is Phase.MISPLACED:
        return LinkError(
            f"the shards do not agree on where {wanted} lies: they were started with different"
            " cell.toml files; start all of them with the same one"
        )
    if lock.phase is Phase.RELEASED:
        return LockTimeoutError(
            f"interrupted after waiting {waited_s:.1f} s for {wanted}; nothing is held",
            holders=holders,
            waited_s=waited_s,
        )
    if lock.phase is Phase.LOST:
        why = f"each grant was lost again: {lock.cause}"
    elif holders:
        why = "; ".join(holders)
    else:
        why = "the shard grants nothing yet: it restarted and waits for older leases to end"
    remedy = "raise wait_s, or hold the lock for less time"
    if not any(ACCESSES[item.access].locks for item in asked):  # a view: it has no wait_s
        remedy = "try again, or raise request_timeout_s of connect(…)"
    return LockTimeoutError(
        f"waited {waited_s:.1f} s for {wanted}; {why}; {remedy}",
        holders=holders,
        waited_s=waited_s,
    )


def not_committed(
    lock: MultiLock, finish_s: float, carrier: Carrier, *, name: str = ""
) -> EnactError:
    """Return the error for a lock that ended without committing.

    `name` identifies the commit for `Cell.outcome`.
    """
    if lock.phase is Phase.REFUSED and lock.refusal is not None:
        return error_of(lock.refusal)
    if lock.phase is Phase.UNKNOWN:
        why = lock.cause or f"no answer came for {finish_s:.1f} s"
        ask = "" if why.startswith(SHARD_RESTARTED) else f", or ask later: cell.outcome({name!r})"
        return CommitUnknownError(
            f"the commit of lock {lock.lock} ({_wanted(lock)}) was sent, and {why}; whether it took"
            f" effect is unknown; read the data before writing them again{ask}",
            lock_id=name,
        )
    if lock.phase is Phase.UNREACHABLE:
        return unreachable(lock.silent_shard, finish_s, carrier)
    if lock.phase is Phase.CHANGED:
        return ChangedError(
            f"{lock.cause}; nothing was written: take the lock again and redo the work with the"
            " current data, or use Read, so that no other client can change it",
        )
    remedy = "take the lock again and redo the work"
    if lock.cause.startswith(HELD_TOO_LONG):
        remedy = "raise hold_s, or shorten the block: read with a View and compute first"
    return LeaseLostError(
        f"lock {lock.lock} on {_wanted(lock)} was lost: {lock.cause}; nothing was written;"
        f" {remedy}",
        cause=lock.cause,
    )


def _wanted(lock: MultiLock) -> str:
    names = [
        f"{item.entity}/{item.aspect} in {item.context}"
        for _, items in (*lock.plan.locks, *lock.plan.views)
        for item in items
    ]
    shown = ", ".join(dict.fromkeys(names[:4]))
    return shown + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def holder_line(holder: Holder) -> str:
    """Return one line about a holder or waiter of a lock, for an error message."""
    state = "held" if holder.granted else "awaited"
    return (
        f"{', '.join(holder.slots)} {state} by {holder.actor or 'client'}@{holder.host}"
        f" pid {holder.pid} (lock {holder.number}) for {holder.age_ns / 1e9:.1f} s"
    )


def moment_name(stamp_ns: int) -> str:
    """Return a timestamp as people and `fromisoformat` read it, in this host's time zone."""
    seconds, rest_ns = divmod(stamp_ns, 1_000_000_000)
    try:
        local = time.localtime(seconds)
        clock, zone = time.strftime("%Y-%m-%d %H:%M:%S", local), time.strftime("%z", local)
    except (OverflowError, ValueError, OSError):
        return f"stamp {stamp_ns}"
    return f"{clock}.{rest_ns // 1_000_000:03d}{zone[:3]}:{zone[3:5]}"


def forgotten(answer: Forgotten) -> ForgottenError:
    """Return the error for a past state that its shard no longer keeps.

    The answer does not say which of the two reasons applies.
    """
    # Rounded up: a time copied from this text must not be earlier.
    known = (
        f"everything requested is known from {moment_name(answer.oldest_ns + 999_999)} on (stamp"
        f" {answer.oldest_ns})"
        if answer.oldest_ns
        else "none of it is known"
    )
    return ForgottenError(
        f"the requested state of {answer.slot} is older than its retention, or than the last `enact"
        f" shard forget {answer.slot.aspect or '…'}`; {known}; ask for a later time, or keep more"
        " from now on with a larger Aspect(…, retention=…) or in cell.toml",
        oldest_ns=answer.oldest_ns,
    )


def error_of(refused: Refused | Forgotten) -> EnactError:
    """Return the exception for a refusal."""
    if isinstance(refused, Forgotten):
        return forgotten(refused)
    code, text, facts = refused.code, refused.text, refused.facts
    if code == UNKNOWN_WORLD:
        return UnknownWorldError(text, known=facts)
    if code == CLOCK_SKEW:
        return ClockSkewError(text, ahead_s=_number_of(facts))
    if code == PERMISSION:
        return PermissionDeniedError(text, **dict(zip(_OF_A_RIGHT, facts, strict=False)))
    return _CLASSES.get(code, LinkError)(text)


def _number_of(facts: tuple[str, ...]) -> float:
    try:
        return float(facts[0])
    except (IndexError, ValueError):
        return 0.0  # a peer may send anything


def error_for(answer: Answer, question: str) -> EnactError:
    """Return the exception for an answer that does not fit its question."""
    if isinstance(answer, Refused | Forgotten):
        return error_of(answer)
    return ProtocolError(f"{question} was answered with a {type(answer).__name__}")
