"""Slots and data of a world context as a command line shows them, and why one is missing."""

from __future__ import annotations

import itertools
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

from enact_dist.cli.text.output import shown_bytes
from enact_dist.cli.verbs import Output
from enact_dist.config.table import path_of, suggestion
from enact_dist.errors import EnactError, NullDatumError
from enact_dist.terms import NullReason
from enact_dist.world.trees import Branch, print_tree, shown_s

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from enact_dist.access.snapshot import SlotInfo
    from enact_dist.world.context import WorldContext
    from enact_dist.world.past import PastContext

COMPARED_MAX: Final = 1000
"""Names examined for a similar one: takes a few hundredths of a second."""


def slots_output(title: str, infos: Sequence[SlotInfo], *, at_ns: int | None = None) -> Output:
    """Return slots as a tree of their entities, aspects as its leaves; for programs, as a list.

    Ages count to the moment `at_ns`; None: to now.
    """
    root = Branch(f"{title} ({len(infos)} data)")
    for info in infos:
        # A segment cannot contain a space, so an aspect never hides an entity of its name.
        leaf = f"{info.aspect}  {_slot_line(info, at_ns)}"
        root.at(info.entity.name.split("/")).children[f" {info.aspect}"] = Branch(leaf)
    return Output([_slot_facts(info) for info in infos], lambda: print_tree(root))


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


def datum_output(datum: object, *, out: str | None) -> Output:
    """Return a datum to print, or save it to the file `out`.

    Raises:
        ConfigError: The ending of `out` is unknown, or cannot hold the datum.
    """
    from enact_dist.cli.text import showing

    if out:
        text = showing.save(datum, out)
        return Output({"path": str(path_of(out)), "size_bytes": path_of(out).stat().st_size}, text)
    return Output(lambda: showing.plain(datum), lambda: print(*showing.lines(datum), sep="\n"))


@contextmanager
def named_if_missing(world: WorldContext | PastContext, slot: tuple[str, str]) -> Iterator[None]:
    """Report a null datum in the terms of the command line.

    Raises:
        NullDatumError: It is null.
    """
    try:
        yield
    except NullDatumError as error:
        raise missing(world, slot, error.reason) from error


def missing(
    world: WorldContext | PastContext, slot: tuple[str, str], reason: str = ""
) -> NullDatumError:
    """Return the error for a datum that is not there."""
    entity, aspect = slot
    reason = reason or NullReason.NEVER_SET.value
    remedy = f"enact world tree {world.name} shows what there is"
    told = f"is null ({reason})"
    if reason == NullReason.NEVER_SET.value:
        if world.past:
            told = "was null (not set by then)"
            remedy = f"enact world history {world.name} {entity}/{aspect} lists what came later,"
            remedy += " if anything"
        remedy += suggestion(f"{entity}/{aspect}", _likely(world, entity, aspect))
    elif reason == NullReason.DELETED.value:
        remedy = f"enact why {world.name} {entity}/{aspect} says by whom"
    return NullDatumError(f"{world.name}:{entity}/{aspect} {told}; {remedy}", reason=reason)


def _likely(world: WorldContext | PastContext, entity: str, aspect: str) -> list[str]:
    """Return the names of data of the same entity, or of the same aspect."""
    try:
        infos = world.list_slots()
    except EnactError:
        return []  # the error itself is reported anyway
    names = (
        f"{info.entity}/{info.aspect}"
        for info in infos
        if not info.null_reason and (info.entity.name == entity or info.aspect == aspect)
    )
    return list(itertools.islice(names, COMPARED_MAX))
