"""What a cell tells people of its aspects: types, durability, how much of each there is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from enact_dist.core.messages import Refused, Survey, Surveyed, Welcome
from enact_dist.core.retaining import NO_LIMIT, limits_of
from enact_dist.errors import ProtocolError
from enact_dist.link.refusals import error_of

if TYPE_CHECKING:
    from enact_dist.core.messages import Answer, AspectEntry, SlotState
    from enact_dist.session import Session


@dataclass(frozen=True, slots=True)
class AspectInfo:
    """One aspect as some shards know it, all of them in the same way.

    Attributes:
        aspect: Its name.
        type: The fingerprint of its type; "" where no type is registered, though there are slots.
            A ``=`` marks fields that have a default.
        durability: What its data survive, "" as well.
        versions: So many of each slot are retained, the newest one included; None: without limit.
        age_s: For so long after they were replaced; None likewise.
        history_bytes: So many bytes of replaced ones; None likewise.
        shards: Those that know it so.
        slots: How many there are on these shards, null ones too.
        data: How many of these are not null.
        size_bytes: Of the newest data, each counted as in `SlotInfo`.
        older_types: The fingerprints of the types that this one has succeeded, the oldest first.
    """

    aspect: str
    type: str
    durability: str
    versions: int | None
    age_s: float | None
    history_bytes: int | None
    shards: tuple[str, ...]
    slots: int = 0
    data: int = 0
    size_bytes: int = 0
    older_types: tuple[str, ...] = ()


def aspect_infos(session: Session, world: str = "") -> tuple[AspectInfo, ...]:
    """Return the aspects of all shards; one that shards know differently comes once for each way.

    Args:
        session: The session that asks.
        world: Only slots of this world context count; "": those of all.

    Raises:
        ShardUnreachableError: A shard does not answer.
    """
    client = session.client
    shards = client.shards()
    request = Survey((world,) if world else (), (), ())
    answers = client.call_all([(shard, client.core.hello(shard)) for shard in shards])
    surveys = client.call_all([(shard, request) for shard in shards])
    found: dict[AspectInfo, AspectInfo] = {}
    for shard, answer, survey in zip(shards, answers, surveys, strict=True):
        for info in _of_shard(answer, survey):
            known_as = replace(info, slots=0, data=0, size_bytes=0)
            before = found.get(known_as, known_as)
            found[known_as] = replace(
                info,
                shards=(*before.shards, shard),
                slots=before.slots + info.slots,
                data=before.data + info.data,
                size_bytes=before.size_bytes + info.size_bytes,
            )
    return tuple(sorted(found.values(), key=lambda info: (info.aspect, info.shards)))


def _of_shard(answer: Answer, survey: Answer) -> list[AspectInfo]:
    if isinstance(answer, Refused):
        raise error_of(answer)
    if not isinstance(answer, Welcome) or not isinstance(survey, Surveyed):
        came = f"{type(answer).__name__} and {type(survey).__name__}"
        raise ProtocolError(f"{came} came as the answers to Hello and Survey")
    infos = {entry.name: _info(entry) for entry in answer.aspects}
    states: dict[str, list[SlotState]] = {name: [] for name in infos}
    for state in survey.states:
        states.setdefault(state.slot.aspect, []).append(state)
    nobody = AspectInfo("", "", "", None, None, None, ())
    return [
        replace(
            infos.get(name, replace(nobody, aspect=name)),
            slots=len(some),
            data=sum(1 for state in some if not state.null_reason),
            size_bytes=sum(state.size for state in some),
        )
        for name, some in states.items()
    ]


def _info(entry: AspectEntry) -> AspectInfo:
    versions, age_ns, size = (None if one == NO_LIMIT else one for one in limits_of(entry))
    age_s = None if age_ns is None else age_ns / 1e9
    return AspectInfo(
        entry.name,
        entry.fingerprint,
        entry.durability,
        versions,
        age_s,
        size,
        (),
        older_types=entry.older,
    )
