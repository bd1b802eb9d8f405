"""Wrong versions that become null, with everything that was made of them.

::

    wrong = online.history(camera, CALIBRATION)[-1]
    cell.invalidate("bad-calibration", wrong)

All of them are pinned under the label, to be looked at later.  The slots that show one of them
become null: a read of one raises `NullDatumError`, `why` names who did it, and the next commit of
the slot ends it.  What was replaced before stays in the history as it is.

An actor may have viewed such a version shortly before, and commit what it made of it afterwards.
So the search is repeated until it finds nothing more.

Rules a change must keep
  * A slot becomes null only if it shows, under the lock, exactly that version and stamp: versions
    of a volatile slot start again with its shard.
  * An outcome stays.  It says what an actor with `once = True` has done, and without it the actor
    would do that again.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any, Final

from enact_dist.access.asking import explained
from enact_dist.core.protocol.datum_types import same_type, succeeds
from enact_dist.core.protocol.messages import DatumRead, SlotVersion
from enact_dist.errors import EnactError, ForgottenError, MisuseError, NoRoomError, NullDatumError
from enact_dist.outcome import Outcome
from enact_dist.wire.fingerprint import fingerprint
from enact_dist.wire.limits import ITEMS_MAX
from enact_dist.world.context import Version
from enact_dist.world.lineage import EffectTree, Made, Search
from enact_dist.world.pins import pin_versions
from enact_dist.world.version_data import set_encoded

if TYPE_CHECKING:
    from enact_dist.access.session import Session
    from enact_dist.core.client.lock import MultiLock
    from enact_dist.core.protocol.datum import Datum, Slot
    from enact_dist.link.client.locks import CellClient

ROUNDS_MAX: Final = 100
"""So often effects are looked for: an actor that viewed a version before makes one more."""
HOLD_S: Final = 60.0


def invalidate(
    session: Session, label: str, wrong: Version[Any] | Made, *, wait_s: float
) -> tuple[EffectTree, ...]:
    """Pin a version and what was made of it, and replace what is shown of it by null.

    Up to 4,096 slots become null in one commit.  If an error ends it, the versions stay pinned.

    Args:
        session: The session of the cell.
        label: See `Cell.pin`.
        wrong: The version.
        wait_s: How long to wait for the lock of the slots.

    Returns:
        The versions that were shown until now, without their effects.

    Raises:
        EnactError: Actors go on to commit what they make of these versions.
        LockTimeoutError: The slots stay locked for longer than `wait_s`.
        NoRoomError: Not all of them could be pinned; what was shown is null all the same.
        NullDatumError: `wrong` is null itself.
        ForgottenError: The version has left its retention.
        MisuseError: The label cannot be used, `wrong` is no version, or the session only observes.
        ShardUnreachableError: A shard does not answer; the call can be repeated safely.
    """
    client = session.client
    if not isinstance(wrong, Version | Made):
        raise MisuseError(f"{wrong!r} is no version; name one that `history` or `impact` returns")
    if client.core.observer:
        raise MisuseError("this session only observes; connect without observer=True")
    replaced: list[EffectTree] = []
    pinned = set[DatumRead]()
    no_room: NoRoomError | None = None
    for _ in range(ROUNDS_MAX):
        made = _made_of(client, wrong)
        try:
            _pin(session, label, [made[one] for one in made.keys() - pinned])
        except NoRoomError as error:
            no_room = error
        pinned |= made.keys()
        shown = _shown(session, made)
        if not shown and no_room is not None:
            text = f"{len(replaced)} versions were replaced by null, and not all could be pinned"
            raise NoRoomError(f"{text} under {label!r}: {no_room}")
        if not shown:
            return tuple(replaced)
        replaced += [made[one] for one in _replaced(client, shown, wait_s=wait_s)]
    raise EnactError(
        f"{len(replaced)} versions were replaced by null under {label!r}, and after {ROUNDS_MAX}"
        " rounds actors still commit what they make of some: stop them, then call this again"
    )


def _pin(session: Session, label: str, versions: list[EffectTree]) -> None:
    with contextlib.suppress(ForgottenError):  # the others are pinned
        if versions:
            pin_versions(session, label, versions)


def _made_of(client: CellClient, wrong: Version[Any] | Made) -> dict[DatumRead, EffectTree]:
    """Return a version and all that was made of it, to any depth."""
    search = Search(client)
    root = search.start(wrong.slot, wrong.version)
    named = f"{wrong.slot} v{wrong.version}"
    if root.stamp_ns != wrong.position.stamp_ns:
        raise ForgottenError(
            f"{named} is another datum now: its shard has restarted, and its versions have started"
            " again",
            oldest_ns=root.stamp_ns,
        )
    if reason := search.made(EffectTree, root).null_reason:
        raise NullDatumError(
            f"{named} is null already ({reason}); name the version that was wrong, as in"
            f" {wrong.slot.entity}/{wrong.slot.aspect}@{max(1, wrong.version - 1)}",
            reason=reason,
        )
    found, level = {root: None}, [root]
    while level:
        effects = (one for made in search.effects(level).values() for one in made)
        level = [one for one in dict.fromkeys(effects) if one not in found]
        found.update(dict.fromkeys(level))
    return {one: search.made(EffectTree, one) for one in found}


def _shown(session: Session, made: dict[DatumRead, EffectTree]) -> dict[Slot, DatumRead]:
    """Return the versions that are the newest of their slots; no null, and no outcome."""
    client = session.client
    slots = dict.fromkeys(one.slot for one in made)
    for shard in {client.shard_of(slot.entity) for slot in slots}:
        session.settle(shard)
    if any(slot.aspect not in client.aspect_entries() for slot in slots):
        client.greet()
    aspects = client.aspect_entries()
    newest = explained(client, [SlotVersion(slot, 0) for slot in slots])
    states = (entry.state for answer in newest for entry in answer.entries)
    outcome = fingerprint(Outcome)
    return {
        state.slot: DatumRead(*state[:3])
        for state in states
        if DatumRead(*state[:3]) in made and not state.null_reason
        if not _is_of_type(aspects[state.slot.aspect].fingerprint, outcome)
    }


def _is_of_type(datum_type: str, own: str) -> bool:
    """Whether a type is one of ours; a later release may have added fields to it."""
    return same_type(datum_type, own) or succeeds(datum_type, own)


def _replaced(
    client: CellClient, shown: dict[Slot, DatumRead], *, wait_s: float
) -> list[DatumRead]:
    """Write null where one of these versions is still shown; return which they were."""
    slots, done = list(shown), list[DatumRead]()
    for first in range(0, len(slots), ITEMS_MAX):
        data: dict[Slot, Datum | None] = dict.fromkeys(slots[first : first + ITEMS_MAX])

        def leave_others(lock: MultiLock, data: dict[Slot, Datum | None] = data) -> None:
            for _, _, state in lock.states:
                if DatumRead(*state[:3]) != shown[state.slot]:
                    del data[state.slot]

        set_encoded(client, data, wait_s=wait_s, hold_s=HOLD_S, granted=leave_others)
        done += [shown[slot] for slot in data]
    return done
