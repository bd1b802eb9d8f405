"""The shared folders of simulated hosts, and what clients do with their files.

The names are simulated, and the files are the kernel's own: it maps them, it keeps what is mapped
when a name goes, and parent and child of a fork share what is open.  What the handler of a shard
and its clients decide over them is real: `PayloadHandler`, `NamesAhead`, `SharedPayloads` and
`Draft`.

A folder belongs to one life of its shard.  When the shard is killed its files stay until the next
start removes them; a power cut takes them at once.  Some clients are on another host and see none.
"""

from __future__ import annotations

import copy
import errno
import logging
import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import Stage
from enact_dist.errors import LinkError, NoRoomError
from enact_dist.link.memory.ahead import FILES_MAX
from enact_dist.link.memory.maps import anonymous_file, map_file
from enact_dist.link.memory.payload_client import Draft, SharedPayloads
from enact_dist.link.memory.payload_files import PayloadFiles
from enact_dist.link.memory.shared_folder import NONCE_BYTES, OpenedFolder
from enact_dist.wire.limits import PAYLOAD_BYTES_MIN

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.core.client.plan import Reading
    from enact_dist.core.protocol.datum import Datum
    from enact_dist.core.protocol.messages import Answer, Request
    from enact_dist.link.memory.maps import Pages
    from enact_dist.verify.simulation.hosts.world import Host, SimulatedWorld

SHARE: Final = 0.25
"""Share of the runs whose shards have a folder."""
ROOMS: Final = (20, 60, 120, 200)
"""How many files a folder has room for: sometimes fewer than the history wants."""
SEEN: Final = 0.85
"""Share of the clients that are on the host of their shards."""
NO_NONCE: Final = bytes(NONCE_BYTES)

logging.getLogger("enact.shard").addHandler(logging.NullHandler())  # a full folder is no news here


class Folders:
    """The folders of one run: what the seed has drawn, and what clients have filled.

    Args:
        share: Share of the seeds whose shards have a folder.

    Attributes:
        takes_place: Whether the shards of this run have folders.
        firm: Whether a payload beyond the room is refused; otherwise it goes to plain memory.
        full: Share of the files for which others leave no room in the file system.
        needed: How often another client needs the room of files that were made ahead.
        written: Of each file the bytes that its client writes.
        pending: The files that a living client fills, or may still commit.
    """

    def __init__(self, world: SimulatedWorld, *, share: float = 0.0) -> None:
        self.world = world
        # By this name the seeds that tests name had their runs before folders were simulated.
        luck = world.schedule.stream("host's places in this run")
        self.takes_place = luck.random() < share
        self.bytes_max = luck.choice(ROOMS) * (PAYLOAD_BYTES_MIN + 1)
        self.firm = luck.random() < 0.6
        self.full = luck.choice((0.0, 0.0, 0.05, 0.2))
        self.needed = luck.choice((0.0, 0.2, 0.6))
        self.written: dict[str, bytes] = {}
        self.pending: set[str] = set()
        self._made: dict[str, Folder] = {}

    def made_for(self, shard: str, between: Callable[[str], None]) -> Folder:
        """Make the folder of a starting shard, and remove those of its earlier lives."""
        name = f"{shard}.{self.remove(shard)}"
        folder = self._made[name] = Folder(self, name, between)
        return folder

    def remove(self, shard: str) -> int:
        """Remove all folders of a shard; return how many there were."""
        found = [folder for folder in self._made.values() if folder.name.startswith(f"{shard}.")]
        for folder in found:
            folder.remove()
        return len(found)

    def seen(self, name: str) -> OpenedFolder:
        """Return what a client on this host opens."""
        return SeenFolder(self._made[name])


class Folder(PayloadFiles):
    """The folder of one life of a shard.

    Attributes:
        name: Its name, for the WELCOME.
        ahead: Whether its shard makes files ahead right now.
    """

    def __init__(self, folders: Folders, name: str, between: Callable[[str], None]) -> None:
        self.name, self.path, self.ahead = name, Path(name), False
        self._folders, self._world, self._between = folders, folders.world, between
        self._luck = self._world.schedule.place(f"{name}-full")
        self._files: dict[str, tuple[int, int]] = {}
        """Of each file its descriptor and its length in bytes."""
        self._filled: set[str] = set()
        self._published: set[str] = set()
        self._served = True

    def __del__(self) -> None:
        self.remove()

    def names(self) -> set[str]:
        """Return the names of all files."""
        return set(self._files)

    def sizes(self) -> list[int]:
        """Return the length of each file in bytes."""
        return [size for _, size in self._files.values()]

    # ---------------------------------------------------------------- the shard's side

    def make(self, file: str, total: int, ended: Callable[[], None]) -> Pages:
        """Make a file, as `PayloadFiles` does; a client may find it before its shard goes on."""
        if file in self._files:
            raise OSError(errno.EEXIST, os.strerror(errno.EEXIST))
        if self._is_full("no file is made in"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        descriptor = anonymous_file(total)
        self._files[file] = descriptor, total
        self._check_room(file)
        session = file.rpartition("-")[0]
        self._between(session)
        return map_file(descriptor, total, writable=True, ended=ended)

    def _check_room(self, file: str) -> None:
        """Look at the limits: what is made ahead takes no room that a client could ask for."""
        used, most = sum(self.sizes()), self._folders.bytes_max
        mine = [name for name in self._files if name.startswith(file.rpartition("-")[0])]
        many = self.ahead and len(set(mine) - self._published) > FILES_MAX + 1
        if used > (most // 2 if self.ahead else most) or many:
            self._world.violation("files keep to their room", file, used, most, len(mine))

    def _is_full(self, text: str) -> bool:
        bits, fault = self._luck.next(), self._luck.fault
        full = (bits & 0xFFFF) < self._folders.full * 0x10000 and self._world.schedule.allows(fault)
        if full:
            self._world.tally["folders full"] += 1
            self._world.befell(fault, f"{text} {self.name}: others have filled the file system")
        return full

    def is_nearly_full(self) -> bool:
        """Whether others have filled most of the file system."""
        return self._is_full("nothing is made ahead in")

    def publish(self, file: str) -> bool:
        """Make a file read-only; False if it is gone."""
        self._published.add(file)
        self._folders.pending.discard(file)
        return file in self._files

    def unlink(self, file: str) -> None:
        """Remove a name; a shard that has died removes none."""
        if self._served and file in self._files:
            self._world.tally["files taken back from a client"] += file in self._folders.pending
            os.close(self._files.pop(file)[0])

    def abandon(self) -> None:
        """Its shard has died: the files stay."""
        self._served = False

    def remove(self) -> None:
        """Remove all files."""
        while self._files:
            os.close(self._files.popitem()[1][0])

    # ---------------------------------------------------------------- a client's side

    def opened(self, file: str, size: int, access: int) -> int:
        """Return a descriptor; a file is opened for writing once, by one client."""
        if file not in self._files:
            raise OSError(errno.ENOENT, os.strerror(errno.ENOENT))
        if access == os.O_RDWR:
            if file in self._published:
                raise OSError(errno.EACCES, os.strerror(errno.EACCES))
            if file in self._filled:
                self._world.violation("a file is in the hands of one client", file)
            self._filled.add(file)
        descriptor, found = self._files[file]
        if found != size:
            self._world.violation("a file has the length of its row", file, found, size)
        return os.dup(descriptor)


class SeenFolder(OpenedFolder):
    """A folder as a client has it open."""

    _of: Folder

    def __init__(self, folder: Folder) -> None:
        super().__init__(-1, 0, folder.path, 0)
        object.__setattr__(self, "_of", folder)

    def opened(self, file: str, size: int, access: int) -> int:
        """Open a payload."""
        return self._of.opened(file, size, access)

    def close(self) -> None:
        """End nothing: no descriptor is open."""


class ClientFiles:
    """The payloads of all shards as one client process sees them.

    Args:
        host: The process.
        session: Its session.
        say: Sends a request to a shard without waiting for the answer.
        folders: Those of the run.

    Attributes:
        payloads: The real client's side.
    """

    def __init__(
        self, host: Host, session: str, say: Callable[[str, Request], None], folders: Folders
    ) -> None:
        self._session, self._folders = session, folders
        self._sees = folders.world.schedule.stream(f"what {host.name} sees").random() < SEEN
        self.payloads = SharedPayloads(
            session,
            say,
            self._count,
            open_folder=self._seen,
            now_s=lambda: host.local_ns / 1e9,
        )
        self._open: set[Draft] = set()

    def _count(self, name: str) -> None:
        self._folders.world.tally[f"client: {name}"] += 1

    def _seen(self, name: str, _: bytes) -> OpenedFolder:
        if not self._sees:
            raise LinkError("on another host")
        return self._folders.seen(name)

    def begun(self, shard: str, asked: Stage, answer: Answer | None) -> Draft | None:
        """Open what a shard has made as asked; None if messages have to carry the bytes."""
        try:
            return self.payloads.begun(shard, asked, answer)
        except NoRoomError:
            self._folders.world.tally["payloads without room"] += 1
            return None

    def takes(self, draft: Draft, body: bytes) -> None:
        """Note that a draft is open, and what will be in it."""
        self._open.add(draft)
        self._folders.written[draft.file] = body
        self._folders.pending.add(draft.file)

    def fill(self, draft: Draft) -> None:
        """Fill a draft, and close it."""
        self.payloads.filled(draft, [self._folders.written[draft.file]])
        self._open.discard(draft)
        self._folders.world.tally["files filled"] += 1

    def ended(self, shard: str, file: str, *, committed: bool) -> None:
        """Give up a file that was not committed; its shard may not hear of it."""
        if file in self._folders.pending:
            self._folders.pending.discard(file)
            if not committed:
                self.payloads.drop(shard, file)

    def fork(self, shard: str, size: int) -> None:
        """Fork; the child wants to fill a file, and cannot ask for one."""
        payloads = self.payloads
        child = copy.copy(payloads)
        child._shards = {name: copy.copy(one) for name, one in payloads._shards.items()}  # noqa: SLF001
        for shared in child._shards.values():  # noqa: SLF001
            shared.ahead = copy.deepcopy(shared.ahead)
        child.leave_pages()
        self._folders.world.tally["clients forked"] += 1
        found = child.begin(shard, size)
        if isinstance(found, Draft):
            self.takes(found, b"of the child".ljust(size, b"."))
            self.fill(found)

    def mapped(self, reading: Reading) -> Datum | None:
        """Return a datum whose file is mapped here; None if it has to be fetched."""
        named = reading.state.datum
        if named is None or not named.file:
            return None
        place = reading.shard, reading.epoch, named.file
        body = self.payloads.mapped(*place, reading.state.size)
        if body is None:
            return None
        self._folders.world.tally["data mapped"] += 1
        return replace(named, body=bytes(body), file="")

    def vanish(self) -> None:
        """End with the process: the kernel closes what is open."""
        self._folders.world.tally["clients that died over a file"] += bool(self._open)
        for draft in self._open:
            draft.close()
        self._open.clear()
        mine = {file for file in self._folders.pending if file.startswith(self._session)}
        self._folders.pending -= mine
        self.payloads.close()
