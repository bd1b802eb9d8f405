"""The files of payloads in the shared folder of a shard.

Rules that a change must keep:

- Only the shard's own user may open them, even where a group shares the folder.
"""

from __future__ import annotations

import logging
import os
from typing import TYPE_CHECKING, Final

from enact_dist.link.memory.maps import map_file

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.link.memory.maps import Pages
    from enact_dist.link.memory.shared_folder import SharedFolder

DRAFT_MODE: Final = 0o600
FILE_MODE: Final = 0o400

_log = logging.getLogger("enact.shard")


class PayloadFiles:
    """The files of the payloads of one shard.

    Args:
        folder: Where they are.

    Attributes:
        path: Its path in this process, for people.
    """

    def __init__(self, folder: SharedFolder) -> None:
        self._folder, self.path = folder, folder.path

    def make(self, file: str, total: int, ended: Callable[[], None]) -> Pages:
        """Make the file of a draft and return its memory; `ended` is called once that is unused.

        Raises:
            OSError: As the system reports it; there is no file then.
        """
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        made = os.open(file, flags, DRAFT_MODE, dir_fd=self._folder.files)
        try:
            os.fchmod(made, DRAFT_MODE)
            # No holes: a page that is missing later kills the process that touches it.
            os.posix_fallocate(made, 0, total)
            return map_file(made, total, writable=True, ended=ended)
        except BaseException:
            os.unlink(file, dir_fd=self._folder.files)
            raise
        finally:
            os.close(made)

    def is_nearly_full(self) -> bool:
        """Whether less than a quarter of the file system is left, which others may share."""
        system = os.fstatvfs(self._folder.descriptor)
        return system.f_bavail < system.f_blocks // 4

    def publish(self, file: str) -> bool:
        """Make a draft read-only; return False if it is gone."""
        try:
            os.chmod(file, FILE_MODE, dir_fd=self._folder.files)
        except OSError as error:  # another program has cleared the folder
            _log.warning("payload %s is lost: %s", file, error.strerror)
            return False
        return True

    def unlink(self, file: str) -> None:
        """Delete the file of a payload or draft."""
        if self._folder.files < 0:
            return  # closed, with all files
        try:
            os.unlink(file, dir_fd=self._folder.files)
        except OSError as error:  # the folder was deleted first
            _log.info("payload %s: %s", file, error)
