"""The Markdown of several runs side by side: `enact bench --table a.json b.json c.json`.

Every row that has a goal, in the order of the first run; those without one and the floors that
others are divided by stand in tables of their own.  Whatever is missing in a run is an empty cell,
never a guess.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from enact_dist.bench.rows import FLOOR, TIME_FIELDS, shown_spread, shown_us
from enact_dist.errors import MisuseError

Found: TypeAlias = dict[tuple[str, str], dict[str, Any]]
"""The rows of one run by bench and variant."""


def read_run(path: Path) -> tuple[dict[str, Any], Found]:
    """Return machine and rows of one run, as `enact bench --json` has written them.

    Raises:
        MisuseError: The file is not there, or something else.
    """
    try:
        told = json.loads(path.read_text())
        rows = {(row["name"], row["variant"]): row for row in told["rows"]}
        if any(set(TIME_FIELDS) - set(row) for row in rows.values()):
            raise KeyError("rows")
        return dict(told["machine"]), rows
    except OSError as error:
        raise MisuseError(f"{path} cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError) as error:
        raise MisuseError(
            f"{path} is no output of `enact bench --json` ({type(error).__name__}: {error});"
            f" write one with `enact bench --json > {path.name}`"
        ) from None


def table(paths: Sequence[Path]) -> str:
    """Return the Markdown for some runs.

    Raises:
        MisuseError: A file is no run.
    """
    runs = [read_run(path) for path in paths]
    rows = [found for _, found in runs]
    keys = list(dict.fromkeys(key for found in rows for key in found))
    judged = [key for key in keys if any(found.get(key, {}).get("goal") for found in rows)]
    floors = [key for key in keys if key[0] == FLOOR]
    others = [key for key in keys if key not in judged and key not in floors]
    numbers = [f"run {number + 1}" for number in range(len(runs))]
    lines = [_machine(runs), ""]
    lines += _lines(("what", "goal", *numbers, "met"), (_judged(key, rows) for key in judged))
    lines += ["", *_reasons(judged, rows)]
    for head, plain in (("without a goal", others), ("floor of the same run", floors)):
        lines += [*_lines((head, *numbers), (_plain(key, rows) for key in plain)), ""]
    return "\n".join(lines).rstrip() + "\n"


def _machine(runs: Sequence[tuple[Mapping[str, Any], Found]]) -> str:
    machines = [machine for machine, _ in runs]
    said = dict.fromkeys(
        f"{one.get('processor')}, {one.get('cores')} cores, {one.get('system')}, Python"
        f" {one.get('python')}, Zenoh {one.get('zenoh')}"
        for one in machines
    )
    loads = ", ".join(str(one.get("load", "?")) for one in machines)
    days = ", ".join(dict.fromkeys(str(one["date"]) for one in machines if one.get("date")))
    return f"{'; '.join(said)}{'; ' + days if days else ''}; load before each run: {loads}."


def _judged(key: tuple[str, str], runs: Sequence[Found]) -> tuple[str, ...]:
    goal = next(found[key]["goal"] for found in runs if key in found and found[key]["goal"])
    return _named(key), goal, *(_cell(found.get(key)) for found in runs), _met(key, runs)


def _met(key: tuple[str, str], runs: Sequence[Found]) -> str:
    said = [found[key]["met"] for found in runs if key in found]
    known = [met for met in said if met is not None]
    if not known:
        return "not told"
    if all(known):
        return "yes" if len(known) == len(runs) else f"yes ({len(known)} of {len(runs)} runs)"
    return f"{sum(known)} of {len(known)}" if any(known) else "**no**"


def _named(key: tuple[str, str]) -> str:
    return key[1] if key[0] == FLOOR else f"{key[0]}: {key[1]}"


def _plain(key: tuple[str, str], runs: Sequence[Found]) -> tuple[str, ...]:
    return _named(key), *(_cell(found.get(key)) for found in runs)


def _cell(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return ""
    if row.get("value") is not None:
        return f"{row['value']:g} {row.get('unit') or ''}".strip() + f" (n {row['n']:,})"
    if row["median_us"] is None:
        return ""
    said = [f"rounds {shown_spread(row['spread_us'])}"] if row.get("spread_us") else []
    said += [f"p99 {shown_us(row['p99_us'])}", f"n {row['n']:,}"]
    if row["ratio"] is not None:
        said.append(f"{row['ratio']:.2f} x")
    if row.get("beside"):
        said.append(row["beside"])
    if row.get("mb_s") is not None:
        said.append(f"{row['mb_s']:,.0f} MB/s")
    return f"{shown_us(row['median_us'])} ({', '.join(said)})"


def _reasons(keys: Iterable[tuple[str, str]], runs: Sequence[Found]) -> list[str]:
    """Return what missed rows say about themselves, one line each."""
    lines = []
    for key in keys:
        notes = dict.fromkeys(
            found[key]["note"]
            for found in runs
            if key in found and found[key]["met"] is False and found[key].get("note")
        )
        if notes:
            lines.append(f"- {key[0]}: {key[1]}: {' | '.join(notes)}")
    return [*lines, ""] if lines else []


def _lines(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    body = ["| " + " | ".join(_safe(cell) for cell in row) + " |" for row in rows]
    return ["| " + " | ".join(head) + " |", "|" + "---|" * len(head), *body] if body else []


def _safe(cell: str) -> str:
    return cell.replace("|", "\\|").replace("\n", " ")
