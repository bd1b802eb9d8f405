"""The files of payloads in the shared folder of a shard.

Rules that a change must keep:

- In a folder of a group, whose users may write files that the shard makes for them, only the client
  learns the name of its draft, and names cannot be listed; the draft gets its payload's name when
  it becomes read-only.  Two gaps remain: a hostile client can change its own payload after the
  commit, and a user of the group can read payloads whose names he knows, as he can by asking the
  shard.
"""

from __future__ import annotations

import logging
import os
import secrets
from typing import TYPE_CHECKING

from enact_dist.link.memory.maps import map_file

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.link.memory.maps import Pages
    from enact_dist.link.memory.shared_folder import SharedFolder

_log = logging.getLogger("enact.shard")


class PayloadFiles:
    """The files of the payloads of one shard.

    Attributes:
        folder: Where they are.
        drafts: The names of drafts that differ from those of their payloads, by these.
    """

    def __init__(self, folder: SharedFolder) -> None:
        self.folder = folder
        self.drafts: dict[str, str] = {}

    def make(self, file: str, total: int, ended: Callable[[], None]) -> Pages:
        """Make the file of a draft and return its memory; `ended` is called once that is unused.

        Raises:
            OSError: As the system reports it; there is no file then.
        """
        folder, name = self.folder, file
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        if folder.access.group is not None:
            name = self.drafts[file] = f"draft-{secrets.token_hex(16)}"
        made = os.open(name, flags, 0o600, dir_fd=folder.descriptor)
        try:
            os.fchmod(made, folder.access.draft_mode)
            # No holes: a page that is missing later kills the process that touches it.
            os.posix_fallocate(made, 0, total)
            return map_file(made, total, writable=True, ended=ended)
        except BaseException:
            os.unlink(name, dir_fd=folder.descriptor)
            self.drafts.pop(file, None)
            raise
        finally:
            os.close(made)

    def publish(self, file: str) -> bool:
        """Make a draft read-only under its payload's name; return False if it is gone."""
        name, descriptor = self.drafts.get(file, file), self.folder.descriptor
        try:
            os.chmod(name, self.folder.access.file_mode, dir_fd=descriptor)
            if name != file:
                os.rename(name, file, src_dir_fd=descriptor, dst_dir_fd=descriptor)
                del self.drafts[file]
        except OSError as error:  # another program has cleared the folder
            _log.warning("payload %s is lost: %s", file, error.strerror)
            return False
        return True

    def unlink(self, file: str) -> None:
        """Delete the file of a payload or draft."""
        if self.folder.descriptor < 0:
            return  # closed, with all files
        try:
            os.unlink(self.drafts.pop(file, file), dir_fd=self.folder.descriptor)
        except OSError as error:  # the folder was deleted first
            _log.info("payload %s: %s", file, error)
