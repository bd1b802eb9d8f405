"""The model's own picture of one shard: committed states by slot, grants, arrivals, restarts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from enact_dist.core.protocol.datum import Datum, LockId, Slot, Token

if TYPE_CHECKING:
    from enact_dist.core.protocol.messages import AspectEntry, SlotVersion, WorldEntry
    from enact_dist.core.protocol.records import Persist, PreparedRecord


class CommittedState(NamedTuple):
    """One committed state of a slot: `writer` is a lock, or the restart that left it so."""

    version: int
    stamp_ns: int
    writer: LockId | str
    epoch: int
    datum: Datum | None

    @property
    def name(self) -> tuple[int, int]:
        """What a reader in this epoch knows the state by."""
        return self.version, self.stamp_ns


DROP = "drop of "
"""So begins the writer of the state in which a dropped context leaves its slots."""
NEVER_SET = CommittedState(0, 0, "no lock", 0, None)


@dataclass(slots=True)
class ShardPicture:
    """What the model knows of one shard.

    `restarted_at` is where in its chain a slot stood when the shard last started, or its context
    was dropped; `restarts` are all writers that are no locks, with begin and end; `worlds` the
    forks, and `bases` from where on the versions of dropped contexts are free.  `started_ns` is the
    stamp at which this epoch began, `promised` up to which stamp the past of a slot was shown in
    it, and `labels` what each label keeps.  `vanished` are the slots of which the last crash has
    taken even that they were there.  `grown` are the aspects with a newer type that the shard has
    acknowledged, and `late` the locks that it has queued since then.  `holders` are the locks that
    were granted in this epoch, by their tokens, and `under` the one whose kept grant a later lock
    of its session has named while it lived.
    """

    epoch: int = 0
    chains: dict[Slot, list[CommittedState]] = field(default_factory=dict)
    restarted_at: dict[Slot, int] = field(default_factory=dict)
    columns: dict[tuple[str, str], dict[Slot, None]] = field(default_factory=dict)
    in_flight: dict[LockId, Persist] = field(default_factory=dict)
    preparing: dict[LockId, PreparedRecord] = field(default_factory=dict)
    prepared: dict[LockId, PreparedRecord] = field(default_factory=dict)
    aborted: dict[LockId, None] = field(default_factory=dict)
    applied: dict[LockId, Persist | None] = field(default_factory=dict)
    arrivals: dict[LockId, int] = field(default_factory=dict)
    granted: dict[LockId, Token] = field(default_factory=dict)
    granted_ever: dict[LockId, Token] = field(default_factory=dict)
    holders: dict[Token, LockId] = field(default_factory=dict)
    under: dict[LockId, LockId] = field(default_factory=dict)
    confirmed: dict[LockId, Token] = field(default_factory=dict)
    lanes: dict[tuple[str, int], None] = field(default_factory=dict)
    came: int = 0
    newest_token: Token | None = None
    notices: int = 0
    grace_waits_for: dict[str, int] = field(default_factory=dict)
    grace_end_ns: int = 0
    restarts: list[tuple[str, int, int]] = field(default_factory=list)
    worlds: dict[str, WorldEntry] = field(default_factory=dict)
    bases: dict[str, int] = field(default_factory=dict)
    vanished: frozenset[Slot] = frozenset()
    started_ns: int = 0
    promised: dict[Slot, int] = field(default_factory=dict)
    labels: dict[str, dict[SlotVersion, CommittedState]] = field(default_factory=dict)
    confirmed_labels: dict[str, None] = field(default_factory=dict)
    grown: dict[str, AspectEntry] = field(default_factory=dict)
    late: dict[LockId, None] = field(default_factory=dict)

    def named(self, lock: LockId, token: Token) -> None:
        """Note under whose grant a lock ends that was never granted by itself."""
        origin = self.holders.get(token)
        if lock in self.granted_ever or origin is None or origin.session != lock.session:
            return
        if self.granted.get(origin) == token:
            self.under[lock] = origin
            self.lanes[lock[:2]] = None

    def origin(self, lock: LockId) -> LockId:
        """Return the lock whose grant a lock has: its own, or a kept one."""
        return self.under.get(lock, lock)

    def now(self, slot: Slot) -> CommittedState:
        """Return the newest committed state of a slot."""
        chain = self.chains.get(slot)
        return chain[-1] if chain else NEVER_SET

    def next_version(self, slot: Slot) -> int:
        """Return the version that the next write of a slot makes."""
        return (self.now(slot).version or self.bases.get(slot.context, 0)) + 1

    def at(self, slot: Slot, stamp_ns: int) -> CommittedState:
        """Return the committed state of a slot as of a stamp."""
        for state in reversed(self.chains.get(slot, [])):
            if state.stamp_ns <= stamp_ns:
                return state
        return NEVER_SET

    def line(self, slot: Slot, *, volatile: bool) -> list[CommittedState]:
        """Return the versions that led to the newest one, oldest first, without what is lost.

        A power cut may take versions of class `os` back; of a volatile slot a restart leaves none.
        """
        chain = self.chains.get(slot, [])
        found: list[CommittedState] = []
        for state in reversed(chain[self.restarted_at.get(slot, 0) if volatile else 0 :]):
            if not state.version:
                break  # a restart has lost the slot with all that it had
            if not found or state.version == found[-1].version - 1:
                found.append(state)
        return found[::-1]

    def labels_of(self, slot: Slot) -> list[CommittedState]:
        """Return the versions of a slot that labels keep, each once."""
        kept = (item for versions in self.labels.values() for item in versions.items())
        return list({key.version: state for key, state in kept if key.slot == slot}.values())

    def put(self, slot: Slot, state: CommittedState) -> None:
        """Add a state to the chain of a slot."""
        self.chains.setdefault(slot, []).append(state)
        self.columns.setdefault((slot.context, slot.aspect), {})[slot] = None
