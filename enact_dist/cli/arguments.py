"""What verbs take: the types of their options, and the options that several share."""

from __future__ import annotations

import argparse
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from enact_dist.cli.target import CELL_DEFAULT, CELL_VARIABLE, TIMEOUT_S
from enact_dist.cli.verbs import Option, flag, many, option
from enact_dist.errors import ConfigError
from enact_dist.terms import Entities, Entity, checked_name

if TYPE_CHECKING:
    from collections.abc import Iterator

    from enact_dist.comparing import Tolerance


@contextmanager
def in_words() -> Iterator[None]:
    """Let `argparse` print the text of a `ValueError`, not the name of the type alone."""
    try:
        yield
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def duration(text: str) -> float:
    """Read a number of seconds, 0 included; an `argparse` type."""
    return 0.0 if text.strip() in {"0", "0.0"} else seconds(text)


def above_zero(text: str, what: str = "number") -> float:
    """Read a positive number; an `argparse` type."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is no {what} above zero")
    return value


def seconds(text: str) -> float:
    """Read a positive number of seconds; an `argparse` type."""
    return above_zero(text, "number of seconds")


@in_words()
def one_entity(text: str) -> Entity:
    """Read the name of one entity; an `argparse` type."""
    return Entity(text)


def whole(text: str) -> int:
    """Read a whole number above zero; an `argparse` type."""
    if not text.isdecimal() or not int(text):
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number above zero")
    return int(text)


@in_words()
def endpoints(text: str) -> str:
    """Check endpoints, comma separated, or none; an `argparse` type."""
    from enact_dist.config.types import checked_endpoint

    for endpoint in text.split(","):
        if endpoint.strip():
            checked_endpoint(endpoint.strip())
    return text


@in_words()
def address(text: str) -> str:
    """Check where metrics are to be served, or nothing; an `argparse` type."""
    from enact_dist.config.types import metrics_address

    if text:
        metrics_address(text)
    return text


@in_words()
def entities(text: str) -> str:
    """Read a pattern of entities; an `argparse` type."""
    return str(Entities(text))


@in_words()
def world_name(text: str) -> str:
    """Check the name of a world context that is to be made; an `argparse` type."""
    checked_name("world context", text, slashes=False)
    return text


@in_words()
def label(text: str) -> str:
    """Check a label for pinned versions; an `argparse` type."""
    checked_name("label", text, slashes=True)
    return text


def pair(text: str) -> tuple[str, str]:
    """Read ``name=value``; an `argparse` type."""
    name, equals, value = text.partition("=")
    if not equals or not name:
        raise argparse.ArgumentTypeError(f"{text!r} is not written name=value")
    return name, value


def pairs(found: list[tuple[str, str]] | None, option: str) -> dict[str, str]:
    """Return repeated ``name=value`` options as a dict; a name given twice is refused.

    Raises:
        ConfigError: A name is given twice.
    """
    read: dict[str, str] = {}
    for name, value in found or ():
        if name in read:
            raise ConfigError(f"{option} {name} is given twice: {read[name]!r} and {value!r}")
        read[name] = value
    return read


def slot_parts(text: str) -> tuple[str, str]:
    """Read ``ENTITY/ASPECT``, split at the last slash, whatever the two are."""
    entity, slash, aspect = text.rpartition("/")
    if not slash or not entity or not aspect:
        raise argparse.ArgumentTypeError(f"{text!r} is not written ENTITY/ASPECT")
    return entity, aspect


@in_words()
def slot_name(text: str) -> tuple[str, str]:
    """Read ``ENTITY/ASPECT``, two names and no pattern; an `argparse` type."""
    entity, aspect = slot_parts(text)
    checked_name("entity", entity, slashes=True)
    checked_name("aspect", aspect, slashes=False)
    return entity, aspect


VERSION_DIGITS_MAX: Final = 18
"""A version has 63 bits."""


def slot_version(text: str) -> tuple[str, str, int]:
    """Read ``ENTITY/ASPECT[@VERSION]``, version 0 if none is named; an `argparse` type."""
    name, at, number = text.partition("@")
    slot = slot_name(name)
    if at and not (number.isdecimal() and len(number) <= VERSION_DIGITS_MAX and int(number)):
        raise argparse.ArgumentTypeError(f"{text!r} does not name a version as @12")
    return *slot, int(number or 0)


def tolerance(text: str) -> tuple[str, Tolerance]:
    """Read ``[ASPECT=]X`` or ``[ASPECT=]X%``; an `argparse` type."""
    from enact_dist.comparing import Tolerance

    aspect, _, figure = text.rpartition("=")
    try:
        if figure.endswith("%"):
            return aspect, Tolerance(relative=float(figure[:-1]) / 100.0)
        return aspect, Tolerance(absolute=float(figure))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r} is no tolerance; write 0.5, 1%, shift_mm=0.5 or shift_mm=1%"
        ) from None


# ---------------------------------------------------------------- shared options

_DEFAULT: Final = f"(default: ${CELL_VARIABLE}, else ./{CELL_DEFAULT})"

CELL: Final = option(
    "--cell", "CELL", f"a cell.toml or an endpoint such as tcp/host:7447 {_DEFAULT}"
)
CELL_FILE: Final = option("--cell", "FILE", f"a cell.toml {_DEFAULT}")
"""Of verbs that need what only the file says."""
CELL_NAMED: Final = option("cell", "CELL", f"a cell.toml or an endpoint {_DEFAULT}", nargs="?")
JSON: Final = flag("--json", "print JSON instead of text")
TIMEOUT: Final = option(
    "--timeout", "S", "seconds to wait for a shard that does not answer (default: 5)",
    dest="timeout_s", type=seconds, default=TIMEOUT_S,
)  # fmt: skip
READER: Final = (CELL, JSON, TIMEOUT)
"""Of verbs that print what they find."""
WORLD: Final = option("world", "WORLD", "name of the world context")
PATTERN: Final = option(
    "pattern",
    "PATTERN",
    "pattern of entities (default: all)",
    type=entities,
    nargs="?",
    default="**",
)
ENTITIES: Final = option(
    "--entities", "PATTERN", "only these entities", type=entities, default="**"
)
ASPECTS: Final = many("--aspect", "NAME", "only these aspects")
SLOT: Final = option("slot", "ENTITY/ASPECT", "which datum", type=slot_name)
COMPRESSIONS: Final = ("zstd", "lz4", "none")
"""Of the chunks of a recording."""
LOG: Final = option(
    "--log", None, "format of the log; json: one object per line (see docs/operations.md)",
    choices=("text", "json"), default="text",
)  # fmt: skip


def counted(name: str, text: str, default: int | None = None) -> Option:
    """Return an option that takes a whole number above zero."""
    return option(name, "N", text, type=whole, default=default)


def seconds_of(name: str, text: str, default: float | None = None, **settings: Any) -> Option:
    """Return an option that takes a number of seconds above zero."""
    return option(name, "S", text, type=seconds, default=default, **settings)


def file_of(name: str, metavar: str, text: str, **settings: Any) -> Option:
    """Return an option that takes the path of a file or a folder."""
    return option(name, metavar, text, type=Path, **settings)
