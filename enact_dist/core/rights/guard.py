"""What each request needs, and the refusal of a request that lacks it.

=======================================  =======================================================
request                                  right
=======================================  =======================================================
`Acquire`, `TakeView`                    `read` or `write` of each item, by its access
`Fetch`                                  none for what a lock of the session pins, else `read`
`Commit`, `Prepare`                      of each slot `change`, `init` or `delete`, by what is there
`Stage`                                  any of these on anything
`Register`                               `write` somewhere of each aspect, unless it only reads it;
                                         `register` of new worlds
`Fork`, `DropWorld`, `KeepVersions`      `fork` and `read` of the whole source; `drop`; `keep`
`Break`; `ForceAbort`, settled alarms    `break`; `resolve`
`Survey`, `ListHistory`                  none; what is not readable is left out
`Explain`, `FindEffects`                 `observe`; what is not readable is left out
`ListLocks`, `ListSessions`,             `observe`
`ListAudit`, `ListRefusals`
=======================================  =======================================================

A reader registers what it reads, too, so that every shard of a cell has the same type of it.  From
one that may not write the aspect, a shard takes neither a new aspect nor more retention.
A question about one slot alone is refused without `read` of it: it would look like null otherwise.
Everything else needs none: the owner of a session may renew it, and release and end if the
transport vouches for its name; shards are known by their own identity
(`enact_dist.core.shard.owners`).  Locks are refused before they get a place in the queue.  A commit
is compared again behind its fence, since a client may send anything.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from typing import Final, Protocol

from enact_dist.core.protocol.datum import Slot
from enact_dist.core.protocol.messages import (
    PERMISSION,
    Acquire,
    Break,
    Commit,
    DropWorld,
    Explain,
    FindEffects,
    ForceAbort,
    Fork,
    Goodbye,
    Item,
    KeepVersions,
    ListAudit,
    ListHistory,
    ListLocks,
    ListRefusals,
    ListSessions,
    RefusalEntry,
    Refused,
    Register,
    Release,
    Stage,
    TakeView,
    WriteItem,
)
from enact_dist.core.protocol.records import Content, LogEvent
from enact_dist.core.rights.rules import ALL, UNPROVEN, WRITE, Rights, path_of, shown
from enact_dist.terms import ACCESSES

TOLD_EACH_NS: Final = 1_000_000_000
"""The log names a subject and a right at most once in this time."""
TOLD_MAX: Final = 1_000
"""Subjects and rights that are remembered for that; with one more, all of them are forgotten."""
NOTED_MAX: Final = 1_000
"""Different refusals that can be listed; one more displaces the one that is longest ago."""
_OBSERVING: Final = frozenset(
    (ListLocks, ListSessions, Explain, FindEffects, ListAudit, ListRefusals)
)
_ENDING: Final = frozenset((Goodbye, Release))


class SlotContents(Protocol):
    """What each slot has, null included."""

    def __getitem__(self, slot: Slot, /) -> Content: ...


class Guard:
    """Compares the requests of one shard with the rights of their subjects.

    Attributes:
        rights: The rights; they may be replaced between two messages.
        subject: Whose rights the present request uses.
        asker: The identity under which it came.
        denials: Refusals of the present request that the log does not name yet.
    """

    __slots__ = ("_count", "_noted", "_told", "asker", "denials", "rights", "subject")

    def __init__(self, rights: Rights, count: Callable[[str], None]) -> None:
        self.rights = rights
        self.subject = self.asker = ""
        self.denials: list[tuple[str, str, str, Refused]] = []
        self._count = count
        self._noted: dict[tuple[str, str, str], RefusalEntry] = {}
        self._told: dict[tuple[str, str], tuple[int, int]] = {}

    def begin(self, asker: str, subject: str | None) -> None:
        """Note who sends the next message; None: the transport vouches for no name."""
        self.asker = asker
        self.subject = (UNPROVEN if asker else "") if subject is None else subject

    # ---------------------------------------------------------------- requests

    def refusal(self, message: object, worlds: Collection[str]) -> Refused | None:
        """Return why the present subject may not ask that, else None; events of the host may."""
        kind = type(message)
        if kind is Commit:
            return None  # compared behind its fence
        if isinstance(message, Acquire | TakeView):
            return self.refusal_of(message.items)
        if isinstance(message, Register):
            return self._register(message, worlds)
        if isinstance(message, Fork):
            return self._fork(message)
        if isinstance(message, DropWorld):
            return self._plain("drop", message.world, message.world)
        if isinstance(message, KeepVersions):
            return self._plain("keep", message.label, message.label)
        if kind is Break:
            return self._plain("break", ALL, "locks")
        if kind is ForceAbort or (isinstance(message, ListAudit) and message.settle):
            return self._plain("resolve", ALL, "locks and alarms")
        if kind is Stage and not self.rights.may_write_some(self.subject, ALL):
            return self.denied(WRITE, "anything")
        if kind in _OBSERVING and (refused := self._plain("observe", ALL, "the cell")) is not None:
            return refused
        if kind in _ENDING and self.subject == UNPROVEN:
            return self.denied("end", "sessions and locks")
        alone = _asked_alone(message)
        return self.may_not_read(alone) if alone is not None else None

    def _plain(self, right: str, path: str, what: str) -> Refused | None:
        may = self.rights.may(self.subject, right, path)
        return None if may else self.denied(right, what)

    def refusal_of(self, items: Iterable[Item]) -> Refused | None:
        """Return why the present subject may not have a lock or view of these items, else None."""
        rights, subject = self.rights, self.subject
        for item in items:
            access = ACCESSES.get(item.access)
            right = WRITE if access is not None and access.writes else "read"
            if not rights.may(subject, right, f"{item.context}/{item.aspect}/{item.entity}"):
                return self.denied(right, Slot(item.context, item.entity, item.aspect))
        return None

    def _register(self, message: Register, worlds: Collection[str]) -> Refused | None:
        for entry in message.aspects:
            if not entry.reads and not self.may_alter(entry.name):
                return self.denied(WRITE, f"aspect {entry.name}")
        for world in message.worlds:
            if world not in worlds and not self.rights.may(self.subject, "register", world):
                return self.denied("register", world)
        return None

    def may_alter(self, aspect: str) -> bool:
        """Whether the present subject may register an aspect, or change how it is registered."""
        return self.rights.may_write_some(self.subject, f"*/{aspect}/{ALL}")

    def _fork(self, message: Fork) -> Refused | None:
        source, world = message.source, message.world
        return self._plain("fork", f"{source}/{world}", f"{source} -> {world}") or self._plain(
            "read", f"{source}/*/{ALL}", f"{source}:{ALL}"
        )

    # ---------------------------------------------------------------- slots

    def hides(self, slot: Slot) -> bool:
        """Whether the present subject may not read a slot."""
        return not self.rights.may(self.subject, "read", path_of(slot))

    def may_not_read(self, slot: Slot) -> Refused | None:
        """Refuse a slot that the present subject may not read."""
        return self.denied("read", slot) if self.hides(slot) else None

    def may_not_write(self, writes: Iterable[WriteItem], contents: SlotContents) -> Refused | None:
        """Refuse writes for which the present subject has not the right."""
        for slot, datum in writes:
            right = "delete" if datum is None else "change"
            if datum is not None and contents[slot].datum is None:
                right = "init"
            if not self.rights.may(self.subject, right, path_of(slot)):
                return self.denied(right, slot)
        return None

    # ---------------------------------------------------------------- people

    def denied(self, right: str, what: Slot | str) -> Refused:
        """Refuse a right on something, and count it."""
        self._count("permission_denied")
        refused = self.rights.refuse(self.subject, self.asker, right, what)
        self.denials.append((self.subject, right, shown(what), refused))
        return refused

    def log_events(self, now_ns: int, wall_ns: int) -> Iterator[LogEvent]:
        """Note the refusals; yield what the log is to say: one line per subject, right, second."""
        for subject, right, what, refused in self.denials:
            self._note((subject, right, what), wall_ns)
            key = (subject, right)
            told_ns, left_out = self._told.get(key, (now_ns - TOLD_EACH_NS, 0))
            if now_ns - told_ns < TOLD_EACH_NS:
                self._told[key] = told_ns, left_out + 1
                continue
            if len(self._told) >= TOLD_MAX:
                self._told.clear()
            self._told[key] = now_ns, 0
            more = f"; {left_out} more since the last line" if left_out else ""
            asker = f" (asked by {self.asker})" if refused.code == PERMISSION and self.asker else ""
            yield LogEvent("permission.denied", f"{refused.text}{asker}{more}")
        self.denials.clear()

    def _note(self, key: tuple[str, str, str], wall_ns: int) -> None:
        before = self._noted.pop(key, None)
        if before is None and len(self._noted) >= NOTED_MAX:
            del self._noted[next(iter(self._noted))]
        times, first_ns = (before.times, before.first_ns) if before is not None else (0, wall_ns)
        self._noted[key] = RefusalEntry(*key, times + 1, first_ns, wall_ns)

    def noted(self) -> tuple[RefusalEntry, ...]:
        """Return the latest refusals, each kind once, the latest at the end."""
        return tuple(self._noted.values())


def _asked_alone(message: object) -> Slot | None:
    """Return the slot that a question is about, if it is about one alone."""
    if isinstance(message, Explain):
        slots = {slot for slot, _ in message.versions}
        return slots.pop() if len(slots) == 1 else None
    if isinstance(message, ListHistory):
        asked = (message.contexts, message.patterns, message.aspects)
        if all(len(some) == 1 and "*" not in some[0] for some in asked):
            ((context,), (entity,), (aspect,)) = asked
            return Slot(context, entity, aspect)
    return None
