"""Slots and data of a world context as a command line shows them, of the present or the past."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from enact_dist.cli.text.output import print_json, print_tree, shown_bytes, shown_s

if TYPE_CHECKING:
    from collections.abc import Sequence

    from enact_dist.access.snapshot import SlotInfo


@dataclass(slots=True)
class Branch:
    """One segment of an entity's path: its line, and what lies below."""

    label: str
    children: dict[str, Branch] = field(default_factory=dict)

    def at(self, segments: list[str]) -> Branch:
        """Return the branch at a path below this one, growing it where needed."""
        branch = self
        for segment in segments:
            branch = branch.children.setdefault(segment, Branch(f"{segment}/"))
        return branch


def print_slots(
    title: str, infos: Sequence[SlotInfo], *, as_json: bool, at_ns: int | None = None
) -> None:
    """Print slots as a tree of their entities, aspects as its leaves.

    Args:
        title: Name of the world context.
        infos: The slots.
        as_json: Whether to print a list for programs instead.
        at_ns: The moment that their ages count to; None: now.
    """
    if as_json:
        print_json([_slot_facts(info) for info in infos])
        return
    root = Branch(f"{title} ({len(infos)} data)")
    for info in infos:
        # A segment cannot contain a space, so an aspect never hides an entity of its name.
        leaf = f"{info.aspect}  {_slot_line(info, at_ns)}"
        root.at(info.entity.name.split("/")).children[f" {info.aspect}"] = Branch(leaf)
    print_tree(root)


def _slot_facts(info: SlotInfo) -> dict[str, object]:
    return {
        "entity": info.entity.name,
        "aspect": info.aspect,
        "version": info.version,
        "stamp_ns": info.position.stamp_ns,
        "size_bytes": info.size_bytes,
        "null_reason": info.null_reason,
        "shard": info.shard,
    }


def _slot_line(info: SlotInfo, at_ns: int | None) -> str:
    if info.null_reason:
        return f"v{info.version}  NULL ({info.null_reason})"
    age_s = ((time.time_ns() if at_ns is None else at_ns) - info.position.stamp_ns) / 1e9
    size = f"  {shown_bytes(info.size_bytes)}" if info.size_bytes else ""
    return f"v{info.version}{size}  {shown_s(max(0.0, age_s))} {'ago' if at_ns is None else 'old'}"


def print_datum(datum: object, *, out: str | None, as_json: bool) -> None:
    """Print or save a datum.

    Raises:
        ConfigError: The ending of `out` is unknown, or cannot hold the datum.
    """
    from enact_dist.cli.text import showing

    if out:
        print(showing.save(datum, out))
    elif as_json:
        print_json(showing.plain(datum))
    else:
        for line in showing.lines(datum):
            print(line)
