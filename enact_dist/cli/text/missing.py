"""What a command line says of a datum that is not there: why, what is close, where to look."""

from __future__ import annotations

import itertools
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

from enact_dist.config.table import suggestion
from enact_dist.errors import EnactError, NullDatumError
from enact_dist.terms import NullReason

if TYPE_CHECKING:
    from collections.abc import Iterator

    from enact_dist.world.context import WorldContext
    from enact_dist.world.past import PastContext

COMPARED_MAX: Final = 1000
"""Names examined for a similar one: takes a few hundredths of a second."""


@contextmanager
def named_if_missing(world: WorldContext | PastContext, slot: tuple[str, str]) -> Iterator[None]:
    """Report a null datum in the terms of the command line.

    Args:
        world: Its world context, present or past.
        slot: Its entity and aspect.

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
    close = ""
    if reason == NullReason.NEVER_SET.value:
        close = suggestion(f"{entity}/{aspect}", _likely(world, entity, aspect))
    return NullDatumError(
        f"{world.name}:{entity}/{aspect} is null ({reason}); enact world tree"
        f" {world.name} shows what there is{close}",
        reason=reason,
    )


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
