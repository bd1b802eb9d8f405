"""Addresses, identities and the datum as the core sees it: opaque bytes with an encoding.

The core never looks into a datum: `encoding` and `body` are made and read by `enact_dist.wire`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar, dataclass_transform

T = TypeVar("T")


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def message(cls: type[T]) -> type[T]:
    """Make a dataclass of a message, record or datum: with slots, and never changed once made.

    The type checker enforces that it never changes.  A dataclass that is also frozen at run time
    takes five times as long to create, and one update creates thirty.
    """
    return dataclass(slots=True, unsafe_hash=True)(cls)


class Slot(NamedTuple):
    """The unit of locking, versioning and history: one datum of one world context."""

    context: str
    entity: str
    aspect: str

    def __str__(self) -> str:
        return f"{self.context}:{self.entity}/{self.aspect}"


class Column(NamedTuple):
    """All slots of one aspect in one context on one shard; what a pattern locks."""

    context: str
    aspect: str

    def __str__(self) -> str:
        return f"{self.context}:*/{self.aspect}"


class LockId(NamedTuple):
    """Identity of one lock: request id, owner and exactly-once key in one.

    `session` is random per process, `lane` one per thread, `seq` grows by one per lock.
    A seq is granted at most once.
    """

    session: str
    lane: int
    seq: int

    def __str__(self) -> str:
        return f"{self.session[:8]}.{self.lane}.{self.seq}"


class Token(NamedTuple):
    """Fencing number of a grant: grows over all grants of a shard, over its restarts too."""

    epoch: int
    number: int


class Position(NamedTuple):
    """The position of a commit in time: its hybrid logical timestamp and its shard."""

    stamp_ns: int
    shard: str


@message
class Datum:
    """One immutable value of an aspect's data set D_j, opaque to the shard.

    Attributes:
        encoding: How `wire` reads the body (msgpack, a few bytes up to some kB).
        body: `size` bytes that are never changed any more; a memoryview may cover a mapped file.
            Empty if only `file` names them.
        size: Length of the body in bytes.
        stamp_ns: When the datum was captured, nanoseconds since 1970 by the actor's clock; 0
            if the actor did not set it.
        file: Name of the payload at the slot's shard that holds these bytes, so that they need
            not travel with a message ("": none).
        fault: Returns what is wrong with the bytes ("": nothing); call it before handing them out.
            None: they are known to be intact.
    """

    encoding: bytes
    body: bytes | memoryview
    size: int
    stamp_ns: int = 0
    file: str = ""
    fault: Callable[[], str] | None = field(default=None, compare=False, repr=False)
