"""What a shard knows of a payload before its commit, and how many of them it may have."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from enact_dist.core.protocol.messages import Commit, Prepare
    from enact_dist.link.memory.maps import Pages, PlainMemory
    from enact_dist.link.memory.shared_folder import SharedFolder

DRAFT_BYTES_MAX: Final = 2 << 30
"""Bytes of drafts in plain memory that may wait for their commits."""


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
