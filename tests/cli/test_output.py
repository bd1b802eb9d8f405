"""Units, tables and trees: plain into a pipe, drawn on a terminal."""

import json
import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from enact_dist.cli.text import output
from enact_dist.world import trees


@pytest.mark.parametrize(
    ("value_s", "text"),
    [
        (0.0003, "0.3 ms"),
        (0.25, "250 ms"),
        (3.42, "3.4 s"),
        (125, "2 min 5 s"),
        (7500, "2 h 5 min"),
        (90_000, "1 d 1 h"),
    ],
)
def test_durations_have_the_unit_that_fits(value_s, text):
    """People read two figures, not nine."""
    assert trees.shown_s(value_s) == text


@pytest.mark.parametrize(
    ("size", "text"),
    [(0, "0 B"), (999, "999 B"), (1400, "1.4 kB"), (123e6, "123 MB"), (5e12, "5000 GB")],
)
def test_sizes_have_the_unit_that_fits(size, text):
    """Sizes are decimal, as disks and networks count."""
    assert output.shown_bytes(size) == text


def test_plain_table_is_aligned(capsys):
    """Into a pipe a table is columns of text."""
    output.print_table(("name", "n"), [("a", 1), ("longer", 22)], empty="none")

    assert capsys.readouterr().out == "name    n\na       1\nlonger  22\n"


def test_table_and_tree_are_drawn_on_a_terminal(capsys, monkeypatch):
    """On a terminal the same content is drawn; brackets in data are no markup."""
    for module in (output, trees):
        monkeypatch.setattr(module, "on_terminal", lambda _=None: True)
    root = trees.Branch("online")
    root.at(["tray", "1"]).children[" count"] = trees.Branch("count [bold]v1[/]")

    trees.print_tree(root)
    output.print_table(("name",), [("[red]a[/]",)], empty="none")

    out = capsys.readouterr().out
    assert "└── tray/" in out
    assert "count [bold]v1[/]" in out
    assert "[red]a[/]" in out


def test_narrow_terminal_breaks_no_word(capsys, monkeypatch):
    """What one copies from a table, such as a position, stays in one piece."""
    monkeypatch.setattr(output, "on_terminal", lambda _=None: True)
    monkeypatch.setenv("COLUMNS", "30")
    position = "1795295489659705547@right"
    output.print_table(
        ("version", "time", "position"), [("v1", "2026-11-21 21:11:29.659", position)], empty=""
    )
    shown = capsys.readouterr().out
    assert position in shown
    assert "21:11:29.659" in shown


def test_narrow_terminal_hides_no_leaf_of_a_tree(capsys, monkeypatch):
    """Below its indent there was no room at all for it."""
    monkeypatch.setattr(trees, "on_terminal", lambda _=None: True)
    monkeypatch.setenv("COLUMNS", "10")
    root = trees.Branch("online")
    root.at(["tray", "package", "3"]).children[" count"] = trees.Branch("weight_of_parts_g  v12")
    trees.print_tree(root)

    shown = capsys.readouterr().out
    assert "weight_of_parts_g" in shown
    assert "v12" in shown


HOSTILE = "a\nforged row\x1b[2J\u202e[bold]x[/]"


def test_table_and_tree_show_control_characters_escaped(capsys):
    """A row stays one row, the screen stays as it is, markup is text."""
    output.print_table(("actor", "host"), [(HOSTILE, "h")], empty="")
    trees.print_tree(SimpleNamespace(label=HOSTILE, children={}))
    said = capsys.readouterr().out

    assert len(said.splitlines()) == 3
    assert said.count(r"a\nforged row\x1b[2J\u202e[bold]x[/]") == 2
    output.print_json({"actor": HOSTILE})
    told = capsys.readouterr().out
    assert json.loads(told) == {"actor": HOSTILE}
    assert "\u202e" not in told


def test_json_is_valid_where_the_terminal_has_fewer_characters():
    """A program that reads it gets each character back, whatever the locale."""
    command = "from enact_dist.cli.text.output import print_json; print_json(['é 🤖'])"
    environment = {**os.environ, "PYTHONIOENCODING": "ascii:backslashreplace"}
    run = subprocess.run(
        [sys.executable, "-c", command], env=environment, capture_output=True, check=True
    )

    assert json.loads(run.stdout) == ["é 🤖"]
