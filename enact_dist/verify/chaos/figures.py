"""Figures of a run: what happened how often, and how long locks were away after something died.

Recovery counts where no other fault interferes: a restart, a death, a lock in doubt that met
another fault of the shards or links concerned counts from that fault's end, or not at all.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from enact_dist.terms import Access
from enact_dist.verify.chaos.chains import CheckedHistory
from enact_dist.verify.chaos.faults import (
    KILL_CLIENT,
    LOSSY,
    ONE_WAY,
    PARTITION,
    SLOW,
    STOP_CLIENT,
)
from enact_dist.verify.chaos.replicated.faults import KILL_SERVING, RESTART_SERVING, WAKE_OLD
from enact_dist.verify.chaos.workload import UNEXPECTED
from enact_dist.verify.checker import Anomaly, LockOutcome

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from enact_dist.verify.chaos.evidence import Evidence, Fault, LockRecord, Restart

COUNTED: Final = (
    "fenced",
    "epoch_refusals",
    "decisions",
    "prepared",
    "prepared_restored",
    "resolves_asked",
    "resolved_committed",
    "resolved_aborted",
    "orphans_freed",
    "leases_expired",
    "held_too_long",
    "commits_repeated",
    "commits_changed",
)
"""Reported counters of the shards; the last half second of a killed shard is missing."""
FACTS_MAX: Final = 20
_WRONG: Final = {
    "lost": ("told committed, but lost", "lost update", "half a commit"),
    "doubled": ("one write stands twice", "one version was written twice"),
    "invented": ("told not committed, but visible", "written by no lock", "versions have a gap"),
}
"""What the report calls anomalies of writes, and their rules."""


@dataclass(frozen=True, slots=True)
class Spread:
    """Durations in seconds."""

    n: int
    p50_s: float
    p99_s: float
    max_s: float


def spread(durations_ns: Iterable[int]) -> Spread:
    """Return the spread of durations; zeros without any."""
    found = sorted(duration / 1e9 for duration in durations_ns)
    if not found:
        return Spread(0, 0.0, 0.0, 0.0)

    def at(part: float) -> float:
        return found[max(0, math.ceil(part * len(found)) - 1)]

    return Spread(len(found), at(0.5), at(0.99), found[-1])


@dataclass(slots=True)
class Verdict:
    """What a run showed.

    Attributes:
        missing: Kinds of faults that this machine does not allow.
        commits: Locks with a confirmed commit; `reads`: those that only read.
        fenced: Commits that were sent and refused, since the lock was lost by then.
        guessed: Versions that one of several locks wrote and no lock saw.
        writes: Locks that wrote: acknowledged, of unknown outcome; anomalies of writes by kind.
        takeovers: Of a cell in a database: how often a daemon took a shard over.
        ended: Why daemons of such a cell ended.
        answers: How many answers they let out; `late_answers`: those of them that went out after
            the database had been asked for the shard's next epoch.
    """

    settings: dict[str, Any]
    missing: tuple[str, ...]
    faults: dict[str, int]
    locks: int
    commits: int
    over_shards: int
    reads: int
    fenced: int
    epoch_changes: int
    outcomes: dict[str, int]
    counters: dict[str, int]
    recovery: dict[str, Spread]
    guessed: int
    views_checked: int
    writes: dict[str, int]
    takeovers: int
    ended: dict[str, int]
    answers: int
    late_answers: int
    anomalies: list[Anomaly] = field(default_factory=list)


def judge(evidence: Evidence) -> Verdict:
    """Check the history of a run and count what happened."""
    history = CheckedHistory(evidence)
    checker = history.checker()
    locks = evidence.locks.values()
    anomalies = [Anomaly(rule, (text,)) for rule, text in evidence.failures]
    unexpected = Counter(lock.why for lock in locks if lock.why.startswith(UNEXPECTED))
    anomalies += [Anomaly(f"{n} times {why}", ()) for why, n in unexpected.items()]
    anomalies += [*history.oddities, *checker.anomalies()]
    answers, late = _answers(evidence)
    anomalies += late
    committed = [lock for lock in locks if lock.told is LockOutcome.COMMITTED]
    takeovers = sum(restart.down_ns > 0 for restart in evidence.restarts)
    outcomes = Counter(lock.why or lock.told.value for lock in locks)
    return Verdict(
        settings=evidence.settings,
        missing=tuple(evidence.settings["missing"]),
        faults=dict(sorted(Counter(fault.kind for fault in evidence.faults).items())),
        locks=len(locks),
        commits=sum(bool(lock.writes) for lock in committed),
        over_shards=sum(lock.kind == "write over shards" for lock in committed),
        reads=sum(not lock.writes for lock in committed),
        fenced=sum(lock.tried and lock.why == "LeaseLostError" for lock in locks),
        epoch_changes=takeovers,
        outcomes=dict(sorted(outcomes.items())),
        counters={name: evidence.counter(name) for name in COUNTED},
        recovery=_recovery(evidence),
        guessed=len(history.guessed),
        views_checked=checker.views_checked,
        writes=_writes(locks, anomalies),
        takeovers=takeovers if evidence.served else 0,
        ended=dict(sorted(Counter(end.why for end in evidence.ends).items())),
        answers=answers,
        late_answers=len(late),
        anomalies=anomalies,
    )


def _writes(locks: Collection[LockRecord], anomalies: Iterable[Anomaly]) -> dict[str, int]:
    """Return what became of the locks that wrote."""
    found = Counter(anomaly.rule for anomaly in anomalies)
    return {
        "acknowledged": sum(
            bool(lock.writes) and lock.told is LockOutcome.COMMITTED for lock in locks
        ),
        "unknown": sum(bool(lock.writes) and lock.told is LockOutcome.UNKNOWN for lock in locks),
        **{word: sum(found[rule] for rule in rules) for word, rules in _WRONG.items()},
    }


def _answers(evidence: Evidence) -> tuple[int, list[Anomaly]]:
    """Return how many answers daemons let out, and an anomaly for each that came late."""
    late = []
    begun: dict[str, list[tuple[int, int]]] = {}
    for restart in evidence.restarts:
        begun.setdefault(restart.shard, []).append((restart.epoch, restart.started_ns))
    for shard, served in evidence.served.items():
        for one in served:
            since_ns = min(
                (ns for epoch, ns in begun.get(shard, ()) if epoch > one.epoch), default=None
            )
            late += [
                Anomaly(
                    "an old daemon answered after its lease",
                    (f"{shard}, epoch {one.epoch}: {(at_ns - since_ns) / 1e9:.3f} s too late",),
                )
                for at_ns in one.last_ns
                if since_ns is not None and at_ns > since_ns
            ]
    return sum(one.answers for served in evidence.served.values() for one in served), late


# ---------------------------------------------------------------- recovery


def _recovery(evidence: Evidence) -> dict[str, Spread]:
    ttl_ns = int(evidence.settings["ttl_s"] * 1e9)
    restarts = [(r, ns) for r in evidence.restarts if r.down_ns and (ns := _first(evidence, r))]
    quiet = [(r, ns) for r, ns in restarts if not _disturbed(evidence, r, ns, ttl_ns)]
    recovery = {
        "restart to first grant": spread(ns - r.started_ns for r, ns in restarts),
        "serving to first grant": spread(ns - r.ready_ns for r, ns in restarts),
        "restart to first grant, all clients alive": spread(ns - r.started_ns for r, ns in quiet),
        "serving to first grant, all clients alive": spread(ns - r.ready_ns for r, ns in quiet),
        "holder killed to next grant": spread(_deaths(evidence, ttl_ns)),
        "in doubt": spread(_doubts(evidence)),
    }
    if evidence.served:
        for kind in (KILL_SERVING, WAKE_OLD, RESTART_SERVING):
            recovery[f"{kind}: next grant"] = spread(_successions(evidence, kind))
    return recovery


def _successions(evidence: Evidence, kind: str) -> Iterable[int]:
    """Yield how long after a fault of its daemon a shard granted its first lock in a new epoch."""
    for fault in evidence.faults:
        if fault.kind == kind:
            firsts = (
                _first(evidence, restart)
                for restart in evidence.restarts
                if restart.shard in fault.targets and restart.down_ns > fault.from_ns
            )
            if first_ns := next(filter(None, firsts), 0):
                yield first_ns - fault.from_ns


def _first(evidence: Evidence, restart: Restart) -> int:
    """Return when the first lock was granted after a restart; 0 for never."""
    granted = (
        lock.granted_ns
        for lock in evidence.locks.values()
        if lock.granted_ns and lock.epochs.get(restart.shard) == restart.epoch
    )
    return min(granted, default=0)


def _overlapping(evidence: Evidence, from_ns: int, until_ns: int) -> Iterable[Fault]:
    return (f for f in evidence.faults if f.from_ns < until_ns and f.until_ns > from_ns)


def _disturbed(evidence: Evidence, restart: Restart, until_ns: int, ttl_ns: int) -> bool:
    """Whether a client was dead, stopped or badly connected, or another shard down."""
    return any(
        fault.kind in (KILL_CLIENT, STOP_CLIENT, PARTITION, ONE_WAY, SLOW, LOSSY)
        or restart.shard not in fault.targets
        for fault in _overlapping(evidence, restart.down_ns - 2 * ttl_ns, until_ns)
    )


def _locked(lock: LockRecord) -> dict[tuple[str, str, str], bool]:
    """Return the slots that a lock locks, and whether for writing; patterns left out."""
    return {
        (context, entity, aspect): Access(access).writes
        for access, context, entity, aspect in lock.items
        if Access(access).locks and not Access(access).each
    }


def _deaths(evidence: Evidence, ttl_ns: int) -> list[int]:
    """Return how long others waited for what a killed client held."""
    granted = sorted(
        (lock for lock in evidence.locks.values() if lock.granted_ns),
        key=lambda lock: lock.granted_ns or 0,
    )
    found = []
    for fault in evidence.faults:
        if fault.kind != KILL_CLIENT:
            continue
        held = [lock for lock in granted if lock.client in fault.targets and not lock.ended_ns]
        for lock in held:
            delay_ns = _next_grant(evidence, lock, fault.from_ns, granted, ttl_ns)
            if delay_ns is not None:
                found.append(delay_ns)
    return found


def _next_grant(
    evidence: Evidence,
    dead: LockRecord,
    killed_ns: int,
    granted: list[LockRecord],
    ttl_ns: int,
) -> int | None:
    """Return how long the first that wanted what a dead lock held had to wait for it."""
    mine = _locked(dead)
    shards = set(dead.epochs)
    for lock in granted:
        at_ns = lock.granted_ns or 0
        if at_ns <= killed_ns or lock is dead or lock.begun_ns > killed_ns + ttl_ns:
            continue
        theirs = _locked(lock)
        if not any(slot in mine and (mine[slot] or writes) for slot, writes in theirs.items()):
            continue
        group = evidence.settings["groups"].get(lock.client.partition(".")[0])
        concerned = {*shards, *lock.epochs, group, lock.client.partition(".")[0]}
        faults = _overlapping(evidence, killed_ns, at_ns)
        if any(concerned.intersection(fault.targets) for fault in faults):
            return None
        return at_ns - max(killed_ns, lock.begun_ns)
    return None


def _doubts(evidence: Evidence) -> list[int]:
    """Return how long locks were in doubt, from the end of the last fault of shards or links."""
    found = []
    for doubt in evidence.doubts:
        ends = [
            fault.until_ns
            for fault in _overlapping(evidence, doubt.first_ns, doubt.last_ns)
            if fault.kind not in (KILL_CLIENT, STOP_CLIENT)
        ]
        found.append(max(0, doubt.last_ns - max([doubt.first_ns, *ends])))
    return found
