"""What all verbs share: options, how a cell is named and joined, clean ends on signals."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.errors import ConfigError, ShardUnreachableError
from enact_dist.terms import Entities, Entity, checked_name
from enact_dist.wire.texts import shown

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.config.types import CellConfig
    from enact_dist.world.cell import Cell

DONE: Final = 0
FAILED: Final = 1
USAGE: Final = 2
UNREACHABLE: Final = 3
DIFFERENT: Final = 4

CELL_VARIABLE: Final = "ENACT_CELL"
CELL_DEFAULT: Final = "cell.toml"
TIMEOUT_S: Final = 5.0

Verb = argparse.ArgumentParser
"""A parser of one verb, as `add_verb` returns it."""


class Noun(NamedTuple):
    """One command of `enact`.

    Attributes:
        module: Where it stands, below `enact_dist.cli`; loaded when the command is used.
        summary: What the help says of it.
    """

    module: str
    summary: str


NOUNS: Final = {
    "up": Noun("up", "run every shard and actor of a cell on this machine until Ctrl-C"),
    "shard": Noun("shard.shard", "run and list shard daemons"),
    "actor": Noun("actor.actor", "run, list and check actors"),
    "world": Noun("world.world", "look into world contexts, make and compare them, set data"),
    "why": Noun(
        "world.lineage", "show where a datum comes from: who committed it, what it was made of"
    ),
    "impact": Noun(
        "world.lineage", "show what came of a datum: what it was used for, and that in turn"
    ),
    "record": Noun(
        "record", "record every version of a cell's data into an MCAP file until Ctrl-C"
    ),
    "replay": Noun("record", "commit a recording into a cell again, at its pace"),
    "lock": Noun("lock", "look at locks, hold one, break one, resolve one"),
    "doctor": Noun(
        "doctor",
        "check this machine, the way to the cell, and whether that runs by its cell.toml:"
        " libraries, memory, disk, shards, clocks",
    ),
    "bench": Noun(
        "bench",
        "measure locks, commits and data on this machine, beside the raw floor of the same run",
    ),
    "verify": Noun(
        "verify",
        "try to break the locks and commits of this version: simulated faults, a judge, no mercy",
    ),
    "demo": Noun("demo", "run a demonstration"),
    "workcell": Noun("workcell", "calibrate the cameras of a cell"),
}
"""All commands, in the order in which `enact --help` shows them."""


def add_noun(nouns: argparse._SubParsersAction[Verb], name: str) -> Verb:
    """Add a noun and return its parser."""
    summary = NOUNS[name].summary
    return nouns.add_parser(name, help=summary, description=summary)


def add_verb(
    verbs: argparse._SubParsersAction[Verb],
    name: str,
    summary: str,
    *,
    run: Callable[[argparse.Namespace], int],
    example: str,
) -> Verb:
    """Add a verb that `run` carries out; its help ends with `example`."""
    parser = verbs.add_parser(
        name,
        help=summary,
        description=f"{summary[0].upper()}{summary[1:]}.",
        epilog="example"
        + ("s" if "\n" in example else "")
        + ":\n  "
        + example.replace("\n", "\n  "),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument(
        "--debug", action="store_true", default=argparse.SUPPRESS, help="show tracebacks of errors"
    )
    return parser


def verbs_of(noun: Verb) -> argparse._SubParsersAction[Verb]:
    """Return where the verbs of a noun are added."""
    return noun.add_subparsers(metavar="VERB", required=True)


def add_cell(parser: Verb, *, file_only: bool = False) -> None:
    """Add the option that names the cell; some verbs need what only its file says."""
    parser.add_argument(
        "--cell",
        metavar="FILE" if file_only else "CELL",
        help=("a cell.toml" if file_only else "a cell.toml or an endpoint such as tcp/host:7447")
        + f" (default: ${CELL_VARIABLE}, else ./{CELL_DEFAULT})",
    )


def add_world(parser: Verb) -> None:
    """Add the name of the world context that a verb is about."""
    parser.add_argument("world", metavar="WORLD", help="name of the world context")


def add_reader(parser: Verb) -> None:
    """Add the options of a verb that only looks."""
    add_cell(parser)
    parser.add_argument("--json", action="store_true", help="print JSON instead of text")
    add_timeout(parser)


def add_timeout(parser: Verb) -> None:
    """Add the option that says how long to wait for a shard."""
    parser.add_argument(
        "--timeout",
        dest="timeout_s",
        type=seconds,
        default=TIMEOUT_S,
        metavar="S",
        help="seconds to wait for a shard that does not answer (default: 5)",
    )


def add_log(parser: Verb) -> None:
    """Add the option that says what the log on standard error looks like."""
    parser.add_argument(
        "--log",
        choices=("text", "json"),
        default="text",
        help="what the log looks like; json: an object per line (enact_dist.link.log)",
    )


def duration(text: str) -> float:
    """Read a number of seconds, 0 included; an `argparse` type."""
    return 0.0 if text.strip() in {"0", "0.0"} else seconds(text)


def seconds(text: str) -> float:
    """Read a positive number of seconds; an `argparse` type."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is no number of seconds above zero")
    return value


def one_entity(text: str) -> Entity:
    """Read the name of one entity; an `argparse` type."""
    try:
        return Entity(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def whole(text: str) -> int:
    """Read a whole number above zero; an `argparse` type."""
    if not text.isdecimal() or not int(text):
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number above zero")
    return int(text)


def endpoints(text: str) -> str:
    """Check endpoints, comma separated, or none; an `argparse` type."""
    from enact_dist.config.types import checked_endpoint

    for endpoint in text.split(","):
        if endpoint.strip():
            _checked(checked_endpoint, endpoint.strip())
    return text


def address(text: str) -> str:
    """Check where metrics are to be served, or nothing; an `argparse` type."""
    from enact_dist.config.types import metrics_address

    if text:
        _checked(metrics_address, text)
    return text


def _checked(check: Callable[[str], object], text: str) -> None:
    try:
        check(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def entities(text: str) -> str:
    """Read a pattern of entities; an `argparse` type."""
    try:
        return str(Entities(text))
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def world_name(text: str) -> str:
    """Check the name of a world context that is to be made; an `argparse` type."""
    try:
        checked_name("world context", text, slashes=False)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
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


def slot_name(text: str) -> tuple[str, str]:
    """Read ``ENTITY/ASPECT``, two names and no pattern; an `argparse` type."""
    entity, aspect = slot_parts(text)
    try:
        checked_name("entity", entity, slashes=True)
        checked_name("aspect", aspect, slashes=False)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return entity, aspect


def slot_version(text: str) -> tuple[str, str, int]:
    """Read ``ENTITY/ASPECT[@VERSION]``, version 0 if none is named; an `argparse` type."""
    name, at, number = text.partition("@")
    slot = slot_name(name)
    if at and not (number.isdecimal() and int(number)):
        raise argparse.ArgumentTypeError(f"{text!r} does not name a version as @12")
    return *slot, int(number or 0)


# ---------------------------------------------------------------- the cell


def cell_target(arguments: argparse.Namespace) -> str:
    """Return the `cell.toml` or endpoint that the command names.

    Raises:
        ConfigError: None is named and none lies here.
    """
    named = arguments.cell or os.environ.get(CELL_VARIABLE)
    if named:
        return str(named)
    if not Path(CELL_DEFAULT).is_file():
        raise ConfigError(
            f"no cell: there is no {CELL_DEFAULT} in {Path.cwd()}; name one with --cell FILE or"
            f" --cell tcp/host:7447, or set {CELL_VARIABLE}"
        )
    return CELL_DEFAULT


def is_endpoint(target: str) -> bool:
    """Say whether a cell is named by an endpoint instead of a file."""
    protocol, slash, address = target.partition("/")
    return bool(slash) and protocol in {"tcp", "tls", "quic", "udp", "ws"} and ":" in address


def cell_config(arguments: argparse.Namespace) -> CellConfig:
    """Return the configuration of the cell that the command names.

    Raises:
        ConfigError: It names an endpoint, or the file cannot be used.
    """
    from enact_dist.config.read import load_config

    target = cell_target(arguments)
    if is_endpoint(target):
        raise ConfigError(f"{target} is an endpoint; this command needs the cell.toml: --cell FILE")
    return load_config(target)


def exit_status(error: Exception) -> int:
    """Return the exit status of a command that an error has ended."""
    if isinstance(error, ConfigError):
        return USAGE
    return UNREACHABLE if isinstance(error, ShardUnreachableError) else FAILED


def told(error: Exception) -> str:
    """Return what a command says of an error that has ended it: one line."""
    return shown(" ".join((str(error) or type(error).__name__).split()))


def open_cell(arguments: argparse.Namespace, *, observer: bool = True, actor: str = "") -> Cell:
    """Join the cell that the command names.

    Args:
        arguments: Of a verb with the option `--cell`.
        observer: Only look.
        actor: How others see this process; `enact` unless given.

    Raises:
        ConfigError: The cell is named wrongly.
        ShardUnreachableError: No shard answered in time.
    """
    from enact_dist.world.connecting import connect

    timeout_s = getattr(arguments, "timeout_s", TIMEOUT_S)
    return connect(
        cell_target(arguments),
        actor=actor or "enact",
        timeout_s=timeout_s,
        request_timeout_s=timeout_s,
        observer=observer,
    )


def see_modules(cell_file: Path | None = None, *, runs_cell: bool = True) -> None:
    """Let ``MODULE:CLASS`` name a module beside the cell.toml, or of the working folder.

    The folder of a cell.toml whose program is to run comes first.  Any other folder comes last:
    no file in it hides an installed module.

    Args:
        cell_file: The cell.toml, if there is one.
        runs_cell: Whether the command runs the cell's program, and does not only look at the cell.
    """
    folders = [os.getcwd()]  # noqa: PTH109 (sys.path holds text)
    if cell_file is not None:
        beside = str(cell_file.absolute().parent)
        if runs_cell and sys.path[:1] != [beside]:
            sys.path.insert(0, beside)
        folders.insert(0, beside)
    sys.path.extend(folder for folder in dict.fromkeys(folders) if folder not in sys.path)
