"""Verbs as tables, and the one engine that reads their options, runs them and prints the output.

A noun of `enact` is a module with a tuple `VERBS`: one `Verb` for each, which says everything that
its help does.  It names the function that carries it out, so that this one is loaded at use.  Such
a function takes a cell and the options, or the options alone, and returns an `Output` or, where it
prints for itself, an exit status.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, Final, NamedTuple

from enact_dist.errors import ConfigError, ShardUnreachableError
from enact_dist.wire.texts import shown

DONE: Final = 0
FAILED: Final = 1
USAGE: Final = 2
UNREACHABLE: Final = 3
DIFFERENT: Final = 4

LOOKS: Final = "looks"
CHANGES: Final = "changes"
"""How a verb joins the cell; without either it does so by itself, or not at all."""


class Noun(NamedTuple):
    """One command of `enact`.

    Attributes:
        module: Where its table stands, below `enact_dist.cli`; loaded when the command is used.
        page: The page of the documents that explains its subject.
    """

    module: str
    summary: str
    page: str


NOUNS: Final = {
    "up": Noun("up", "run every shard and actor of a cell on this machine until Ctrl-C", "cell"),
    "shard": Noun("shard", "run, list, back up and rebalance shards", "operations"),
    "actor": Noun("actor", "run, list, check and change actors", "own_actors"),
    "world": Noun("world", "read, write, fork and compare world contexts", "guide"),
    "why": Noun(
        "world.lineage",
        "show where a datum of a cell or a recording comes from: who wrote it, and from which data",
        "time",
    ),
    "impact": Noun(
        "world.lineage",
        "show what was made from a datum of a cell or a recording, and from that in turn",
        "time",
    ),
    "invalidate": Noun("world.lineage", "make a wrong datum null, and what was made of it", "time"),
    "record": Noun(
        "record",
        "record every version of a cell's data into an MCAP file until Ctrl-C",
        "recordings",
    ),
    "replay": Noun(
        "record",
        "commit a recording into a cell again, at its pace; or run one step of an actor again",
        "recordings",
    ),
    "view": Noun("view", "show a cell, or a recording, in the browser until Ctrl-C", "view"),
    "lock": Noun("lock", "list locks, hold one, break one, resolve one", "guide"),
    "top": Noun(
        "top",
        "show a cell at work: shards, actors, locks and data with their rates, until q",
        "operations",
    ),
    "doctor": Noun(
        "doctor",
        "check this machine (libraries, memory, disk), the connection to the cell (shards, clocks),"
        " and whether the running cell matches its cell.toml",
        "operations",
    ),
    "bench": Noun(
        "bench",
        "measure locks, commits and data on this machine, beside the raw floor of the same run",
        "benchmarks",
    ),
    "verify": Noun(
        "verify",
        "try to break the locks and commits of this version with simulated faults, and check the"
        " outcome",
        "proof",
    ),
    "cell": Noun("cell", "make and renew the keys of a cell", "security"),
    "demo": Noun("demo", "run a demonstration", "palletizing"),
    "workcell": Noun("workcell", "calibrate the cameras of a cell", "workcell"),
}
"""All commands, in the order in which `enact --help` shows them."""


FORMER: Final = {
    "world": {"keep": "pin", "kept": "pinned", "let-go": "unpin"},
    "why": {"--keep": "--pin"},
    "lock": {"--settle": "--acknowledge"},
}
"""Names of the release before, by noun.  They work for one release more, but no help shows them."""


def renamed(noun: str, words: list[str]) -> tuple[list[str], list[str]]:
    """Return a command line with the names of this release, and a remark on each former one."""
    names, remarks = FORMER.get(noun, {}), []
    plain = [at for at, word in enumerate(words) if not word.startswith("-")][:2]
    new = list(words)
    for at, word in enumerate(words):
        name, equals, value = word.partition("=")
        if name in names and (name.startswith("--") or at == plain[-1]):
            new[at] = names[name] + equals + value
            old, now = (f"enact {noun} {one}" for one in (name, names[name]))
            remarks.append(f"{old} is now called {now}; the next release has the new name alone")
    return new, remarks


# ---------------------------------------------------------------- tables


@dataclass(frozen=True, slots=True)
class Option:
    """One option or argument, as `argparse` takes it."""

    names: tuple[str, ...]
    settings: Mapping[str, Any]


class OneOf(NamedTuple):
    """Options of which at most one may be given."""

    options: tuple[Option, ...]


class OptionGroup(NamedTuple):
    """Options that the help shows under a title of their own."""

    title: str
    options: tuple[Option | OneOf, ...]
    description: str | None = None


Part = Option | OneOf | OptionGroup


def option(name: str, metavar: str | None, text: str, **settings: Any) -> Option:
    """Return an option (``--name``) or an argument (``name``) that takes a value."""
    given = {"help": text, "metavar": metavar, **settings}
    return Option((name,), {key: value for key, value in given.items() if value is not None})


def many(name: str, metavar: str, text: str, **settings: Any) -> Option:
    """Return an option that may be repeated; its value is the list."""
    return option(name, metavar, text, action="append", **settings)


def flag(name: str, text: str) -> Option:
    """Return an option without a value."""
    return Option((name,), {"action": "store_true", "help": text})


@dataclass(frozen=True, slots=True)
class Verb:
    """One verb of a noun, or a noun that is one.

    Attributes:
        name: Of the verb; of two words (`keys make`) if several verbs share the first one.
        run: Its function: ``module:name`` beside the noun's table, or ``name`` in that module.
        examples: Command lines, one a line.
        options: Its options and arguments, in the order of the help.
        cell: `LOOKS` or `CHANGES` where the function takes a cell.
        columns: Of the table that its rows make.
        empty: Printed in place of a table without rows.
        page: The page of the documents, unless it is that of the noun.
        details: Further lines of the help, below the summary.
        settings: Further settings of the parser.
        defaults: Values of options in place of those that the options have.
    """

    name: str
    summary: str
    run: str
    examples: str
    options: tuple[Part, ...] = ()
    cell: str = ""
    columns: tuple[str, ...] = ()
    empty: str = ""
    page: str = ""
    details: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    defaults: Mapping[str, Any] = field(default_factory=dict)


def table_of(noun: str) -> tuple[Verb, ...]:
    """Return the verbs of a noun; a noun that is a verb itself has one of its own name."""
    verbs: tuple[Verb, ...] = import_module(f"enact_dist.cli.{NOUNS[noun].module}").VERBS
    alone = tuple(verb for verb in verbs if verb.name == noun)
    return alone or verbs


def function_of(noun: str, verb: Verb) -> Callable[..., Output | int]:
    """Load the function that carries out a verb."""
    module, _, name = verb.run.rpartition(":")
    place = ".".join(filter(None, ("enact_dist.cli", NOUNS[noun].module, module)))
    function: Callable[..., Output | int] = getattr(import_module(place), name)
    return function


# ---------------------------------------------------------------- parsers


def add_noun(nouns: argparse._SubParsersAction[Any], name: str) -> None:
    """Add a noun with its verbs to the parser of all nouns."""
    noun, table = NOUNS[name], table_of(name)
    if table[0].name == name:
        _add_verb(nouns, name, table[0])
        return
    parser = nouns.add_parser(
        name, help=noun.summary, description=noun.summary, epilog=f"See docs/{noun.page}.md."
    )
    verbs = parser.add_subparsers(metavar="VERB", required=True)
    groups: dict[str, argparse._SubParsersAction[Any]] = {}
    for verb in table:
        group, _, last = verb.name.rpartition(" ")
        if group and group not in groups:
            words = ", ".join(one.name.split()[-1] for one in table if one.name.startswith(group))
            inner = verbs.add_parser(group, help=words, description=noun.summary)
            groups[group] = inner.add_subparsers(metavar="VERB", required=True)
        _add_verb(groups.get(group, verbs), name, verb, last)


def _add_verb(
    verbs: argparse._SubParsersAction[Any], noun: str, verb: Verb, name: str = ""
) -> None:
    examples = verb.examples.splitlines()
    parser = verbs.add_parser(
        name or verb.name,
        help=verb.summary,
        description=f"{verb.summary[0].upper()}{verb.summary[1:]}.{verb.details}",
        epilog="\n  ".join([f"example{'s' if examples[1:] else ''}:", *examples])
        + f"\n\nSee docs/{verb.page or NOUNS[noun].page}.md.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        **verb.settings,
    )
    parser.add_argument(
        "--debug", action="store_true", default=argparse.SUPPRESS, help="show tracebacks of errors"
    )
    _add_parts(parser, verb.options)
    parser.set_defaults(verb=verb, **verb.defaults)


def _add_parts(parser: Any, parts: Sequence[Part]) -> None:
    for part in parts:
        if isinstance(part, OptionGroup):
            _add_parts(parser.add_argument_group(part.title, part.description), part.options)
        elif isinstance(part, OneOf):
            _add_parts(parser.add_mutually_exclusive_group(), part.options)
        else:
            parser.add_argument(*part.names, **part.settings)


# ---------------------------------------------------------------- output


@dataclass(frozen=True, slots=True)
class Output:
    """What a verb found or did.

    Attributes:
        facts: For programs: `--json` prints them.  What takes long to make may be a function.
        text: For people: lines, or a function that prints them.
        rows: For people: the rows of the verb's table, which stands above the text.
    """

    facts: object
    text: str | Callable[[], None] = ""
    rows: Sequence[Sequence[object]] | None = None
    status: int = DONE


def run_verb(options: argparse.Namespace) -> int:
    """Carry out the verb that the options name; print its output; return the exit status."""
    verb: Verb = options.verb
    function = function_of(options.noun, verb)
    if verb.cell:
        from enact_dist.cli.target import open_cell

        with open_cell(options, observer=verb.cell == LOOKS) as cell:
            answer = function(cell, options)
    else:
        answer = function(options)
    if isinstance(answer, int):
        return answer
    _print(answer, verb, as_json=getattr(options, "json", False))
    return answer.status


def _print(answer: Output, verb: Verb, *, as_json: bool) -> None:
    from enact_dist.cli.text.output import print_json, print_table

    if as_json:
        print_json(answer.facts() if callable(answer.facts) else answer.facts)
        return
    if answer.rows is not None:
        print_table(verb.columns, answer.rows, empty=verb.empty)
    if callable(answer.text):
        answer.text()
    elif answer.text:
        print(answer.text)


def exit_status(error: Exception) -> int:
    """Return the exit status of a command that an error has ended."""
    if isinstance(error, ConfigError):
        return USAGE
    return UNREACHABLE if isinstance(error, ShardUnreachableError) else FAILED


def told(error: Exception) -> str:
    """Return what a command says of an error that has ended it: one line."""
    text = str(error) or type(error).__name__
    if isinstance(error, FileNotFoundError) and _folder_is_gone():
        text = "the working folder was removed; enter one that is there (made anew: cd .)"
    return shown(" ".join(text.split()))


def _folder_is_gone() -> bool:
    try:
        os.getcwd()  # noqa: PTH109 - asked of the system
    except FileNotFoundError:
        return True
    return False
