"""`enact top`: two looks printed, or a screen that looks again and again."""

from __future__ import annotations

import sys
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from enact_dist.cli.lock import name_away
from enact_dist.cli.target import open_cell
from enact_dist.cli.text.output import print_json, print_table
from enact_dist.cli.top.tables import TABLES, headline
from enact_dist.cli.verbs import DONE, UNREACHABLE
from enact_dist.errors import ShardUnreachableError
from enact_dist.extras import require
from enact_dist.link.signals import StopSignals
from enact_dist.operate.cell_rates import CellLooks, pause_s

if TYPE_CHECKING:
    import argparse

    from enact_dist.operate.cell_rows import CellRates
    from enact_dist.world.cell import Cell

ROWS_PRINTED_MAX: Final = 40
"""Rows of one table that `--once` prints; `--json` has all."""


def run_top(options: argparse.Namespace) -> int:
    """Show a cell; status 3 if a shard was away at the last look.

    Raises:
        ConfigError: The screen needs a package that is not installed.
        UnknownWorldError: `--world` names a world context that the cell does not have.
    """
    on_screen = not options.once and not options.json and sys.stdout.isatty()
    on_screen = on_screen and sys.stdin.isatty()
    if on_screen:
        require("the screen of enact top (not --once)", "view", "textual")
    with StopSignals() as stop, open_cell(options) as cell:
        with suppress(ShardUnreachableError):  # which the tables show
            for name in options.world or ():
                cell.world(name)
        looks = CellLooks(cell, options.entities, options.world or ())
        if on_screen:
            from enact_dist.cli.top.screen import TopApp

            screen = TopApp(cell.name, looks.take, every_s=options.every)
            stop.call(lambda _: screen.end())
            screen.run()
            last = screen.checked()
        else:
            first = looks.take()
            stop.event.wait(pause_s(options.every, first.took_s))
            last = looks.take(slots=True)
            _print(cell, last, as_json=options.json)
    return UNREACHABLE if last is not None and last.away else DONE


def _print(cell: Cell, rates: CellRates, *, as_json: bool) -> None:
    if as_json:
        print_json({"cell": cell.name, **{name: getattr(rates, name) for name in rates.__slots__}})
        return
    clock = time.strftime("%H:%M:%S", time.localtime(rates.unix_s))
    print(f"cell {cell.name} at {clock}, over {rates.seconds:.1f} s: {headline(rates)}")
    for table in TABLES:
        lines, count = table.lines(rates, ROWS_PRINTED_MAX)
        print()
        print_table([column.name for column in table.columns], lines, empty=table.empty)
        if count > len(lines):
            print(f"… {count - len(lines)} more {table.title}: enact top --once --json lists them")
    for shard in rates.away:
        name_away(shard)
