"""Wrong versions that become null, with everything that was made of them.

::

    wrong = online.history(camera, CALIBRATION)[-1]
    cell.invalidate("bad-calibration", wrong)

All of them are pinned under the label, to be looked at later.  The slots that show one of them
become null, in one commit: a read of one raises `NullDatumError`, `why` names who did it, and
the next commit of a slot ends it.  What was replaced before stays in the history as it is.

An actor may have viewed such a version shortly before, and commit what it made of it afterwards.
So the search is repeated until it finds nothing more.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any, Final

from enact_dist.access.lock import Lock
from enact_dist.errors import EnactError, ForgottenError, MisuseError
from enact_dist.terms import Aspect, Write
from enact_dist.world.context import Version, WorldContext
from enact_dist.world.lineage import EffectTree, Made, tree_of
from enact_dist.world.pins import pin_versions

if TYPE_CHECKING:
    from enact_dist.access.session import Session
    from enact_dist.core.protocol.datum import Slot

ROUNDS_MAX: Final = 100
"""So often effects are looked for: an actor that viewed a version before makes one more."""


def invalidate(
    session: Session, label: str, wrong: Version[Any] | Made, *, wait_s: float
) -> tuple[EffectTree, ...]:
    """Pin a version and what was made of it, and replace what is shown of it by null.

    Args:
        session: The session of the cell.
        label: See `Cell.pin`.
        wrong: The version.
        wait_s: How long to wait for the lock of the slots.

    Returns:
        The versions that were shown until now.

    Raises:
        EnactError: Actors go on to commit what they make of these versions.
        LockTimeoutError: The slots stay locked for longer than `wait_s`.
        ForgottenError: The version has left its retention.
        MisuseError: The label cannot be used, or `wrong` is no version.
        ShardUnreachableError: A shard does not answer; the call can be repeated safely.
    """
    if not isinstance(wrong, Version | Made):
        raise MisuseError(f"{wrong!r} is no version; name one that `history` or `impact` returns")
    world, entity, aspect = wrong.slot
    replaced: list[EffectTree] = []
    for _ in range(ROUNDS_MAX):
        tree = tree_of(EffectTree, session, (world, entity, aspect), wrong.version, None)
        made = made_of(tree)
        with contextlib.suppress(ForgottenError):  # the others are pinned
            pin_versions(session, label, made)
        done = _replace(session, made, wait_s=wait_s)
        if not done:
            return tuple(replaced)
        replaced += done
    raise EnactError(
        f"{len(replaced)} versions were replaced by null under {label!r}, and after {ROUNDS_MAX}"
        " rounds actors still commit what they make of some: stop them, then call this again"
    )


def made_of(tree: EffectTree) -> list[EffectTree]:
    """Return a version and what was made of it, but not what was made of a null among these."""
    whole = {(one.slot, one.version): one for one in tree.walk()}
    found: dict[tuple[Slot, int], EffectTree] = {}
    left = [tree]
    while left:
        one = left.pop()
        key = one.slot, one.version
        if key not in found and one.known and not one.null_reason:
            found[key] = whole[key]
            left += whole[key].children
    return list(found.values())


def _replace(session: Session, made: list[EffectTree], *, wait_s: float) -> list[EffectTree]:
    """Write null to all slots that show one of these versions now; return what they showed."""
    shown = {one.slot: one for one in made if _is_shown(session, one)}
    if not shown:
        return []
    requests = {
        slot: Write(WorldContext(slot.context, session), one.entity, session.untyped(slot.aspect))
        for slot, one in shown.items()
    }
    replaced = []
    with Lock(*requests.values(), wait_s=wait_s) as lock:
        for slot, request in requests.items():
            if lock.version(request) == shown[slot].version and not lock.is_null(request):
                del lock[request]
                replaced.append(shown[slot])
    return replaced


def _is_shown(session: Session, one: EffectTree) -> bool:
    """Whether a version is the newest of its slot."""
    world = WorldContext(one.world, session)
    newest = world.history(one.entity, Aspect(one.aspect, object), count=1)
    return bool(newest) and (newest[-1].version, newest[-1].position) == (one.version, one.position)
