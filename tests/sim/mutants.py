"""All wrong edits of the core, and what the design and the review list call some of them.

A wrong edit is a function that replaces one decision of the core through `patch(owner, name,
value)`; its docstring says what is wrong then.  The shard's own assertions are off while it runs:
what catches it is the judge, or the directed test that is named beside it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import mutants_directed
import mutants_growth as growth
import mutants_history as history
import mutants_keeping as keeping
import mutants_one_shard as one
import mutants_over_shards as over
import mutants_payloads as payloads
import mutants_readers as readers
import mutants_standing as standing
import mutants_worlds as worlds
from mutants_directed import DIRECTED

if TYPE_CHECKING:
    from collections.abc import Iterator

Mutant = Callable[[Callable[[Any, str, Any], None]], None]


def _of(module: Any) -> tuple[Mutant, ...]:
    """Return the public functions of a module, in their order."""
    return tuple(
        found
        for name, found in vars(module).items()
        if getattr(found, "__module__", "") == module.__name__ and not name.startswith("_")
    )


SIMULATED = (
    *_of(one),
    *_of(over),
    *_of(readers),
    *_of(payloads),
    *_of(worlds),
    *_of(history),
    *_of(growth),
    *_of(keeping),
    *_of(standing),
)
"""Those that the simulator catches."""
ALL = (*SIMULATED, *DIRECTED)

NAMED = {
    # The design's list of mutants, of its models and of its simulation.
    "NODEDUP": one.no_record_of_outcomes,
    "ACKBEFORESYNC": one.tells_before_it_is_kept,
    "NOFENCE": one.no_fence,
    "NOGRACE": one.no_grace,
    "KABLIND": one.believes_without_the_list,
    "NORECONCILE": one.no_reconciliation,
    "LEASEFROMRECV": one.believes_from_newest_sending,
    "EXPIREPREP": over.prepared_locks_expire,
    "RESOLVENOREVOKE": over.aborts_what_is_open,
    "MAXHOLDNAIVE": one.counts_the_hold_from_its_own_grant,
    "NOVALIDATE": one.skips_validation,
    "VOLPREP": over.loses_prepared_at_a_restart,
    "CLIENTABORT": mutants_directed.releases_end_what_is_prepared,
    "NOEPOCH": one.restarts_in_the_same_epoch,
    "BLINDACK": one.blind_acknowledgement,
    "REGRANT": one.grants_a_seq_again,
    "OLDGRANT": mutants_directed.takes_grants_of_an_old_epoch,
    "ACKKEEP": one.keeps_old_grants,
    # The review's eight planted bugs.
    "drop the fence comparison": mutants_directed.compares_no_token,
    "expire with < for <=": mutants_directed.leases_end_late,
    "grant past a waiting writer": one.barges,
    "release not waking the queue": one.forgets_to_wake,
    "commit before all is staged": over.commits_without_votes,
    "acquire in request order": one.asks_shards_in_the_order_of_the_request,
    "renew after expiry accepted": one.renews_what_is_over,
    "history shares a reference": mutants_directed.shows_the_present_for_the_past,
}


def takes(new: Any, old: Any) -> bool:
    """Whether a function may stand for another: the same number by position, no name less."""
    if not (inspect.isroutine(new) and inspect.isfunction(old)):
        return True
    news, olds = (list(inspect.signature(one).parameters.values()) for one in (new, old))
    kinds, free = {one.kind for one in news}, {one.name for one in news}
    by_position = [
        sum(one.kind in {one.POSITIONAL_ONLY, one.POSITIONAL_OR_KEYWORD} for one in ones)
        for ones in (news, olds)
    ]
    by_name = {one.name for one in olds if one.kind is one.KEYWORD_ONLY}
    return (by_position[0] == by_position[1] or inspect.Parameter.VAR_POSITIONAL in kinds) and (
        by_name <= free or inspect.Parameter.VAR_KEYWORD in kinds
    )


@contextmanager
def planted(mutant: Mutant) -> Iterator[None]:
    """Run with a wrong edit, and without it afterwards."""
    undo: list[tuple[Any, str, Any]] = []

    def patch(owner: Any, name: str, value: Any) -> None:
        family = getattr(owner, "__mro__", (owner,))
        owner = next((base for base in family if name in vars(base)), owner)
        old = vars(owner)[name]
        if not takes(value, old):
            raise TypeError(f"{mutant.__name__} takes other arguments than {owner.__name__}.{name}")
        undo.append((owner, name, old))
        setattr(owner, name, value)

    try:
        mutant(patch)
        yield
    finally:
        for owner, name, value in reversed(undo):
            setattr(owner, name, value)
