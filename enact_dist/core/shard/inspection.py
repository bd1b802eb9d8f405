"""What a shard shows to people and watchers: holders, sessions, slots.  Changes no state."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import replace
from operator import attrgetter
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import (
    Audited,
    Counter,
    Cursor,
    Holder,
    ListAudit,
    ListLocks,
    ListSessions,
    Locks,
    Notice,
    Pong,
    SessionInfo,
    Sessions,
    SlotChange,
    SlotState,
    Survey,
    Surveyed,
)
from enact_dist.core.protocol.pages import (
    HOLDER_WORK,
    VERSIONS_OF_A_LOOK,
    bytes_in_frame,
    over_slots,
    page_of,
)
from enact_dist.core.state import clock
from enact_dist.core.state.slots import state_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from enact_dist.core.protocol.datum import Slot
    from enact_dist.core.protocol.pages import Step
    from enact_dist.core.protocol.records import Content
    from enact_dist.core.shard.state import ShardState
    from enact_dist.core.state.sessions import SessionState
    from enact_dist.core.state.slots import SlotMap

NOTICE_DATUM_BYTES_MAX: Final = 4 * 1024
"""Longest datum in a notice, its encoding included."""
NOTICE_BYTES_MAX: Final = 64 * 1024
"""So many bytes of data travel with one notice."""
STATE_BYTES: Final = 72
"""A state without its datum in an answer, names left out."""


def with_data(slots: SlotMap, notice: Notice) -> Notice:
    """Return a notice with the data of its changes that are small, or payloads, and the newest."""
    found, left = list[SlotChange](), NOTICE_BYTES_MAX
    for change in notice.changes:
        content = slots[change.slot]
        datum = content.datum if content.version == change.version else None
        if datum is not None and datum.fault is None:
            if datum.file:
                datum = replace(datum, body=b"")
            size = len(datum.encoding) + len(datum.body)
            if size <= min(left, NOTICE_DATUM_BYTES_MAX):
                left -= size
                change = change._replace(datum=datum)  # noqa: PLW2901
        found.append(change)
    return replace(notice, changes=tuple(found))


def locks(state: ShardState, message: ListLocks) -> Locks:
    """Describe holders and waiters, oldest first."""

    def steps() -> Iterator[Step[Holder]]:
        begin = message.after.number
        for tenure in sorted(state.tenures.by_lock.values(), key=lambda t: t.claim.ticket):
            number = tenure.claim.ticket
            if number > begin:
                told = state.tenures.describe(tenure, state.now_ns)
                yield told, bytes_in_frame(told), HOLDER_WORK, Cursor(state.epoch, (), number)

    return Locks(state.epoch, *page_of(steps()))


def sessions(state: ShardState, message: ListSessions) -> Sessions:
    """Describe the sessions, and on the first page the catalogue and the counters."""
    now_ns, begin = state.now_ns, message.after.names[:1]

    def steps() -> Iterator[Step[SessionInfo]]:
        for name in sorted(state.sessions.by_id):
            if (name,) > begin:
                told = _session_info(state, state.sessions.by_id[name])
                yield told, bytes_in_frame(told), 1, Cursor(state.epoch, (name,))

    told, more = page_of(steps())
    return Sessions(
        state.settings.name,
        state.epoch,
        state.grants,
        now_ns - state.born_ns,
        state.wall_ns,
        state.slots.count,
        state.slots.bytes,
        told,
        () if begin else state.catalogue.shown().worlds,
        () if begin else state.catalogue.shown().aspects,
        tuple(Counter(name, count) for name, count in sorted(counted(state).items())),
        more,
    )


def _session_info(state: ShardState, session: SessionState) -> SessionInfo:
    return SessionInfo(
        session.session,
        session.actor,
        session.host,
        session.pid,
        session.lease_end_ns(state.now_ns) - state.now_ns,
        session.token_present,
        len(state.tenures.by_session.get(session.session, {})),
        session.report,
    )


def audited(state: ShardState, message: ListAudit) -> Audited:
    """List the newest acts of operators, oldest first, and count the alarms."""
    entries = state.audit.entries()
    first = len(state.audit) - len(entries) + 1
    steps = (
        (entry, bytes_in_frame(entry), 1, Cursor(state.epoch, (), number))
        for number, entry in enumerate(entries, first)
        if number > message.after.number
    )
    return Audited(state.audit.alarms, *page_of(steps))


def pong(state: ShardState) -> Pong:
    """Say that the shard is there, and whether it grants."""
    return Pong(
        state.settings.name,
        state.epoch,
        state.grants,
        clock.state_of(grants=state.grants, draining=state.draining),
        state.now_ns - state.born_ns,
        state.settings.start,
    )


def counted(state: ShardState) -> dict[str, int]:
    """Return the statistics, what there is now, and alarms, of earlier epochs too."""
    history = state.slots.history
    others = {
        "alarms": state.audit.alarms,
        "audit_left_out": state.audit.left_out,
        "catalogue_left_out": state.catalogue.left_out,
        "draining": int(state.draining),
        "namesakes": len(state.doubled),
        "retained_bytes": history.bytes,
        "retained_dropped": history.dropped,
    }
    return state.counters | {name: count for name, count in others.items() if count}


def surveyed(state: ShardState, message: Survey, *, stamp_ns: int) -> Surveyed:
    """List the slots that match, null ones too, without their data; retained versions if asked."""

    def listed(slot: Slot, newest: Content, above: int) -> tuple[Iterator[SlotState], int]:
        if state.hides(slot):
            return iter(()), 1
        replaced = state.slots.history.of(slot) if message.retained else None
        contents = [*replaced.retained(), newest] if replaced is not None else [newest]
        begin = bisect_right(contents, above, key=lambda content: content.version) if above else 0
        shown = (state_of(slot, content, with_datum=False) for content in contents[begin:])
        return shown, len(contents) // VERSIONS_OF_A_LOOK

    steps = over_slots(
        state.slots,
        message,
        message.after,
        listed,
        epoch=state.epoch,
        version_of=attrgetter("version"),
        bytes_of=_bytes_of,
    )
    return Surveyed(state.epoch, state.commits.notice_number, stamp_ns, *page_of(steps))


def _bytes_of(state: SlotState) -> int:
    return STATE_BYTES + sum(map(bytes_in_frame, state.slot))
