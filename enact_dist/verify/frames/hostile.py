"""Requests of every kind with hostile values in their fields, as far as the wire carries them."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, Final, get_args, get_origin

from enact_dist.core.protocol.datum import Datum, LockId, Position, Slot
from enact_dist.core.protocol.messages import (
    START,
    Acquire,
    Commit,
    Granted,
    Hello,
    Item,
    Prepare,
    Request,
    Resolved,
    Stage,
    Validate,
    WriteItem,
)
from enact_dist.terms import Access
from enact_dist.wire.limits import INTEGER_MAX, NAME_CHARACTERS_MAX
from enact_dist.wire.message_parts import annotated, without_none

if TYPE_CHECKING:
    from random import Random

KINDS: Final[tuple[type, ...]] = get_args(Request)
SESSIONS: Final = ("ann", "bob")
"""Those that say hello; their locks are what hostile requests name most of the time."""
_TEXTS: Final = (
    "", "x", "/", "..", "../../x", "a//b", "**", "*", "*a" * 8, "**/a" * 5, "\0", "\x1b[2J",
    "a\nCRITICAL b", "[bold red]x[/]", "\u202egnp.exe", "\ud800", "e\u0301" * 60,
    "n" * NAME_CHARACTERS_MAX, "n" * (NAME_CHARACTERS_MAX + 1), "t" * 66_000,
)  # fmt: skip
_INTEGERS: Final = (
    0, 0, 1, 1, 2, -1, 5, 4096, 1_000_000_000, 1_800_000_000_000_000_000, 1 << 62,
    INTEGER_MAX - 1, INTEGER_MAX, -INTEGER_MAX, -INTEGER_MAX - 1,
)  # fmt: skip
_BYTES: Final = (b"", b"x", b"\xff" * 300, b"\xc1" * 5000)
_LENGTHS: Final = (0, 1, 1, 1, 2, 2, 3, 40)
_USUAL: Final[dict[str, tuple[Any, ...]]] = {
    "access": (*(access.value for access in Access), 0, 99, -1),
    "epoch": (1, 1, 1, 0, 2, INTEGER_MAX),
    "known_epoch": (0, 1, 2, INTEGER_MAX),
    "map_version": (1, 1, 1, 0),
    "lane": (0, 0, 1, -1, INTEGER_MAX),
    "seq": (1, 2, 3, 4, 0, -1, INTEGER_MAX),
    "number": (1, 2, 3, 4, 5, 0, -1, INTEGER_MAX),
    "version": (0, 1, 2, -1, INTEGER_MAX),
    "session": (*SESSIONS, *SESSIONS, "zed", ""),
    "context": ("online", "online", "training", "nowhere", "made"),
    "entity": ("piece", "bench", "a/**", "*", "a**b"),
    "aspect": ("count", "note", "frame", "wrong"),
    "name": ("count", "wrong", "s0", "made"),
    "world": ("made", "online", "nowhere"),
    "source": ("online", "training", "made", "nowhere"),
    "shard": ("s0", "far", "nosuch"),
    "durability": ("", "durable", "os", "volatile", "bogus"),
    "fingerprint": ("int", "str"),
    "file": ("", "ann-1", "ann-2", "../x"),
    "label": ("good/run", "a"),
}
"""What a field holds most of the time, by its name; else any of the edges of its type."""
_SAME_AS: Final = {
    "pattern": "entity",
    "patterns": "entity",
    "contexts": "context",
    "aspects": "aspect",
    "worlds": "world",
    "primary": "shard",
    "asker": "shard",
    "participants": "shard",
}
_HONEST: Final[dict[str, Any]] = {
    "epoch": 1,
    "map_version": 1,
    "participants": (),
    "primary": "far",
    "expects": (),
    "seen_stamp_ns": 0,
    "at_ns": 0,
    "reads": (),
    "reads_left_out": 0,
}
_SLOTS: Final = (
    Slot("online", "piece", "count"),
    Slot("online", "piece", "frame"),
    Slot("training", "bench", "note"),
)


class Hostile:
    """A source of requests, always the same ones for the same random numbers."""

    def __init__(self, random: Random) -> None:
        self._random = random
        self._sequence = 0

    def request(self, grants: dict[LockId, Granted]) -> Request:
        """Return a request, often under a lock that is held: else few get past the first check."""
        random = self._random
        dice = random.random()
        if dice < 0.08:
            return Hello(random.choice(SESSIONS), 1, 2_000_000_000, "", "host", 1, False)
        if dice < 0.35:
            return self._honest_acquire()
        kind: Any = random.choice((*KINDS, Commit, Prepare, Validate, Stage))
        names = {field.name for field in fields(kind)}
        request: Request = self._part(kind)
        if random.random() < 0.5:
            usual: dict[str, Any] = {"epoch": 1, "after": START, "session": random.choice(SESSIONS)}
            request = replace(request, **{name: usual[name] for name in usual if name in names})
        if "lock" not in names or not grants or random.random() < 0.2:
            return request
        grant = random.choice(list(grants.values())[-2:])
        changes: dict[str, Any] = {"lock": grant.lock}
        if "token" in names:
            changes["token"] = grant.token
        if "writes" in names and random.random() < 0.8:
            datum = self._datum() if random.random() < 0.5 else None
            held = [state.slot for state in grant.states] or _SLOTS
            changes["writes"] = (WriteItem(random.choice(held), datum),)
        if random.random() < 0.6:
            changes |= {name: value for name, value in _HONEST.items() if name in names}
        changed: Request = replace(request, **changes)
        return changed

    def word_of_another_shard(self, grants: dict[LockId, Granted]) -> Resolved:
        """Return what a hostile primary may answer."""
        lock = self._random.choice(list(grants)) if grants else self._part(LockId)
        kind = self._random.choice(("committed", "aborted", "open", "bogus", ""))
        return Resolved(lock, kind, Position(self._any("stamp_ns", int), "far"))

    def _honest_acquire(self) -> Acquire:
        random = self._random
        self._sequence += 1
        lock = LockId(random.choice(SESSIONS), random.choice((0, 1)), self._sequence)
        access, slot = random.choice((*Access, *[Access.WRITE] * 6)), random.choice(_SLOTS)
        entity = "*" if access.each else slot.entity
        item = Item(int(access), slot.context, entity, slot.aspect)
        return Acquire(lock, 1, 1, 0, (item,), 0, 60_000_000_000, 0)

    def _part(self, kind: Any) -> Any:
        return kind(*(self._any(name, of) for name, of in annotated(kind)))

    def _any(self, name: str, kind: Any) -> Any:
        random = self._random
        inner = without_none(kind)
        if inner is not kind and random.random() < 0.2:
            return None
        if inner is Datum:
            return self._datum()
        if get_origin(inner) is tuple:
            one = get_args(inner)[0]
            return tuple(self._any(name, one) for _ in range(random.choice(_LENGTHS)))
        usual = _USUAL.get(_SAME_AS.get(name, name))
        if usual is not None and inner in (int, str) and random.random() < 0.75:
            return random.choice(usual)
        if inner is int:
            return random.choice(_INTEGERS)
        if inner is str:
            return random.choice(_TEXTS)
        if inner is bytes:
            return random.choice(_BYTES)
        if inner is bool:
            return random.random() < 0.5
        return self._part(inner)

    def _datum(self) -> Datum:
        random = self._random
        body = random.choice((b"", b"1", b"x" * 300, b"y" * 70_000))
        encoding = random.choice(_BYTES)
        return Datum(encoding, body, len(body), random.choice(_INTEGERS))
