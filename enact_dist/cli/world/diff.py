"""`enact world diff`: how two world contexts differ, slot by slot.

The types and comparators of aspects are Python, which a command line does not know: `cell.toml`
names them (``[aspects.X] compare = "module:NAME"``), or ``--tolerance`` says how far numbers of an
aspect may be apart.  All else is compared exactly, dataclasses field by field.
"""

from __future__ import annotations

import importlib
import time
from collections import Counter
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from enact_dist.cli.target import cell_target, is_endpoint, open_cell, see_modules
from enact_dist.cli.text.output import print_table, shown_bytes
from enact_dist.cli.verbs import DIFFERENT, DONE, Output
from enact_dist.errors import ConfigError
from enact_dist.terms import Aspect
from enact_dist.world.trees import shown_s

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterable, Mapping

    from enact_dist.access.arguments import When
    from enact_dist.access.snapshot import SlotInfo
    from enact_dist.compare.diff import Comparison, Diff
    from enact_dist.config.types import CellConfig
    from enact_dist.world.cell import Cell
    from enact_dist.world.context import WorldContext
    from enact_dist.world.past import PastContext

ROWS_SHOWN_MAX: Final = 12
"""So many slots that only one side has are listed; more are counted by aspect."""


def show_diff(options: argparse.Namespace) -> Output:
    """Say how two world contexts differ."""
    configured = configured_aspects(options)
    with open_cell(options) as cell:
        left = _context(cell, options.left, options.at1)
        right = _context(cell, options.right, options.at2)
        aspects = _aspects(options, cell, configured)
        found = left.diff(right, options.entities, *aspects)
    show = partial(print_diff, found, every=options.all)
    return Output(found.to_json, show, status=DIFFERENT if found else DONE)


def _context(cell: Cell, name: str, at: When | None) -> WorldContext | PastContext:
    world = cell.world(name)
    return world if at is None else world.at(at)


# ---------------------------------------------------------------- how aspects are compared


def configured_aspects(options: argparse.Namespace) -> dict[str, Aspect[Any]]:
    """Return the aspects whose comparators the `cell.toml` names; none of an endpoint's cell.

    Raises:
        ConfigError: The file cannot be used, or names what is not there.
    """
    from enact_dist.config.read import load_config

    target = cell_target(options)
    if is_endpoint(target):
        return {}
    config = load_config(target)
    see_modules(config.path, runs_cell=False)
    allowed = dict(options.tolerance)
    wanted = [
        entry
        for entry in config.aspects
        if entry.compare
        and entry.name not in allowed
        and (not options.aspect or entry.name in options.aspect)
    ]
    for entry in wanted:
        if not options.trust and not _is_of_actors(entry.compare, config):
            raise ConfigError(
                f"{config.path}: [aspects.{entry.name}] compare = {entry.compare!r} would run a"
                " module outside the packages of the cell's actors; if you trust the author of the"
                f" file, pass --trust, else --tolerance {entry.name}=0",
                path=str(config.path),
            )
    return {entry.name: load_aspect(entry.name, entry.compare) for entry in wanted}


def _is_of_actors(target: str, config: CellConfig) -> bool:
    """Whether ``module:NAME`` lies in the module of an actor of the cell, or in its package."""
    module = target.partition(":")[0]
    for actor in config.actors:
        known = actor.class_path.partition(":")[0]
        package, dot, _ = known.rpartition(".")
        if module == known or (dot and f"{module}.".startswith(f"{package}.")):
            return True
    return False


def load_aspect(name: str, target: str) -> Aspect[Any]:
    """Return the aspect `name` with the comparator that `target` names.

    Args:
        name: Of the aspect.
        target: ``module:NAME`` of that `Aspect`, or of a comparator, which then gets dataclasses as
            dicts, since their type is not known.

    Raises:
        ConfigError: It does not exist, or is neither.
    """
    module, _, attribute = target.partition(":")
    asked = f"[aspects.{name}] compare = {target!r}"
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"{asked}: {error}; run from the folder that holds it, or say --tolerance {name}=0"
        ) from error
    if isinstance(found, Aspect):
        if found.name != name:
            raise ConfigError(f"{asked} is the aspect {found.name!r}")
        return found
    if not callable(found):
        raise ConfigError(f"{asked} is {found!r:.60}, neither an Aspect nor a comparator")
    return Aspect(name, object, compare=found)


def _aspects(
    options: argparse.Namespace, cell: Cell, configured: Mapping[str, Aspect[Any]]
) -> list[Aspect[Any] | str]:
    """Return what to compare: each aspect with the comparator that holds for it."""
    from enact_dist.world.cell import session_behind

    tolerances = dict(options.tolerance)
    registered = session_behind(cell).typed_aspects()
    names = options.aspect or registered
    unknown = [name for name in tolerances if name and name not in names]
    if unknown:
        compared = ", ".join(names) or "none"
        raise ConfigError(f"--tolerance names the aspect {unknown[0]!r}; compared are {compared}")
    aspects: list[Aspect[Any] | str] = []
    for name in names:
        allowed = tolerances.get(name)
        if allowed is None and name not in configured:
            allowed = tolerances.get("")
        if allowed is not None:
            aspects.append(Aspect(name, object, compare=allowed))
        else:
            aspects.append(configured.get(name, name))
    return aspects


# ---------------------------------------------------------------- the table


def print_diff(found: Diff, *, every: bool) -> None:
    """Print how two world contexts differ, slot by slot; without `every`, few of one side alone."""
    changed = [row for row in found if row.left is not None and row.right is not None]
    left = [row for row in found if row.right is None]
    right = [row for row in found if row.left is None]
    few = every or len(left) + len(right) <= ROWS_SHOWN_MAX
    listed = found.rows if few else changed
    if listed:
        now_ns = time.time_ns()
        rows = [_line(row, found, now_ns) for row in listed]
        print_table(("entity", "aspect", "difference", found.left, found.right), rows, empty="")
    if not few:
        for side, alone in ((found.left, left), (found.right, right)):
            if alone:
                print(f"only in {side}: {_by_aspect(alone)}  (--all lists them)")
    print(_summary(found, len(changed), len(left), len(right)))


def _line(row: Comparison, found: Diff, now_ns: int) -> tuple[str, ...]:
    if row.left is not None and row.right is not None:
        what = str(row.difference)
    else:
        what = f"only in {found.right if row.left is None else found.left}"
    sides = (_side(row.left, now_ns), _side(row.right, now_ns))
    return (row.entity.name, row.aspect, what, *sides)


def _side(side: SlotInfo | None, now_ns: int) -> str:
    if side is None:
        return "-"
    ago = shown_s(max(0.0, (now_ns - side.position.stamp_ns) / 1e9))
    size = f", {shown_bytes(side.size_bytes)}" if side.size_bytes else ""
    return f"v{side.version}{size}, {ago} ago"


def _by_aspect(rows: Iterable[Comparison]) -> str:
    counts = Counter(row.aspect for row in rows)
    return ", ".join(f"{aspect} {count}" for aspect, count in sorted(counts.items()))


def _summary(found: Diff, changed: int, left: int, right: int) -> str:
    same = f" ({found.same} of them the same version)" if found.same else ""
    parts = [
        f"{changed} changed" if changed else "",
        f"{left} only in {found.left}" if left else "",
        f"{right} only in {found.right}" if right else "",
        f"{found.within} within tolerance" if found.within else "",
        f"{found.equal} equal{same}",
    ]
    return ", ".join(part for part in parts if part)
