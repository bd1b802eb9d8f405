"""Pinned versions: they stay readable under a label, whatever their retention.

::

    cell.pin("drop-17", online.history(piece, LOWEST))
    cell.unpin("drop-17")
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from enact_dist.access.arguments import checked_as
from enact_dist.access.asking import ask_all, expected
from enact_dist.access.session import Session
from enact_dist.core.protocol.messages import KeepVersions, Kept, ListHistory, SlotVersion, Versions
from enact_dist.errors import ForgottenError, MisuseError
from enact_dist.terms import Aspect
from enact_dist.world.context import Version, WorldContext
from enact_dist.world.lineage import Made


def pinned_versions(session: Session) -> dict[str, tuple[Version[Any], ...]]:
    """Return the pinned versions by label; see `Cell.pinned`."""
    found: dict[str, list[Version[Any]]] = {}
    request = ListHistory((), (), (), kept=True)
    for shard, answer in ask_all(session.client, Versions, request):
        for entry in answer.entries:
            context, _, aspect = entry.state.slot
            world = WorldContext(context, session)
            version = Version.of(shard, world, Aspect(aspect, object), entry)
            for label in version.pinned:
                found.setdefault(label, []).append(version)
    return {
        label: tuple(sorted(found[label], key=lambda each: (each.slot, each.version)))
        for label in sorted(found)
    }


def pin_versions(session: Session, label: str, versions: Iterable[Version[Any] | Made]) -> None:
    """Pin versions under a label; see `Cell.pin`."""
    checked_as("label", label, slashes=True)
    by_shard: dict[str, list[SlotVersion]] = {}
    for version in versions:
        if not isinstance(version, Version | Made):
            raise MisuseError(
                f"{version!r} is no version; pin what world.history(entity, aspect) returns"
            )
        shard = session.shard_of(version.slot)
        by_shard.setdefault(shard, []).append(SlotVersion(version.slot, version.version))
    if not by_shard:
        raise MisuseError(f"nothing to pin under {label!r}: name at least one version")
    answers = _set_pins(session, label, by_shard)
    forgotten = [f"{slot} v{number}" for one in answers for slot, number in one.forgotten]
    if forgotten:
        named = ", ".join(forgotten[:4]) + (", …" if len(forgotten) > 4 else "")
        raise ForgottenError(
            f"{len(forgotten)} of the versions to pin under {label!r} had already left their"
            f" retention: {named}; the others are pinned: list the history again, or cell.unpin"
        )


def unpin_versions(session: Session, label: str) -> None:
    """Release the versions of a label; see `Cell.unpin`."""
    checked_as("label", label, slashes=True)
    _set_pins(session, label, {shard: [] for shard in session.client.shards()})


def _set_pins(session: Session, label: str, by_shard: dict[str, list[SlotVersion]]) -> list[Kept]:
    client = session.client

    def request_of(shard: str, epoch: int, count: int) -> KeepVersions:
        return KeepVersions(client.core.session, label, tuple(by_shard[shard]), epoch, count)

    answers = []
    for shard, answer in client.ask_each(sorted(by_shard), request_of).items():
        if answer is None:
            raise client.unreachable(shard, client.request_timeout_s)
        answers.append(expected(Kept, KeepVersions, answer))
    return answers
