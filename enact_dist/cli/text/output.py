"""Tables and JSON on standard output: for people on a terminal, plain text into a pipe."""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from collections.abc import Iterable, Sequence
from typing import Final

from enact_dist.wire.texts import shown, shown_json
from enact_dist.world.trees import on_terminal

COLOURS = ("36", "33", "35", "32", "34", "31", "96", "93", "95", "92")
"""ANSI colours of log prefixes, in turn."""


TABLE_PADDING = 3
"""Columns of a terminal between two cells."""

TOLD_EVERY_S: Final = 0.2
"""How often a line of progress is written over."""


def print_json(value: object) -> None:
    """Print a value as JSON; dataclasses as objects, what JSON does not have as text."""
    print(_json(value, indent=2))


def print_json_line(value: object) -> None:
    """Print a value as one line of JSON, at once."""
    print(_json(value), flush=True)


def _json(value: object, *, indent: int | None = None) -> str:
    every = (getattr(sys.stdout, "encoding", None) or "").lower().startswith("utf")
    text = json.dumps(value, default=_plain, ensure_ascii=not every, indent=indent)
    return shown_json(text)


def _plain(value: object) -> object:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    return str(value)


def print_table(columns: Sequence[str], rows: Iterable[Sequence[object]], *, empty: str) -> None:
    """Print rows under their column names, or the sentence `empty` without any.

    Each row stays one: control characters of its cells are shown escaped.
    """
    texts = [[shown(str(cell)) for cell in row] for row in rows]
    if not texts:
        print(empty)
    elif on_terminal():
        _rich_table(columns, texts)
    else:
        _plain_table(columns, texts)


def _rich_table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=SIMPLE_HEAD, header_style="bold", pad_edge=False)
    needed = 0
    for index, column in enumerate(columns):
        cells = [line[index] for line in (columns, *rows)]
        longest = max((len(word) for cell in cells for word in cell.split()), default=1)
        of_words = any(" " in cell for cell in cells)
        table.add_column(column, overflow="fold", min_width=longest, no_wrap=not of_words)
        needed += longest + TABLE_PADDING
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    console = Console()
    # Where words do not fit, the terminal breaks lines: a position broken here cannot be copied.
    Console(width=max(console.width, needed)).print(table)


def _plain_table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    lines = [list(columns), *rows]
    widths = [max(len(line[index]) for line in lines) for index in range(len(columns))]
    for line in lines:
        padded = (cell.ljust(width) for cell, width in zip(line, widths, strict=True))
        print("  ".join(padded).rstrip())


def shown_bytes(size_bytes: float) -> str:
    """Return a size as people read it, in decimal units: ``312 B``, ``1.4 MB``."""
    for unit in ("B", "kB", "MB", "GB"):
        if size_bytes < 1000.0 or unit == "GB":
            digits = 0 if unit == "B" or size_bytes >= 100.0 else 1
            return f"{size_bytes:.{digits}f} {unit}"
        size_bytes /= 1000.0
    raise AssertionError


def coloured(text: str, index: int) -> str:
    """Return `text` in the colour of that index, where the terminal shows colours."""
    return f"\033[{COLOURS[index % len(COLOURS)]}m{text}\033[0m" if on_terminal() else text


class ProgressLine:
    """A line of progress on a terminal, written over again and again; nothing elsewhere."""

    def __init__(self) -> None:
        self._shows = sys.stderr.isatty()
        self._told_s = 0.0

    def show(self, text: str, *, at_once: bool = False) -> None:
        """Show how far it is, now and then or at once."""
        now_s = time.monotonic()
        if self._shows and (at_once or now_s - self._told_s >= TOLD_EVERY_S):
            self._told_s = now_s
            print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)

    def end(self) -> None:
        """Take the line away."""
        if self._shows:
            print("\r\033[K", end="", file=sys.stderr, flush=True)
