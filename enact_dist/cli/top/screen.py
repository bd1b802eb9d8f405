"""The screen of `enact top`: one panel for each table, drawn by textual.

A thread looks at the cell and hands each look to the screen as a message; a shard that does not
answer delays that thread alone, so keys work at once.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import ClassVar, Final

from rich.text import Text
from textual.app import App, ComposeResult
from textual.binding import Binding
from textual.message import Message
from textual.widgets import DataTable, Footer, Input, Static

from enact_dist.cli.top.tables import TABLES, TopTable, headline
from enact_dist.operate.cell_rates import pause_s
from enact_dist.operate.cell_rows import CellRates
from enact_dist.wire.texts import shown

ROWS_SHOWN_MAX: Final = 500
"""Rows of one panel; the title counts the others, which a filter brings up."""
EVENTS_SHOWN: Final = 3


class TopApp(App[None]):
    """Shows a cell until `q`."""

    TITLE = "enact top"
    ENABLE_COMMAND_PALETTE = False
    CSS = """
    DataTable { height: 1fr; border: round $primary; }
    DataTable:focus { border: round $accent; }
    #panel-s { height: auto; max-height: 30%; }
    #panel-s.alone { height: 1fr; max-height: 100%; }
    #filter { display: none; dock: bottom; }
    #events { height: auto; color: $text-muted; }
    #away { height: auto; color: $text-error; }
    """
    BINDINGS: ClassVar = [
        *(Binding(table.key, f"panel('{table.key}')", table.title.split()[0]) for table in TABLES),
        Binding("slash", "filter", "filter", key_display="/"),
        Binding("o", "next_column", "sort by"),
        Binding("r", "turn", "turn"),
        Binding("p", "pause", "pause"),
        Binding("escape", "all", "all", show=False),
        Binding("q,ctrl+c", "quit", "quit"),
    ]

    class Looked(Message):
        """A look was taken."""

        def __init__(self, rates: CellRates) -> None:
            super().__init__()
            self.rates = rates

    class Ended(Message):
        """The screen is to end."""

    class Failed(Message):
        """No look can be taken any more."""

        def __init__(self, error: Exception) -> None:
            super().__init__()
            self.error = error

    def __init__(self, cell: str, look: Callable[[], CellRates], *, every_s: float) -> None:
        super().__init__()
        self._cell, self._look, self._every_s = cell, look, every_s
        self._stopped, self._runs = threading.Event(), threading.Event()
        self._runs.set()
        self._rates: CellRates | None = None
        self._failed: Exception | None = None
        self._alone = ""
        self._only = ""
        self._column = {table.key: table.first for table in TABLES}
        self._turned = dict.fromkeys(self._column, False)

    def checked(self) -> CellRates | None:
        """Return the last look; raise the error that ended the screen, if one did."""
        if self._failed is not None:
            raise self._failed
        return self._rates

    def end(self) -> None:
        """End the screen; may be called from any thread, also before it runs."""
        self._stopped.set()

    def compose(self) -> ComposeResult:
        """Lay out the headline, the panels and the keys."""
        yield Static(id="headline")
        yield Static(id="away")
        for table in TABLES:
            panel: DataTable[Text] = DataTable(
                id=f"panel-{table.key}", cursor_type="row", zebra_stripes=True
            )
            yield panel
        yield Static(id="events")
        yield Input(placeholder="show only rows with this text", id="filter")
        yield Footer()

    def on_mount(self) -> None:
        """Begin to look."""
        self._arrange()
        self._draw()
        self.run_worker(self._await_end, thread=True)
        self.run_worker(self._look_on, thread=True)

    def on_unmount(self) -> None:
        """Let the thread that looks end."""
        self._stopped.set()
        self._runs.set()

    def _await_end(self) -> None:
        self._stopped.wait()
        self.post_message(self.Ended())

    def on_top_app_ended(self) -> None:
        """End, whatever the thread that looks waits for."""
        self.exit()

    def _look_on(self) -> None:
        while not self._stopped.is_set():
            try:
                rates = self._look()
            except Exception as error:  # noqa: BLE001 - the screen ends with it, and it is raised there
                self.post_message(self.Failed(error))
                return
            self.post_message(self.Looked(rates))
            self._stopped.wait(pause_s(self._every_s, rates.took_s))
            self._runs.wait()

    def on_top_app_looked(self, message: Looked) -> None:
        """Show a look."""
        self._rates = message.rates
        self._draw()

    def on_top_app_failed(self, message: Failed) -> None:
        """End; the caller raises the error."""
        self._failed = message.error
        self.exit()

    # ---------------------------------------------------------------- keys

    def action_panel(self, key: str) -> None:
        """Show one panel alone, or all again."""
        self._alone = "" if self._alone == key else key
        self._arrange()
        self._draw()

    def _arrange(self) -> None:
        """Show the panels that are to be seen: one alone, or all but the counters."""
        for table in TABLES:
            panel, alone = self._panel(table), table.key == self._alone
            panel.display = alone if self._alone else table.key != "c"
            panel.set_class(alone, "alone")
        self._panel_in_use().focus()

    def _panel_in_use(self) -> DataTable[Text]:
        return self.query_one(f"#panel-{self._alone or 'a'}", DataTable)

    def action_all(self) -> None:
        """Show all panels and all rows."""
        self._only = ""
        self.query_one(Input).value = ""
        self._alone = ""
        self._hide_filter()
        self._arrange()
        self._draw()

    def action_filter(self) -> None:
        """Ask for a text that rows must have."""
        field = self.query_one(Input)
        field.display = True
        field.focus()

    def on_input_changed(self, event: Input.Changed) -> None:
        """Filter while the text is written."""
        self._only = event.value
        self._draw()

    def on_input_submitted(self) -> None:
        """Keep the filter, and give the keys back to the panels."""
        self._hide_filter()

    def _hide_filter(self) -> None:
        self.query_one(Input).display = False
        self._panel_in_use().focus()

    def action_next_column(self) -> None:
        """Sort the panel in use by its next column."""
        table = self._in_use()
        self._column[table.key] = (self._column[table.key] + 1) % len(table.columns)
        self._turned[table.key] = False
        self._draw()

    def action_turn(self) -> None:
        """Sort the panel in use in the other direction."""
        table = self._in_use()
        self._turned[table.key] = not self._turned[table.key]
        self._draw()

    def action_pause(self) -> None:
        """Take no further look, or go on."""
        if self._runs.is_set():
            self._runs.clear()
        else:
            self._runs.set()
        self._draw()

    def _in_use(self) -> TopTable:
        focused = self.focused.id if self.focused is not None else None
        for table in TABLES:
            if self._alone == table.key or (not self._alone and focused == f"panel-{table.key}"):
                return table
        return TABLES[0]

    # ---------------------------------------------------------------- drawing

    def _panel(self, table: TopTable) -> DataTable[Text]:
        panel: DataTable[Text] = self.query_one(f"#panel-{table.key}", DataTable)
        return panel

    def _draw(self) -> None:
        rates = self._rates
        if rates is None:
            self.query_one("#headline", Static).update(Text(f"cell {self._cell}: looking …"))
            return
        self.query_one("#headline", Static).update(Text(self._headline(rates)))
        self.query_one("#away", Static).update(Text("\n".join(_away(rates))))
        self.query_one("#events", Static).update(Text("\n".join(_events(rates))))
        for table in TABLES:
            if self._panel(table).display:
                self._draw_rows(table, rates)

    def _draw_rows(self, table: TopTable, rates: CellRates) -> None:
        panel, key = self._panel(table), table.key
        column, turned = self._column[key], self._turned[key]
        lines, count = table.lines(
            rates, ROWS_SHOWN_MAX, column=column, turned=turned, only=self._only
        )
        row, at = panel.cursor_row, panel.scroll_offset
        panel.clear(columns=True)  # their widths, too
        falls = table.columns[column].falls != turned
        for index, one in enumerate(table.columns):
            arrow = f" {'▼' if falls else '▲'}" if index == column else ""
            panel.add_column(one.name + arrow)
        for line in lines:
            panel.add_row(*(Text(shown(text)) for text in line))
        panel.move_cursor(row=row, scroll=False)
        panel.scroll_to(*at, animate=False)
        more = f", the first {len(lines)} shown" if count > len(lines) else ""
        panel.border_title = f"{table.title}: {count}{more}{table.as_of(rates)}"
        panel.border_subtitle = "" if lines else table.empty

    def _headline(self, rates: CellRates) -> str:
        clock = time.strftime("%H:%M:%S", time.localtime(rates.unix_s))
        over = f"over {rates.seconds:.1f} s" if rates.seconds else "first look"
        parts = [f"cell {self._cell} at {clock}, {over}: {headline(rates)}"]
        if not self._runs.is_set():
            parts.append("PAUSED (p goes on)")
        if self._only:
            parts.append(f"only rows with {self._only!r} (escape shows all)")
        return " · ".join(parts)


def _away(rates: CellRates) -> Iterator[str]:
    for shard in rates.away:
        why = f": {shard.problem}" if shard.problem else ""
        where = f"shard {shard.name} at {shard.endpoint}"
        yield f"{where} has not answered for {shard.away_s:.0f} s{why}"


def _events(rates: CellRates) -> Iterator[str]:
    for unix_s, text in rates.events[-EVENTS_SHOWN:]:
        yield f"{time.strftime('%H:%M:%S', time.localtime(unix_s))} {text}"
