"""What a shard knows of a payload before its commit, and how many of them it may have."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import NO_ROOM, Refused
from enact_dist.wire.limits import PAYLOAD_BYTES_MIN

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from enact_dist.core.protocol.messages import Commit, Prepare
    from enact_dist.link.memory.maps import Pages, PlainMemory
    from enact_dist.link.memory.shared_folder import SharedFolder

DRAFT_BYTES_MAX: Final = 2 << 30
"""Bytes of drafts in plain memory that may wait for their commits."""
SHARES: Final = 4
"""Each client always has a quarter of the room for drafts; more only while others need none."""


@dataclass(slots=True)
class Drafted:
    """A payload that no commit has named yet.

    Attributes:
        ahead: How many files are to be made behind it once a commit has named it.
        asked: Whether its client has asked for it; otherwise it was made ahead.
    """

    session: str
    owner: str
    size: int
    memory: Pages | PlainMemory
    shared: bool
    touched_ns: int
    have: int = 0
    writing: int = 0
    beyond: list[tuple[int, int]] = field(default_factory=list)
    ahead: int = 0
    asked: bool = True

    def add(self, begin: int, end: int) -> None:
        """Note the arrival of a slice, perhaps repeated or ahead of an earlier one."""
        self.beyond.append((begin, end))
        self.beyond.sort()
        while self.beyond and self.beyond[0][0] <= self.have:
            self.have = max(self.have, self.beyond.pop(0)[1])

    @property
    def whole(self) -> bool:
        """Whether all of it is here: from slices or, without any, from its client in the folder.

        False while a slice is being written: nothing may change once a commit has it.
        """
        if self.writing:
            return False
        return self.have == self.size or (self.shared and not self.have and not self.beyond)


def plain_bytes(drafts: Mapping[str, Drafted]) -> int:
    """Return the bytes of drafts in plain memory, counting an overhead for small ones."""
    return sum(max(one.size, PAYLOAD_BYTES_MIN) for one in drafts.values() if not one.shared)


def unused(drafts: Mapping[str, Drafted], missing: int) -> list[str]:
    """Return the oldest files made ahead and not asked for, until they have so many bytes."""
    found = []
    for file, draft in drafts.items():
        if missing <= 0:
            break
        if not draft.asked:
            missing -= draft.size
            found.append(file)
    return found


def given_up(
    drafts: Mapping[str, Drafted],
    lives: Callable[[str], bool],
    works: Callable[[str], bool],
    late_ns: int,
) -> list[str]:
    """Return the drafts of sessions that have ended, and those untouched for long without a lock.

    Args:
        drafts: All drafts.
        lives: Whether a session is known.
        works: Whether a session holds a lock.
        late_ns: Drafts touched before this are untouched for long.
    """
    return [
        file
        for file, one in drafts.items()
        if not lives(one.session) or (one.touched_ns < late_ns and not works(one.session))
    ]


def beyond_share(
    drafts: Mapping[str, Drafted], most: int, owner: str, total: int, *, shared: bool
) -> tuple[list[str], int]:
    """Return the oldest drafts of clients beyond their share, and the bytes of these.

    Args:
        drafts: All drafts, the oldest first.
        most: Bytes that all clients may have.
        owner: Who wants room; none is found where this one would be beyond its share itself.
        total: How many bytes it wants.
        shared: Whether in the folder, or in plain memory.
    """
    share, staged = most // SHARES, Counter[str]()
    found, freed = [], 0
    drafts = {file: draft for file, draft in drafts.items() if draft.shared == shared}
    for draft in drafts.values():
        staged[draft.owner] += draft.size
    if staged[owner] + total > share:
        return [], 0
    for file, draft in drafts.items():
        if freed < total and staged[draft.owner] > share:
            staged[draft.owner] -= draft.size
            freed += draft.size
            found.append(file)
    return found, freed


def no_room(session: str, total: int, used: int, most: int, biggest: str) -> Refused:
    """Return the refusal of a draft.  `biggest`: the largest slots, for people."""
    return Refused(
        NO_ROOM,
        f"session {session[:8]} asked for a payload of {total} bytes; {used} of at most {most}"
        f" are in use{biggest}; raise shared_bytes_max, keep fewer versions, or release"
        " arrays and locks that still reference old ones",
    )


def names_payloads(message: Commit | Prepare) -> bool:
    """Whether a commit or prepare names data that were staged before it."""
    for _, datum in message.writes:  # noqa: SIM110 - a generator takes twice as long
        if datum is not None and datum.file:
            return True
    return False


def half_of(folder: SharedFolder | None) -> int:
    """Return half of the folder's file system in bytes; without a folder, the limit of drafts."""
    if folder is None:
        return DRAFT_BYTES_MAX
    system = os.fstatvfs(folder.descriptor)
    return system.f_blocks * system.f_frsize // 2
