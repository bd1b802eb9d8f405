"""The public name of a lock, which errors carry so that its outcome can be asked for later."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from enact_dist.core.datum import LockId
from enact_dist.errors import MisuseError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

_NAME: Final = re.compile(r"(?P<session>[^.@]+)\.(?P<lane>\d+)\.(?P<seq>\d+)@(?P<shard>.+)\Z")


def name_of(lock: LockId, writes: Mapping[str, Sequence[object]]) -> str:
    """Return the name of a lock that commits `writes`, by shard: the lowest shard decides."""
    primary = min((shard for shard, items in writes.items() if items), default="")
    return f"{lock.session}.{lock.lane}.{lock.seq}@{primary}" if primary else str(lock)


def read_name(name: str) -> tuple[LockId, str]:
    """Return the lock of a name, and the shard that decides on it.

    Raises:
        MisuseError: The name is invalid.
    """
    found = _NAME.match(name)
    if found is None:
        raise MisuseError(f"{name!r} names no lock; use the lock_id of a CommitUnknownError")
    return LockId(found["session"], int(found["lane"]), int(found["seq"])), found["shard"]
