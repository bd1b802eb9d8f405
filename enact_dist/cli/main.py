"""`enact`: reads the command line, runs the verb, turns every error into one line and a status.

====  ==================================================================================
exit  meaning
====  ==================================================================================
0     done
1     refused or failed
2     wrong usage, or a configuration that cannot be used
3     a shard is unreachable
4     what was compared differs; apart from 1, so that a script can tell it from a failure
130   interrupted with Ctrl-C
====  ==================================================================================
"""

from __future__ import annotations

import argparse
import io
import os
import re
import sys
from collections.abc import Callable, Sequence
from typing import Any, Final

from enact_dist.cli.verbs import (
    DONE,
    NOUNS,
    USAGE,
    add_noun,
    exit_status,
    renamed,
    run_verb,
    told,
)
from enact_dist.errors import EnactError

INTERRUPTED: Final = 130

_EPILOG: Final = """\
examples:
  enact up cell.toml                  run every shard and actor of a cell on this machine
  enact world tree online             what a world context knows
  enact why online system/deviation   where a datum comes from, back to what was measured
  enact lock ls                       who holds what, and who waits for whom
  enact demo palletizing              watch actors report damaged packages

The cell is ./cell.toml unless --cell or $ENACT_CELL names another file or an endpoint.
Exit status: 0 done, 1 refused or failed, 2 usage or configuration, 3 unreachable, 4 different
(only of what compares)."""


class _Parser(argparse.ArgumentParser):
    """Takes options and arguments in any order, and says its own usage where they are wrong."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        # No option of ours begins with a digit: what does (-30s, -.5) is a value, right or wrong.
        self._negative_number_matcher = re.compile(r"-\.?\d")
        self._intermixes = False

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse what is no choice, and name the one that may have been meant."""
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            from enact_dist.config.table import suggestion

            error.message += suggestion(str(value), map(str, action.choices or ()))
            raise

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse words as `argparse` does, but refuse the unknown here and not at the top.

        `argparse` ends arguments that may be left out at the first option, so one that follows
        (`tree online --json tray`) is left over: then all options are taken out first.
        """
        found, left = super().parse_known_args(args, namespace)
        if self._intermixes:
            return found, left
        if left and self._subparsers is None:
            self._intermixes = True
            try:
                found, left = self.parse_known_intermixed_args(args)
            finally:
                self._intermixes = False
        if left:
            # Behind an option that is not known, what it was to take is left over, too.
            left = [word for word in left if word != "--"]
            unknown = [word for word in left if word.startswith("-")] or left
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return found, left


def build_parser(noun: str = "") -> argparse.ArgumentParser:
    """Return the parser of all nouns and verbs, or of one noun: that loads a third as much."""
    parser, nouns = _top_parser()
    for name in [noun] if noun else NOUNS:
        add_noun(nouns, name)
    return parser


def _overview() -> argparse.ArgumentParser:
    """Return the parser of a command line without a noun: it loads none of them."""
    parser, nouns = _top_parser()
    for name in NOUNS:
        nouns.add_parser(name, help=NOUNS[name].summary)
    return parser


def _top_parser() -> tuple[_Parser, argparse._SubParsersAction[_Parser]]:
    parser = _Parser(
        prog="enact",
        description="Distributed world contexts for robots.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--debug", action="store_true", help="show tracebacks of errors")
    parser.add_argument("--version", action="store_true", help="print the version and leave")
    return parser, parser.add_subparsers(metavar="COMMAND", title="commands", dest="noun")


def main(argv: Sequence[str] | None = None) -> int:
    """Carry out one command line and return its exit status.

    Args:
        argv: Arguments without the program's name; those of this process unless given.

    Raises:
        SystemExit: The command line cannot be read (status 2), or `--help` was asked (0).
    """
    _prepare_streams()
    try:
        return _main(list(sys.argv[1:] if argv is None else argv))
    except KeyboardInterrupt as error:  # while modules of ours are loaded, too
        for line in getattr(error, "__notes__", ()):  # what it has left behind
            print(f"enact: {line}", file=sys.stderr)
        return INTERRUPTED


def _prepare_streams() -> None:
    """Open what the caller has closed, and let no character be an error of standard output.

    Otherwise the next file or socket would become standard output, and errors go there.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            stream = open(os.devnull, mode, encoding="utf-8")  # noqa: PTH123, SIM115 - it stays open
            setattr(sys, name, stream)
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")


def _main(words: list[str]) -> int:
    noun = next((word for word in words if not word.startswith("-")), "")
    words, command = _split_command(words) if noun == "lock" and "hold" in words else (words, None)
    words, remarks = renamed(noun, words)
    for remark in remarks:
        print(f"enact: {remark}", file=sys.stderr)
    parser = build_parser(noun) if noun in NOUNS else _overview()
    arguments = parser.parse_args(words)
    arguments.command = command
    if arguments.version:
        return _run(arguments, _version)
    if arguments.noun is None:
        parser.print_help()
        return USAGE
    return _run(arguments, _verb)


def _split_command(words: list[str]) -> tuple[list[str], list[str] | None]:
    """Take off what follows a lone ``--``: a command to run, never options of ours."""
    if "--" not in words:
        return words, None
    at = words.index("--")
    return words[:at], words[at + 1 :]


def _version(_: argparse.Namespace) -> int:
    from importlib.metadata import PackageNotFoundError, version

    try:
        print(f"enact-dist {version('enact-dist')}")
    except PackageNotFoundError:
        print("enact-dist (not installed as a package)")
    return DONE


def _verb(arguments: argparse.Namespace) -> int:
    from enact_dist.operate.supervise import end_with_supervisor

    end_with_supervisor()
    return run_verb(arguments)


def _run(arguments: argparse.Namespace, act: Callable[[argparse.Namespace], int]) -> int:
    try:
        status = act(arguments)
        sys.stdout.flush()
    except EnactError as error:
        return _report(error, arguments)
    except BrokenPipeError:
        # The reader of our output has seen enough; what is left must not fail again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except (OSError, ImportError, MemoryError) as error:
        return _report(error, arguments)
    return status


def _report(error: Exception, arguments: argparse.Namespace) -> int:
    if arguments.debug:
        raise error
    text = told(error)
    for line in getattr(error, "__notes__", ()):
        print(line, file=sys.stderr)
    as_json = getattr(arguments, "log", "text") == "json"
    print(_refusal(arguments, text) if as_json else f"enact: {text}", file=sys.stderr)
    return exit_status(error)


def _refusal(arguments: argparse.Namespace, text: str) -> str:
    """Return the line of a log of objects by which a process says why it does not run."""
    import logging

    from enact_dist.link.log import JsonLines

    targets = [*getattr(arguments, "targets", ()), getattr(arguments, "process", "")]
    name = getattr(arguments, "name", "") or " ".join(filter(None, targets))
    lines = JsonLines(process=f"{arguments.noun} {name}".rstrip())
    return lines.line(f"{arguments.noun}.refused", text, level=logging.CRITICAL)


if __name__ == "__main__":
    sys.exit(main())
