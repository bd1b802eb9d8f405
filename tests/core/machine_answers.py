"""Answers and records of the shard as plain tuples, in the words of the reference."""

from __future__ import annotations

from functools import singledispatch

from enact_dist.core.protocol import messages, records


def _text(datum):
    return None if datum is None else bytes(datum.body).decode()


def _pairs(versions):
    return tuple((version.slot, version.version) for version in versions)


def _shown(states):
    return frozenset((state.slot, state.version, _text(state.datum)) for state in states)


def _surveyed(states):
    versions: dict = {}
    for state in states:
        if state.version:
            versions.setdefault(state.slot, []).append((state.version, state.captured_ns))
    return frozenset((slot, tuple(found)) for slot, found in versions.items())


@singledispatch
def plain(answer: object) -> tuple:
    """Return an answer as a tuple: its kind, then what the reference says too."""
    raise TypeError(answer)


@singledispatch
def fact_of(record: object) -> tuple:
    """Return a record as a tuple: its kind, then whom it is about."""
    raise TypeError(record)


_ANSWERS = {
    messages.Welcome: lambda a: ("welcome", a.epoch, a.open),
    messages.EpochChanged: lambda a: ("epoch", a.epoch),
    messages.Refused: lambda a: ("refused", a.code),
    messages.Stale: lambda a: ("stale", a.lock),
    messages.Granted: lambda a: (
        "granted",
        a.lock,
        _shown(a.states),
        a.count_seen,
        a.hold_left_ns,
    ),
    messages.Waiting: lambda a: (
        "waiting",
        a.lock,
        a.place,
        frozenset(holder.lock for holder in a.blockers),
    ),
    messages.Released: lambda _: ("released",),
    messages.Alive: lambda a: (
        "alive",
        a.count_seen,
        frozenset((grant.lock, grant.hold_left_ns, grant.recalled) for grant in a.grants),
    ),
    messages.Committed: lambda a: (
        "committed",
        a.lock,
        _pairs(a.versions),
        a.kept >= messages.PLACES,
    ),
    messages.Fenced: lambda a: ("fenced", a.lock),
    messages.Changed: lambda a: ("changed", a.lock, a.slot, a.version),
    messages.Prepared: lambda a: ("prepared", a.lock, _pairs(a.versions)),
    messages.Finished: lambda a: ("finished", a.lock),
    messages.Resolved: lambda a: ("resolved", a.lock, a.kind),
    messages.OutcomeIs: lambda a: ("outcome", a.lock, a.kind, _pairs(a.versions)),
    messages.Valid: lambda a: ("valid", a.lock, a.kept >= messages.PLACES),
    messages.Broken: lambda a: ("broken", a.found),
    messages.Viewed: lambda a: ("viewed", a.lock, _shown(a.states)),
    messages.Surveyed: lambda a: ("surveyed", _surveyed(a.states)),
    messages.Slice: lambda a: ("slice", a.slot, a.version, _text(a.body)),
    messages.Gone: lambda a: ("gone", a.slot, a.version),
    messages.Locks: lambda a: (
        "locks",
        tuple(sorted((h.number, h.lock, h.granted, h.kept) for h in a.holders)),
    ),
}
_FACTS = {
    records.SessionRecord: lambda r: ("session", r.session),
    records.SessionEnded: lambda r: ("session over", r.session),
    records.SlotRecord: lambda r: (
        "slot",
        r.slot,
        r.version,
        _text(r.datum),
        r.volatile,
        r.history,
    ),
    records.HistoryForgotten: lambda r: ("forgotten", tuple(sorted(r.versions))),
    records.OutcomeRecord: lambda r: ("outcome", r.lock, _pairs(r.versions)),
    records.PreparedRecord: lambda r: ("prepared", r.lock, _pairs(r.versions)),
    records.PreparedEnded: lambda r: ("prepared over", r.lock),
    records.DecisionRecord: lambda r: ("decision", r.lock, r.participants),
    records.DecisionDone: lambda r: ("decision done", r.lock),
    records.ForcedRecord: lambda r: ("forced", r.lock),
    records.ForcedEnded: lambda r: ("forced over", r.lock),
    records.AuditRecord: lambda _: ("audit", ""),
}
for _kind, _as_tuple in _ANSWERS.items():
    plain.register(_kind)(_as_tuple)
for _kind, _as_tuple in _FACTS.items():
    fact_of.register(_kind)(_as_tuple)
