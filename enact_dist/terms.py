"""The paper's nouns: entity, aspect, lock request, null.  Values without behaviour.

==================  =====================================================  =====================
paper (ENACT 3)     here                                                   departure
==================  =====================================================  =====================
entity e_i          `Entity("tray/package/3")`                             the name is the identity:
                                                                           pointers cannot travel
set E_a             `Entities("tray/package/*")`                           entities come at run time
                                                                           (4.2 against 3.1)
aspect a_j, D_j     `Aspect("surface", Surface)`                           carries the datum type
null                `None` of `get`, or `NullDatumError`                   says why nothing is known
lock request        `Read`, `Write`, `View` and their `…Each`              may name several contexts
==================  =====================================================  =====================

Requests are values: two that name the same context, entity, aspect and access are equal.
"""

from __future__ import annotations

import dataclasses
import enum
import re
import secrets
import typing
import warnings
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, TypeVar

from enact_dist.errors import DatumTypeError
from enact_dist.patterns import checked_pattern, pattern_matches
from enact_dist.retention import DEFAULT_RETENTION as DEFAULT_RETENTION  # noqa: PLC0414
from enact_dist.retention import Retention as Retention  # noqa: PLC0414 - both are found here, too
from enact_dist.retention import checked_retention

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from enact_dist.comparing import Comparator

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)
"""Type of the datum that a request names; covariant, since reading allows a supertype."""

NAME_LENGTH_MAX: Final = 200
"""Longest name of an entity, aspect or world context; keeps every key of the wire below 1 kB."""

_SEGMENT = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]*\Z")


def checked_name(kind: str, name: object, *, slashes: bool) -> str:
    """Return `name` if it may name a `kind`, else raise `ValueError` with what is wrong.

    Args:
        kind: What is named, for the message ("entity", "aspect", "world context").
        name: The candidate.
        slashes: Whether the name is a slash path.

    Raises:
        ValueError: Not a string, empty, too long, or a character outside ``A-Z a-z 0-9 _ . -``.
    """
    if not isinstance(name, str) or not name:
        raise ValueError(f"a name of {kind} is a non-empty string, not {name!r}")
    if len(name) > NAME_LENGTH_MAX:
        raise ValueError(
            f"the name of {kind} {name[:40]!r}… has {len(name)} characters;"
            f" at most {NAME_LENGTH_MAX}"
        )
    for segment in name.split("/") if slashes else [name]:
        if not _SEGMENT.match(segment):
            raise ValueError(
                f"{name!r} cannot name {'an' if kind[0] in 'ae' else 'a'} {kind}: {segment!r} must"
                " be letters, digits, '_', '.' or '-' and start with a letter, digit or '_'"
                + ("; segments are separated by single slashes" if slashes else "")
            )
    return name


@dataclass(frozen=True, slots=True, order=True)
class Entity:
    """An object of interest, known by its name, an immutable slash path (ENACT 3.1).

    Raises:
        ValueError: The name is not a slash path of letters, digits, ``_ . -``.
    """

    name: str

    def __post_init__(self) -> None:
        checked_name("entity", self.name, slashes=True)

    @staticmethod
    def fresh(prefix: str) -> Entity:
        """Return an entity whose name is unique: `prefix`/ and 64 random bits.

        Names replace the paper's heap addresses (3.3), which were unique for the same purpose.
        """
        return Entity(f"{prefix}/{secrets.token_hex(8)}")

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True, slots=True, order=True)
class Entities:
    """A set of entities, written as a name pattern (the paper's E_a).

    ``*`` inside a segment matches any characters but the slash; a segment ``**`` matches any
    number of whole segments, also none.  A segment has at most 8 stars, a pattern at most 4 of
    the segments ``**``.

    Raises:
        ValueError: A segment holds a character that no entity name can have, or too many stars.
    """

    pattern: str

    def __post_init__(self) -> None:
        checked_pattern(self.pattern)

    def matches(self, entity: Entity) -> bool:
        """Say whether the pattern covers `entity`."""
        return pattern_matches(self.pattern, entity.name)

    def __str__(self) -> str:
        return self.pattern


class Durability(enum.Enum):
    """What a reported commit of an aspect survives.

    A commit takes the strictest class of its data.  One over several shards is forced to the disk
    on each of them, whatever the class: it is atomic, even after a power cut, until
    a later commit replaces its data.  Volatile data still end with their shard's process.
    """

    DURABLE = "durable"
    """`kill -9` and power loss: on disk before the answer."""
    OS = "os"
    """`kill -9`, not power loss: with the operating system before the answer."""
    VOLATILE = "volatile"
    """Neither: in memory only, for data that the next camera frame replaces."""


@dataclass(frozen=True, slots=True)
class Aspect(Generic[T]):
    """A property class of entities with the type of its data (the paper's a_j with D_j).

    A cell knows an aspect from the first lock on that may write it; reading registers nothing.

    Args:
        name: Letters, digits, ``_ . -``.
        datum_type: `int`, `float`, `bool`, `str`, `bytes`, `list`, `dict`, `numpy.ndarray`, a
            frozen dataclass of these, or a type with a codec that was registered before.  The
            whole list: `enact_dist/docs/data.md`.
        durability: What a commit of this aspect survives; ``None`` leaves it to `cell.toml`
            (there: `durable` unless written otherwise).  `cell.toml` wins over this argument.
        retention: How much of each datum's history stays, as a number of versions (the newest
            included; 1 keeps no history) or a `Retention`; ``None`` leaves it to `cell.toml`
            (there: `DEFAULT_RETENTION` unless written otherwise).  If several programs and
            `cell.toml` ask, the largest figures count.
        compare: How `WorldContext.diff` compares its data; it does not affect whether two aspects
            are the same.

    Raises:
        ValueError: The name is not allowed, or the retention is invalid.
        DatumTypeError: The type is a dataclass that is not frozen, or contains one.
    """

    name: str
    datum_type: type[T]
    durability: Durability | None = None
    retention: Retention | int | None = None
    compare: Comparator[T] | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        checked_name("aspect", self.name, slashes=False)
        try:
            checked_retention(self.retention)
        except ValueError as error:
            raise ValueError(f"aspect {self.name!r}: {error}") from None
        try:
            refuse_unfrozen(self.datum_type)
        except DatumTypeError as error:
            raise DatumTypeError(f"aspect {self.name!r}: {error}") from None

    def __str__(self) -> str:
        return self.name


CODED: Final[set[type[Any]]] = set()
"""The types with a registered codec; they need not be frozen."""
_frozen: set[type[Any]] = set()
"""The dataclasses that were checked: they are frozen, with all that they contain."""


def refuse_unfrozen(hint: Any, where: str = "") -> None:
    """Raise `DatumTypeError` if a type contains a dataclass that is not frozen.

    `where` is the place of the type in an outer one, for the message.

    A dataclass whose annotations cannot be resolved yet is not checked further.
    """
    if not isinstance(hint, type) or typing.get_origin(hint) is not None:
        for part in typing.get_args(hint):
            refuse_unfrozen(part, where)
        return
    if hint in CODED or hint in _frozen or not dataclasses.is_dataclass(hint):
        return
    if not hint.__dataclass_params__.frozen:  # type: ignore[attr-defined]  # of every dataclass
        raise DatumTypeError(
            f"{where and where + ': '}dataclass {hint.__qualname__} is not frozen, but data are"
            " immutable values; write @dataclass(frozen=True), or first call"
            f" register_codec({hint.__qualname__}, …)"
        )
    try:
        hints = typing.get_type_hints(hint)
    except (NameError, TypeError, AttributeError):
        return
    _frozen.add(hint)  # first: one that contains itself is refused by name where it is used
    try:
        for name in (one.name for one in dataclasses.fields(hint)):
            refuse_unfrozen(hints[name], f"{where or hint.__qualname__}.{name}")
    except DatumTypeError:
        _frozen.discard(hint)
        raise


class NullReason(enum.Enum):
    """Why a world context does not know a datum."""

    NEVER_SET = "never set"
    DELETED = "deleted"
    EXPIRED = "expired"
    LOST = "lost: the aspect is volatile and its shard restarted"
    OUTSIDE_RETENTION = "outside retention"


class Access(enum.IntEnum):
    """What a lock request asks for; the numbers travel on the wire."""

    READ = 1
    WRITE = 2
    VIEW = 3
    READ_EACH = 4
    WRITE_EACH = 5
    VIEW_EACH = 6

    # Plain attributes instead of properties: every request of every lock reads them.
    each: bool
    """Whether the request names a pattern of entities."""
    locks: bool
    """Whether the request holds a lock until the block ends."""
    writes: bool
    """Whether the request allows to set a datum."""

    def __init__(self, number: int) -> None:
        self.each = number >= 4
        self.locks = number not in (3, 6)
        self.writes = number in (2, 5)


ACCESSES: Final = {access.value: access for access in Access}
"""The accesses by number: a look-up takes a third of the time of `Access(number)`."""


class FormerNames:
    """Finds methods and attributes by the names of the release before, with a warning."""

    __slots__ = ()
    former: ClassVar[Mapping[str, str]] = {}
    """The former names, and what they are called now."""

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Return what had this name; the next release drops it."""
            kind, new = type(self), type(self).former.get(name)
            if new is None:
                raise AttributeError(f"{kind.__name__!r} object has no attribute {name!r}")
            text = f"{kind.__name__}.{name} is now {kind.__name__}.{new}"
            warnings.warn(text, DeprecationWarning, stacklevel=2)
            return getattr(self, new)


class Context:
    """Anything that names a world context: a `WorldContext` of a cell, or a `World` role."""

    __slots__ = ("name",)
    past: ClassVar[bool] = False
    """Whether it shows the past, which can only be viewed."""

    def __init__(self, name: str) -> None:
        self.name = checked_name("world context", name, slashes=False)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r})"


class World(Context):
    """A role that an actor class names and that is bound to a world context when the actor runs."""

    __slots__ = ()


@dataclass(frozen=True, slots=True, weakref_slot=True, eq=False, repr=False)
class LockRequest(Generic[T_co]):
    """One line of a lock: which datum, and what for.  Use its subclasses.

    Args:
        world: The world context; in an actor class, a `World` role.
        entity: The entity; in an actor class also a pattern, standing for the triggering entity.
        aspect: The aspect.

    Attributes:
        address: Names of the context, of the entity (or pattern) and of the aspect.

    Raises:
        TypeError: The arguments are not in that order or not of these types.
    """

    world: Context
    entity: Entity | Entities
    aspect: Aspect[T_co]
    access: ClassVar[Access]
    address: tuple[str, str, str] = field(init=False)
    _hash: int = field(init=False)

    def __post_init__(self) -> None:
        allowed = (Entities,) if self.access.each else (Entity, Entities)
        for name, wanted in (("world", (Context,)), ("entity", allowed), ("aspect", (Aspect,))):
            found = getattr(self, name)
            if not isinstance(found, wanted):
                call = f"{type(self).__name__}(world, entity, aspect)"
                raise wrong_argument(call, name, found, *wanted)
        # Every lock asks for both several times, and a request never changes.
        address = self.world.name, str(self.entity), self.aspect.name
        object.__setattr__(self, "address", address)
        object.__setattr__(self, "_hash", hash((self.access, address)))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, LockRequest):
            return NotImplemented
        return self.access == other.access and self.address == other.address

    def __hash__(self) -> int:
        return self._hash

    def __repr__(self) -> str:
        return f"{type(self).__name__}({'/'.join(self.address[:2])} {self.address[2]})"


class LockRequestOne(LockRequest[T_co]):
    """A lock request for the datum of one entity."""

    __slots__ = ()


class Read(LockRequestOne[T_co]):
    """Shared lock on one datum, held until the block ends."""

    __slots__ = ()
    access = Access.READ


class Write(LockRequestOne[T]):
    """Exclusive lock on one datum; fetched only if it is read before it is overwritten."""

    __slots__ = ()
    access = Access.WRITE


class View(LockRequestOne[T_co]):
    """The newest committed datum as of the grant, without holding any lock."""

    __slots__ = ()
    access = Access.VIEW


class LockRequestEach(LockRequest[T_co]):
    """A lock request over all entities of a pattern; the matching set is part of it."""

    __slots__ = ()

    if TYPE_CHECKING:

        def __init__(self, world: Context, entity: Entities, aspect: Aspect[T_co]) -> None: ...


class ReadEach(LockRequestEach[T_co]):
    """Shared lock on an aspect of all matching entities, those yet to come included."""

    __slots__ = ()
    access = Access.READ_EACH


class ViewEach(LockRequestEach[T_co]):
    """The newest committed data of all matching entities, without holding any lock."""

    __slots__ = ()
    access = Access.VIEW_EACH


class WriteEach(LockRequestEach[T]):
    """Exclusive lock on an aspect of all matching entities: look, then create, is safe."""

    __slots__ = ()
    access = Access.WRITE_EACH


def wrong_argument(call: str, name: str, found: object, *wanted: type[Any]) -> TypeError:
    """Return the error for an argument of a type that its call cannot use."""
    kinds = " or ".join(kind.__name__ for kind in wanted)
    remedy = ""
    if isinstance(found, str) and Entity in wanted:
        remedy = f"; write Entity({found!r})"
    elif isinstance(found, str) and Aspect in wanted:
        remedy = f"; write Aspect({found!r}, TYPE)"
    return TypeError(f"{call}: {name} is {found!r}, which is no {kinds}{remedy}")


def refuse_duplicates(requests: Iterable[LockRequest[Any]]) -> None:
    """Raise `ValueError` when one datum is named twice with different accesses."""
    seen: dict[tuple[str, str, str], LockRequest[Any]] = {}
    for request in requests:
        first = seen.setdefault(request.address, request)
        if first.access is not request.access:
            raise ValueError(
                f"{first!r} and {request!r} name one datum with different accesses;"
                " ask once, with the stronger access"
            )
