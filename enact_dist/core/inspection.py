"""What a shard shows to people: holders, sessions, slots.  Reads state, changes none."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.core.lock_table import Mode
from enact_dist.core.messages import (
    Counter,
    Holder,
    SessionInfo,
    Sessions,
    SlotState,
    Survey,
    Surveyed,
)
from enact_dist.core.slots import state_of

if TYPE_CHECKING:
    from enact_dist.core.shard_state import ShardState
    from enact_dist.core.tenures import Tenure

SLOTS_TOLD_MAX: Final = 16
"""Slots of one lock that are listed by name."""
WAITS_TOLD_MAX: Final = 16
"""Locks that one waiter is shown to wait for."""

_WORDS: Final = {Mode.S: "read", Mode.X: "write", Mode.SIX: "read all, write some"}


def holder(state: ShardState, tenure: Tenure, *, now_ns: int) -> Holder:
    """Describe one lock: who holds or awaits it, since when, and for whom it waits."""
    session = state.sessions.by_id.get(tenure.lock.session)
    modes = {mode: None for mode in tenure.claim.wants.values() if mode in _WORDS}
    named = [
        f"{resource} ({_WORDS[mode]})"
        for resource, mode in tenure.claim.wants.items()
        if mode in _WORDS
    ]
    waits_for = state.tenures.table.blockers(tenure.claim, count_max=WAITS_TOLD_MAX)
    granted = tenure.token is not None
    words = [_WORDS[mode] for mode in modes]
    if tenure.prepared is not None:
        words.append(f"in doubt until {tenure.prepared.primary} decides")
    return Holder(
        tenure.lock,
        tenure.claim.ticket,
        session.actor if session else "?",
        session.host if session else "?",
        session.pid if session else 0,
        granted,
        ", ".join(words),
        now_ns - (tenure.granted_ns if granted else tenure.asked_ns),
        max(0, session.lease_end_ns(now_ns) - now_ns) if session else 0,
        max(0, tenure.hold_end_ns - now_ns) if granted else tenure.hold_ns,
        tuple(named[:SLOTS_TOLD_MAX]),
        tuple(claim.ticket for claim in waits_for),
    )


def sessions(state: ShardState) -> Sessions:
    """Describe the sessions, the catalogue and the counters."""
    now_ns = state.now_ns
    return Sessions(
        state.settings.name,
        state.epoch,
        state.grants,
        now_ns - state.born_ns,
        state.wall_ns,
        state.slots.count,
        state.slots.bytes,
        tuple(
            SessionInfo(
                session.session,
                session.actor,
                session.host,
                session.pid,
                session.lease_end_ns(now_ns) - now_ns,
                session.token_present,
                len(state.tenures.by_session.get(session.session, {})),
                session.report,
            )
            for session in state.sessions
        ),
        tuple(state.catalogue.worlds),
        tuple(state.catalogue.aspects.values()),
        tuple(Counter(name, count) for name, count in sorted(counted(state).items())),
    )


def counted(state: ShardState) -> dict[str, int]:
    """Return the statistics, what there is now, and alarms, of earlier epochs too."""
    history = state.slots.history
    others = {
        "alarms": state.audit.alarms,
        "draining": int(state.draining),
        "retained_bytes": history.bytes,
        "retained_dropped": history.dropped,
    }
    return state.counters | {name: count for name, count in others.items() if count}


def surveyed(state: ShardState, message: Survey, *, stamp_ns: int) -> Surveyed:
    """List the slots that match, null ones too, without their data; retained versions if asked."""
    states: list[SlotState] = []
    for slot, newest in state.slots.selected(message.contexts, message.patterns, message.aspects):
        replaced = state.slots.history.of(slot) if message.retained else None
        if replaced is not None:
            states += [state_of(slot, older, with_datum=False) for older in replaced.retained()]
        states.append(state_of(slot, newest, with_datum=False))
    return Surveyed(state.epoch, state.commits.notice_number, stamp_ns, tuple(states))
