"""What became of a version that an actor with `once = True` has acted on.

The outcome is a datum of the actor's own declaration, so it has a history, wakes others and says
of itself what caused it.  It is committed twice: as taken before `update` runs, and by what came
of it afterwards.

==============  ==============================================================================
state           of the version that the outcome names
==============  ==============================================================================
"taken"         `update` runs, or ran when its process ended: then it becomes "interrupted"
"done"          `update` has returned
"preempted"     it returned after it had seen that there is a newer version
"cancelled"     it returned after it had seen that the version was deleted
"stopped"       it returned after it had seen that its actor is to stop
"failed"        it raised; `text` is the error and its place
"interrupted"   its process ended, or was cut off, in between: how far it came is not known
==============  ==============================================================================
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from enact_dist.errors import MisuseError
from enact_dist.terms import Durability, LockRequest, Read, View, Write


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one version of the datum that triggers an actor with `once = True`.

    Attributes:
        state: See the module.
        version: Version of the trigger datum.
        committed_ns: When that version was committed, nanoseconds since 1970.
        text: The error of a failed one, or where an interrupted one was taken.
        actor: Name of the actor, its process and host.
        session: Its session; of a taken one this says whether its process still lives.
        run: Random name of the run within the session.
        taken_ns: When it was taken, by the actor's clock, nanoseconds since 1970.
    """

    state: str
    version: int
    committed_ns: int
    text: str = ""
    actor: str = ""
    session: str = ""
    run: str = ""
    taken_ns: int = 0


class Seen(NamedTuple):
    """A version of the trigger datum: its number and the stamp of its commit."""

    version: int
    committed_ns: int


def is_new(plan: Seen | None, last: Outcome | None) -> bool:
    """Return whether a version may be acted on, given the outcome of an earlier one.

    By the stamp of its commit: a shard that was restored may number from an older version on.
    """
    return plan is not None and (last is None or plan.committed_ns > last.committed_ns)


def outcome_of(
    name: str,
    once: object,
    requests: Mapping[str, LockRequest[Any]],
    triggers: Sequence[LockRequest[Any]],
) -> Write[Outcome] | None:
    """Return the request of an actor class in which outcomes are written; None without `once`.

    Raises:
        MisuseError: `once` does not go with what the class declares.
    """
    if once is False:
        return None
    if once is not True:
        raise MisuseError(f"{name}.once is {once!r}; it must be True or False")
    if len(triggers) != 1 or not isinstance(triggers[0], Read | View):
        raise MisuseError(
            f"{name} has once = True and triggers {list(triggers)!r}; it acts on the versions of"
            " one datum, so declare one View as its only trigger"
        )
    found = [
        request
        for request in requests.values()
        if isinstance(request, Write) and request.aspect.datum_type is Outcome
    ]
    if len(found) != 1:
        trigger = triggers[0]
        raise MisuseError(
            f"{name} has once = True and {len(found)} requests for its outcomes; declare one:"
            f' outcome = Write({trigger.world.name}, {trigger.entity!r}, Aspect("'
            f'{trigger.aspect.name}_outcome", Outcome)), with Outcome of enact_dist'
        )
    (outcome,) = found
    if type(outcome.entity) is not type(triggers[0].entity):
        raise MisuseError(
            f"{name} acts on {triggers[0]!r} and writes outcomes to {outcome!r}; each entity has"
            f" its own outcome, so name {triggers[0].entity!r} in both"
        )
    if outcome.aspect.durability is Durability.VOLATILE:
        raise MisuseError(
            f"{name}: outcomes in {outcome!r} are volatile, so after a restart of the shard a"
            " version could run twice; omit the durability"
        )
    for request in requests.values():
        if request.access.each and request.access.writes:
            raise MisuseError(
                f"{name} has once = True and declares {request!r}; its update holds no lock, so"
                " declare a Write for each entity by name"
            )
    return outcome
