"""Tables of a configuration file, read by the annotations of dataclasses.

A field is a key of the table: its type is what TOML has to give, its default what holds where the
key is missing, and `TableKey` says what a type cannot::

    drain_s: Annotated[float | None, TableKey(high=3600.0, variable="DRAIN_S")] = None

An unknown key is refused first: a misspelt key must not end as a silent default.  Every error names
the key, what was asked, what was found, and the line.
"""

from __future__ import annotations

import difflib
import inspect
import math
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, NamedTuple, NoReturn, TypeVar

from enact_dist.errors import ConfigError
from enact_dist.terms import checked_name

if TYPE_CHECKING:
    from enact_dist.config.lines import LineLocator, Place

T = TypeVar("T")

_TOML_NAMES: Final = {
    bool: "a boolean",
    int: "an integer",
    float: "a float",
    str: "a string",
    list: "an array",
    dict: "a table",
}


@dataclass(frozen=True, slots=True)
class TableKey:
    """What a field's type does not say of its key.

    Attributes:
        name: Its name in the file, where that is not the field's.
        older: An older name of a table; what stands under both names is merged.
        low: The least number that is allowed.
        high: The largest number that is allowed.
        choices: The texts that are allowed; none: any.
        make: Makes the value of what the file gives; its `ValueError` says what is wrong.
        table: The class whose fields are the keys, where the field's own type is another.
        blank: Whether the texts of a table may be empty.
        example: What to write, for the error about a missing or empty key.
        variable: The environment variable that overrides the key, without its prefix.
        title: What the table itself names: the field is that name, not a key.
        given: The field is no key; its value comes from elsewhere.
        inline: The fields of this dataclass are keys of the same table.
    """

    name: str = ""
    older: str = ""
    low: float = 0.0
    high: float = math.inf
    choices: tuple[str, ...] = ()
    make: Callable[[Any], object] | None = None
    table: type | None = None
    blank: bool = False
    example: str = ""
    variable: str = ""
    title: str = ""
    given: bool = False
    inline: bool = False


class Field(NamedTuple):
    """A field of a class that describes a table.

    Attributes:
        kind: Its type, without None.
        required: Whether it has no default.
    """

    name: str
    kind: Any
    required: bool
    key: TableKey

    @property
    def choices(self) -> tuple[str, ...]:
        """The texts that are allowed; none: any."""
        is_enum = isinstance(self.kind, type) and issubclass(self.kind, Enum)
        return tuple(one.value for one in self.kind) if is_enum else self.key.choices

    @property
    def item(self) -> Any:
        """The type of each item, of a tuple."""
        return typing.get_args(self.kind)[0]


@cache
def fields_of(kind: Any) -> tuple[Field, ...]:
    """Return the fields of a class that describes a table, each with its key."""
    found = []
    parameters = inspect.signature(kind).parameters
    for name, hint in typing.get_type_hints(kind, include_extras=True).items():
        key, plain = TableKey(), hint
        if typing.get_origin(hint) is typing.Annotated:
            plain, key = typing.get_args(hint)
        if isinstance(plain, types.UnionType) and type(None) in typing.get_args(plain):
            (plain,) = (one for one in typing.get_args(plain) if one is not type(None))
        required = parameters[name].default is inspect.Parameter.empty
        found.append(Field(name, plain, required, key))
    return tuple(found)


def keys_of(kind: type) -> tuple[str, ...]:
    """Return the names of the keys of a table that a class describes."""
    keys: list[str] = []
    for one in fields_of(kind):
        if one.key.inline:
            keys += keys_of(one.kind)
        elif not one.key.given and not one.key.title:
            keys += [one.key.name or one.name, *filter(None, [one.key.older])]
    return tuple(keys)


def suggestion(found: str, known: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` when one of `known` is close to `found`, else nothing."""
    close = difflib.get_close_matches(found, list(known), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def path_of(text: str) -> Path:
    """Return the path that a text names, where `~` is a user's home.

    Raises:
        ConfigError: There is no such home: nothing may end in a folder that is called `~`.
    """
    try:
        return Path(text).expanduser()
    except RuntimeError:
        raise ConfigError(
            f"{text!r} begins with a home that is not known; write the whole path (~ needs HOME, or"
            " an entry of the user in /etc/passwd)"
        ) from None


@dataclass(frozen=True, slots=True)
class ConfigSource:
    """Where a configuration comes from.

    Attributes:
        path: The file, as messages name it.
        locator: Finds the line of an error.
        folder: What relative paths are relative to.
    """

    path: str
    locator: LineLocator
    folder: Path

    def refuse(self, where: Place, problem: str) -> NoReturn:
        """Raise `ConfigError` about the value at `where`."""
        line = self.locator.line(where)
        raise ConfigError(f"{self.path}, line {line}: {problem}", path=self.path, line=line)


@dataclass(frozen=True, slots=True)
class Table:
    """A table of the file: its values, its place and the source they stand in."""

    values: Mapping[str, Any]
    where: Place
    source: ConfigSource

    @property
    def title(self) -> str:
        """The table as the file writes it: ``[shards.left]``."""
        name = ".".join(str(part) for part in self.where if isinstance(part, str))
        return f"[{name}]" if name else "the file"

    def refuse(self, key: str | int, problem: str) -> NoReturn:
        """Raise `ConfigError` about `key` of this table, or about the table where it is absent."""
        where = (*self.where, key) if key in self.values else self.where
        self.source.refuse(where, problem)

    def table(self, key: str) -> Table:
        """Return the table at `key`, an empty one when it is absent."""
        found = self.values.get(key, {})
        if not isinstance(found, dict):
            self._refuse_type(key, "a table", found)
        return Table(found, (*self.where, key), self.source)

    def tables(self, key: str) -> list[Table]:
        """Return the tables of the array of tables at `key`."""
        found = self.values.get(key, [])
        if not isinstance(found, list):
            self.refuse(key, f"{key!r} is an array of tables ([[{key}]]), not {_shown(found)}")
        for index, item in enumerate(found):
            if not isinstance(item, dict):
                where = (*self.where, key, index)
                self.source.refuse(where, f"{key!r} holds tables ([[{key}]]), not {_shown(item)}")
        return [Table(item, (*self.where, key, at), self.source) for at, item in enumerate(found)]

    def record(self, kind: type[T], **given: object) -> T:
        """Return the table as an object of a class whose fields are its keys, or `given`.

        Raises:
            ConfigError: A key is unknown or missing, or its value cannot be used.
        """
        known = keys_of(kind)
        for key in self.values:
            if key not in known:
                self.refuse(
                    key,
                    f"unknown key {key!r} in {self.title}{suggestion(key, known)}"
                    f" (known here: {', '.join(sorted(known))})",
                )
        return self._made(kind, given)

    def _made(self, kind: type[T], given: Mapping[str, object]) -> T:
        values = dict(given)
        described: type = kind
        for one in fields_of(described):
            name = one.key.name or one.name
            if one.key.title:
                values[one.name] = self._title(one.key.title)
            elif one.key.inline:
                values[one.name] = self._made(one.kind, {})
            elif name in self.values or one.key.older in self.values:
                values[one.name] = self._value(name, one)
            elif one.required and one.name not in given:
                example = f", such as {one.key.example}" if one.key.example else ""
                self.refuse(name, f"{self.title} needs the key {name!r}{example}")
        try:
            return kind(**values)
        except ConfigError as error:
            first = next((key for key in keys_of(kind) if key in self.values), "")
            self.refuse(first, f"in {self.title} {error}")

    def _title(self, kind: str) -> str:
        """Return the name that the table's own title gives."""
        try:
            return checked_name(kind, self.where[-1], slashes=False)
        except ValueError as error:
            self.source.refuse(self.where, str(error))

    def _value(self, name: str, one: Field) -> object:
        """Return the value at `name` as its field wants it."""
        found, kind = self.values.get(name), one.kind
        if typing.get_origin(kind) is tuple and typing.get_args(kind)[-1] is Ellipsis:
            return self._items(name, one)
        if one.key.table is not None:
            if isinstance(found, dict):
                found = self.table(name).record(one.key.table)
            elif one.key.make is None:
                self.refuse(name, f"{name!r} is a table; write {one.key.example}")
            return self._ready(name, one, found)
        if typing.get_origin(kind) is Mapping:
            return self._mapping(name, one)
        if isinstance(kind, types.UnionType) and isinstance(found, dict):
            return self._mapping(name, one)
        if kind is float or kind is int:
            return self._number(name, one)
        if kind is not bool:
            return self.text(name, one)
        if not isinstance(found, bool):
            self._refuse_type(name, "a boolean", found)
        return found

    def text(self, name: str, one: Field) -> object:
        """Return what a field makes of the string at `name`."""
        found = self.values[name]
        if not isinstance(found, str):
            self._refuse_type(name, "a string", found)
        if not found and (one.required or one.key.make or one.choices or one.kind is Path):
            self._refuse_empty(name, one)
        if one.choices and found not in one.choices:
            self.refuse(
                name,
                f"unknown {name} {found!r}{f' in {self.title}' if self.where else ''}"
                f"{suggestion(found, one.choices)} (known: {', '.join(one.choices)})",
            )
        if one.kind is Path:
            try:
                return self.source.folder / path_of(found)
            except ConfigError as error:
                self.refuse(name, f"{name!r} in {self.title}: {error}")
        return one.kind(found) if one.choices else self._ready(name, one, found)

    def _number(self, name: str, one: Field) -> float:
        found, low, high = self.values[name], one.key.low, one.key.high
        if one.kind is int:
            if type(found) is not int or found < low:
                least = " above 0" if low else ", 0 or more"
                self._refuse_type(name, f"a whole number{least}", found)
            return found
        if isinstance(found, bool) or not isinstance(found, int | float):
            self._refuse_type(name, "a number", found)
        if not low <= found <= high:
            allowed = f"lie between {low:g} and {high:g}"
            self.refuse(name, f"{name!r} in {self.title} must {allowed}, not {found!r}")
        return float(found)

    def _items(self, name: str, one: Field) -> tuple[object, ...]:
        """Return the items of an array; one bare string counts as an array of one."""
        if one.key.table is not None:
            return tuple(
                self._ready(name, one, table.record(one.key.table)) for table in self.tables(name)
            )
        if one.item not in (str, float):
            names = self.table(name)
            return tuple(names.table(each).record(one.item) for each in names.values)
        found, wanted = self.values[name], "strings" if one.item is str else "numbers"
        items = [found] if isinstance(found, str) and one.item is str else found
        if not isinstance(items, list):
            self._refuse_type(name, f"an array of {wanted}", found)
        kinds = str if one.item is str else int | float
        if one.key.example and ("" in items or (one.required and not items)):
            self._refuse_empty(name, one)
        for index, item in enumerate(items):
            if isinstance(item, bool) or not isinstance(item, kinds) or item == "":
                problem = f"{name!r} in {self.title} is an array of {wanted}, not {_shown(item)}"
                self.source.refuse((*self.where, name, index), problem)
        if one.item is float:
            return tuple(map(float, items))
        return tuple(
            self._ready(name, one, item, index if isinstance(found, list) else None)
            for index, item in enumerate(items)
        )

    def _mapping(self, name: str, one: Field) -> Mapping[str, object]:
        table = self.table(name)
        if typing.get_args(one.kind)[-1] is object:
            older = self.table(one.key.older)
            for key in table.values:
                if key in older.values:
                    names = f"{name} and in {one.key.older}"
                    table.refuse(key, f"{key!r} stands in {names} of {self.title}")
            return MappingProxyType({**older.values, **table.values})
        text = Field("", str, not one.key.blank, TableKey())
        return MappingProxyType({key: table.text(key, text) for key in table.values})

    def _ready(self, name: str, one: Field, found: object, index: int | None = None) -> object:
        """Return what the key makes of a value that was found."""
        if one.key.make is None:
            return found
        try:
            return one.key.make(found)
        except ValueError as error:
            where = (*self.where, name) if index is None else (*self.where, name, index)
            self.source.refuse(where, str(error))

    def _refuse_type(self, name: str, wanted: str, found: object) -> NoReturn:
        self.refuse(name, f"{name!r} in {self.title} is {wanted}, not {_shown(found)}")

    def _refuse_empty(self, name: str, one: Field) -> NoReturn:
        example = one.key.example
        problem = f"empty; write one, such as {example}" if example else "an empty string"
        self.refuse(name, f"{name!r} in {self.title} is {problem}")


def _shown(value: object) -> str:
    """Return the type of a value, as TOML calls it, and the value."""
    text, kind = repr(value), _TOML_NAMES.get(type(value), "a date or time")
    return f"{kind} ({text if len(text) <= 60 else text[:59] + '…'})"
