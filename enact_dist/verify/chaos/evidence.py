"""What a folder of journals tells: every lock of a run, every fault, every restart.

::

    settings.json       what was run
    faults.log          faults and restarts, by the runner
    watcher.log         locks in doubt and counters, by the watcher
    NAME.answers        when a daemon of a cell in a database answered, and in which epoch
    NAME.journal        what a client process did; `final.journal`: everything, read at the end
    *.log, data/        output of the processes, data of the shards
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from enact_dist.errors import ConfigError
from enact_dist.verify.chaos import watcher
from enact_dist.verify.chaos.journal import SUFFIX, read_lines
from enact_dist.verify.chaos.replicated.answers import SUFFIX as ANSWERS
from enact_dist.verify.chaos.replicated.answers import ServedEpoch, read_answers
from enact_dist.verify.checker import LockOutcome

SETTINGS: Final = "settings.json"
FAULTS: Final = "faults.log"


@dataclass(slots=True, eq=False)
class LockRecord:
    """One lock as its journal has it; times in ns of the shared clock.

    Attributes:
        client: The process that took it.
        items: (access, context, entity or pattern, aspect) of each request.
        epochs: Shard → epoch of the grant.
        seen: (slot, version, writer, protected) of each datum looked at.
        writes: (slot, version, writer) of each datum that was about to be committed.
        tried: Whether its commit was about to be sent.
    """

    id: str
    client: str
    kind: str
    items: list[list[Any]]
    begun_ns: int
    granted_ns: int | None = None
    ended_ns: int | None = None
    told: LockOutcome = LockOutcome.UNKNOWN
    why: str = "its process died"
    epochs: dict[str, int] = field(default_factory=dict)
    seen: list[tuple[str, int, str, bool]] = field(default_factory=list)
    writes: list[tuple[str, int, str]] = field(default_factory=list)
    expected: list[str] = field(default_factory=list)
    tried: bool = False


@dataclass(frozen=True, slots=True)
class Restart:
    """One start of a shard, or a takeover by a daemon that stood by.

    Attributes:
        down_ns: When its predecessor ended, or when the database was asked for the shard; 0 for the
            first.
        silent_ns: When its predecessor answered no more at the latest.
    """

    shard: str
    epoch: int
    down_ns: int
    started_ns: int
    ready_ns: int
    silent_ns: int


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault; `targets` are shards, clients or hosts."""

    kind: str
    targets: tuple[str, ...]
    from_ns: int
    until_ns: int


@dataclass(frozen=True, slots=True)
class Doubt:
    """A lock that was seen prepared and undecided at a shard."""

    lock: str
    shard: str
    first_ns: int
    last_ns: int


@dataclass(frozen=True, slots=True)
class DaemonEnd:
    """The end of a daemon of a cell in a database."""

    place: str
    status: int
    why: str
    at_ns: int


@dataclass(slots=True)
class Evidence:
    """All that is known of a run.

    Attributes:
        served: Shard → what each of its daemons answered, in a cell in a database.
    """

    settings: dict[str, Any]
    locks: dict[str, LockRecord] = field(default_factory=dict)
    restarts: list[Restart] = field(default_factory=list)
    faults: list[Fault] = field(default_factory=list)
    doubts: list[Doubt] = field(default_factory=list)
    counters: dict[tuple[str, int], dict[str, int]] = field(default_factory=dict)
    ends: list[DaemonEnd] = field(default_factory=list)
    served: dict[str, list[ServedEpoch]] = field(default_factory=dict)
    failures: list[tuple[str, str]] = field(default_factory=list)
    """What went wrong while it ran: rule, text."""

    def counter(self, name: str) -> int:
        """Return a counter over all shards and their restarts, as far as it was seen."""
        return sum(found.get(name, 0) for found in self.counters.values())


def load(folder: Path) -> Evidence:
    """Read the folder of a run.

    Raises:
        ConfigError: It is no evidence, or a journal cannot be read.
    """
    try:
        evidence = Evidence(json.loads((folder / SETTINGS).read_text()))
        for path in sorted(folder.glob(f"*{SUFFIX}")):
            _read_journal(path, evidence)
        _read_faults(folder, evidence)
        _read_watcher(folder, evidence)
        for path in sorted(folder.glob(f"*{ANSWERS}")):
            shard = path.name.partition("@")[0]
            evidence.served.setdefault(shard, []).append(read_answers(path))
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(f"{folder} is no folder of a chaos run: {error}") from error
    return evidence


def _read_journal(path: Path, evidence: Evidence) -> None:
    client = path.name.removesuffix(SUFFIX)
    for word, lock, *rest in read_lines(path):
        if word == "begin":
            begun_ns, kind, items = rest
            evidence.locks[lock] = LockRecord(lock, client, kind, items, begun_ns)
            continue
        record = evidence.locks[lock]
        if word == "granted":
            record.granted_ns = rest[0]
            record.epochs = {shard: epoch for shard, epoch, _ in rest[1]}
        elif word == "seen":
            record.seen = [(slot, version, by, held) for slot, version, by, held in rest[0]]
        elif word == "write":
            record.writes = [(slot, version, by) for slot, version, by in rest[0]]
            record.expected, record.tried = rest[1], True
        elif word == "end":
            record.ended_ns, record.told, record.why = rest[0], LockOutcome(rest[1]), rest[2]
        else:
            raise ValueError(f"{path.name}: a line begins with {word!r}")


def _read_faults(folder: Path, evidence: Evidence) -> None:
    for word, *rest in read_lines(folder / FAULTS):
        if word == "restart":
            shard, epoch, down_ns, started_ns, ready_ns, *silent = rest
            silent_ns = silent[0] if silent else down_ns
            restart = Restart(shard, epoch, down_ns, started_ns, ready_ns, silent_ns)
            evidence.restarts.append(restart)
        elif word == "end":
            evidence.ends.append(DaemonEnd(*rest))
        elif word == "fault":
            kind, targets, from_ns, until_ns = rest
            evidence.faults.append(Fault(kind, tuple(targets), from_ns, until_ns))
        elif word == "failure":
            rule, text = rest
            evidence.failures.append((rule, text))
    evidence.restarts.sort(key=lambda restart: restart.epoch)
    first: dict[str, None] = {}
    for index, restart in enumerate(evidence.restarts):
        if restart.shard not in first:
            first[restart.shard] = None
            evidence.restarts[index] = replace(restart, down_ns=0, silent_ns=0)


def _read_watcher(folder: Path, evidence: Evidence) -> None:
    for word, *rest in read_lines(folder / watcher.LOG):
        if word == "doubt":
            evidence.doubts.append(Doubt(*rest))
        elif word == "counters":
            shard, epoch, counters = rest
            evidence.counters[shard, epoch] = counters
