"""The versions of a datum that are still known, and pinned versions.

::

    for version in online.history(piece, LOWEST, count=5):
        print(version.version, version.position, version.datum())

    cell.keep("drop-17", online.history(piece, LOWEST))     # stay, whatever their retention
    cell.let_go("drop-17")

A listing carries no data: `Version.datum` fetches one when it is asked.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from enact_dist.access.arguments import Moment
from enact_dist.access.asking import versions_in
from enact_dist.access.reads import null_error
from enact_dist.access.snapshot import take_snapshot
from enact_dist.core.protocol.datum import Position, Slot
from enact_dist.core.protocol.messages import (
    KeepVersions,
    Kept,
    ListHistory,
    Refused,
    SlotVersion,
)
from enact_dist.errors import ForgottenError, MisuseError, ProtocolError
from enact_dist.link.refusals import error_of, moment_name
from enact_dist.terms import Aspect, Entity, NullReason, View, checked_name
from enact_dist.wire.payload import decode_untyped
from enact_dist.world.lineage import Made
from enact_dist.world.past import PastContext

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from enact_dist.access.session import Session
    from enact_dist.core.protocol.messages import Cause, VersionEntry
    from enact_dist.world.context import WorldContext

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Version(Generic[T]):
    """One version of a datum, without it.

    Attributes:
        world: Its world context.
        entity: Its entity.
        aspect: Its aspect; of the type `object` if the program has not named the aspect's type.
        version: Its number, counted from 1 by slot.
        position: Position of its commit.
        until_ns: Stamp of the version that replaced it, 0: it is the newest one.
        stamp_ns: When the datum was captured, 0: unknown.
        size_bytes: Length of the datum's body: arrays, texts and bytes over 256 B, long lists; 0
            for all else.
        null_reason: Why it is null, or the empty string.
        kept: The labels under which it is kept.
        cause: Its writer and inputs; None if unknown.
    """

    world: WorldContext
    entity: Entity
    aspect: Aspect[T]
    version: int
    position: Position
    until_ns: int
    stamp_ns: int
    size_bytes: int
    null_reason: str
    kept: tuple[str, ...]
    cause: Cause | None

    @property
    def slot(self) -> Slot:
        """What it is a version of."""
        return Slot(self.world.name, self.entity.name, self.aspect.name)

    def datum(self) -> T:
        """Fetch the datum; without its Python type where the aspect has none: as `raw` does.

        Raises:
            ForgottenError: It has left its retention since it was listed, or its context is gone.
            NullDatumError: The version is null.
            DatumTypeError: It is of another type than the aspect.
            ShardUnreachableError: Its shard does not answer.
        """
        past = PastContext(self.world.name, self.world.session, Moment(self.position.stamp_ns))
        request = View(past, self.entity, self.aspect)
        untyped = self.aspect.datum_type is object
        snapshot = take_snapshot((request,), register=not untyped)
        state = snapshot.state(request)
        shown = (state.version, state.stamp_ns) if state is not None else (0, 0)
        if shown != (self.version, self.position.stamp_ns):
            raise ForgottenError(
                f"version {self.version} of {self.slot}, committed at"
                f" {moment_name(self.position.stamp_ns)}, is not known any more; list the history"
                " again"
            )
        if self.null_reason:
            raise null_error(self.slot, state)
        datum: Any = decode_untyped(snapshot.encoded(request)) if untyped else snapshot[request]
        return datum  # type: ignore[no-any-return]  # of the aspect's type, or the aspect has none

    def __repr__(self) -> str:
        null = f", null: {self.null_reason}" if self.null_reason else ""
        return f"Version({self.slot} v{self.version} at {self.position.stamp_ns}{null})"


def versions_of(
    world: WorldContext, entity: Entity, aspect: Aspect[T], *, since_ns: int, count: int
) -> tuple[Version[T], ...]:
    """Return the known versions of one slot, oldest first; see `WorldContext.history`."""
    session = world.session
    session.client.check_usable()
    shard = session.client.shard_of(entity.name)
    session.settle(shard)
    entries = listed(session, shard, Slot(world.name, entity.name, aspect.name), since_ns, count)
    if not entries:
        session.check_world(world.name)
    return tuple(_version(shard, world, aspect, entry) for entry in entries)


def kept_versions(
    session: Session, world_of: Callable[[str], WorldContext]
) -> dict[str, tuple[Version[Any], ...]]:
    """Return what is kept, by label; see `Cell.kept`."""
    request = ListHistory((), (), (), kept=True)
    shards = session.client.shards()
    answers = session.client.call_all([(shard, request) for shard in shards])
    found: dict[str, list[Version[Any]]] = {}
    for shard, answer in zip(shards, answers, strict=True):
        for entry in versions_in(answer).entries:
            if not entry.kept:
                continue
            slot = entry.state.slot
            version = _version(shard, world_of(slot.context), Aspect(slot.aspect, object), entry)
            for label in version.kept:
                found.setdefault(label, []).append(version)
    return {
        label: tuple(sorted(found[label], key=lambda each: (each.slot, each.version)))
        for label in sorted(found)
    }


def keep_versions(session: Session, label: str, versions: Iterable[Version[Any] | Made]) -> None:
    """Keep versions under a label; see `Cell.keep`."""
    _check_label(label)
    by_shard: dict[str, list[SlotVersion]] = {}
    for version in versions:
        if not isinstance(version, Version | Made):
            raise MisuseError(
                f"{version!r} is no version; keep what world.history(entity, aspect) returns"
            )
        shard = session.shard_of(version.slot)
        by_shard.setdefault(shard, []).append(SlotVersion(version.slot, version.version))
    if not by_shard:
        raise MisuseError(f"nothing to keep under {label!r}: name at least one version")
    forgotten = [
        f"{slot} v{version}"
        for answer in _all_kept(session, label, by_shard)
        for slot, version in answer.forgotten
    ]
    if forgotten:
        shown = ", ".join(forgotten[:4]) + (", …" if len(forgotten) > 4 else "")
        raise ForgottenError(
            f"{len(forgotten)} of the versions to keep under {label!r} had left their retention"
            f" before: {shown}; the others are kept: list the history again, or cell.let_go"
        )


def let_go(session: Session, label: str) -> None:
    """Release the versions of a label; see `Cell.let_go`."""
    _check_label(label)
    _all_kept(session, label, {shard: [] for shard in session.client.shards()})


def _all_kept(session: Session, label: str, by_shard: dict[str, list[SlotVersion]]) -> list[Kept]:
    client = session.client

    def request_of(shard: str, epoch: int, count: int) -> KeepVersions:
        return KeepVersions(client.core.session, label, tuple(by_shard[shard]), epoch, count)

    answers = []
    for shard, answer in client.ask_each(sorted(by_shard), request_of).items():
        if answer is None:
            raise client.unreachable(shard, client.patience_s)
        if isinstance(answer, Refused):
            raise error_of(answer)
        if not isinstance(answer, Kept):
            raise ProtocolError(f"{type(answer).__name__} came as the answer to KeepVersions")
        answers.append(answer)
    return answers


def _check_label(label: str) -> None:
    try:
        checked_name("label", label, slashes=True)
    except ValueError as error:
        raise MisuseError(str(error)) from None


def listed(
    session: Session, shard: str, slot: Slot, since_ns: int = 0, count: int = 0
) -> list[VersionEntry]:
    """Return what a shard knows of one slot's versions.

    Args:
        session: The asking session.
        shard: The shard that stores the slot.
        slot: The slot.
        since_ns: Only versions that were current after this stamp.
        count: At most this many, the newest ones (0: all).

    Raises:
        ShardUnreachableError: The shard does not answer.
    """
    request = ListHistory((slot.context,), (slot.entity,), (slot.aspect,), since_ns, count)
    return list(versions_in(session.client.call(shard, request)).entries)


def _version(shard: str, world: WorldContext, aspect: Aspect[T], entry: VersionEntry) -> Version[T]:
    state = entry.state
    return Version(
        world,
        Entity(state.slot.entity),
        aspect,
        state.version,
        Position(state.stamp_ns, shard),
        entry.until_ns,
        state.captured_ns,
        state.size,
        NullReason[state.null_reason].value if state.null_reason else "",
        entry.kept,
        entry.cause,
    )
