"""Payloads at a shard: large data that came, or were made, apart from the commit that names them.

::

    Stage(total) ──> draft ── filled by a client of this host in the shared folder,
                       │      or by slices that come in Stage messages
    Commit, Prepare ───┴──> adopted: read-only, its bytes become the body of the datum
    last datum gone ──────> the file is removed; processes that have mapped it keep its content

The desk stands in front of the shard: the core sees bodies and never learns where they lie.  A
payload lasts as long as somebody looks at its bytes, and a draft as long as its client.

Rules that a change must keep:

- A name is used once.  No reader learns of a payload before its commit stands, so none is ever read
  half-filled.
- What is counted against the cap is counted until the file is gone, and before it is made.
- A client that still has a draft mapped for writing could change it after the commit.  Ours hands
  out read-only arrays then and cuts itself off some milliseconds later; a hostile one of the same
  user could do worse.
- In a folder of a group, whose users may write what the shard makes for them, a draft has a name
  that only its client learns, and that cannot be listed; it gets that of its payload when it is
  read-only.  What is left there: a hostile client can change its own payload after the commit, and
  a user of the group can read payloads whose names he knows, as he can by asking the shard.
"""

from __future__ import annotations

import logging
import os
import secrets
import threading
import weakref
from collections import Counter
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Final, TypeVar

from enact_dist.core.messages import Refused, Staged, WriteItem
from enact_dist.link.clock import Clock, SystemClock
from enact_dist.link.memory import Pages, Plain, body_of, leftovers, map_file, plain_memory
from enact_dist.link.used_names import UsedNames
from enact_dist.wire.limits import BODY_BYTES_MAX, PAYLOAD_BYTES_MIN, PAYLOAD_NAME

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.core.datum import Datum
    from enact_dist.core.messages import Commit, Prepare, Stage
    from enact_dist.link.shared_folder import SharedFolder

    _Written = TypeVar("_Written", Commit, Prepare)

GAPS_MAX: Final = 1024
"""Slices of one draft that may be here while one before them is not."""
NO_ROOM: Final = "no_room"
"""The code of a refusal because of the cap."""
DRAFT_NS: Final = 30_000_000_000
"""A draft of a session that holds no lock is given up after so long without a slice."""
FULL_NS: Final = 100_000_000
"""So long after a payload did not fit, none that is as large is made room for."""
DRAFT_BYTES_MAX: Final = 2 << 30
"""Bytes of drafts that wait in plain memory for their commits."""
SHARES: Final = 4
"""Of the room for drafts one client has a quarter in any case; more only while others want none."""
ROOM_S: Final = 1.0
"""How long a new draft waits for files that are on their way out."""
SILENT_NS: Final = 60_000_000_000
"""Time between two log lines about payloads outside the folder; all of them are counted."""
ROOM_TRIES: Final = 8
"""How often history frees room for a draft, more each time, while others take that room."""

_log = logging.getLogger("enact.shard")


@dataclass(slots=True)
class _Draft:
    """A payload that no commit has named yet."""

    session: str
    owner: str
    size: int
    memory: Pages | Plain
    shared: bool
    touched_ns: int
    have: int = 0
    writing: int = 0
    beyond: list[tuple[int, int]] = field(default_factory=list)

    def add(self, begin: int, end: int) -> None:
        """Note that a slice is here, perhaps again, or before one that belongs in front of it."""
        self.beyond.append((begin, end))
        self.beyond.sort()
        while self.beyond and self.beyond[0][0] <= self.have:
            self.have = max(self.have, self.beyond.pop(0)[1])

    @property
    def whole(self) -> bool:
        """Whether all of it is here: from slices, or (none came) from its client in the folder.

        Not while a slice is being written: nothing may change once a commit has it.
        """
        if self.writing:
            return False
        return self.have == self.size or (self.shared and not self.have and not self.beyond)


class PayloadDesk:
    """The payloads of one shard.  Thread-safe; never waits for the shard.

    Args:
        folder: Where clients of this host find them; None keeps them in this process.
        bytes_max: So many bytes of files at most, drafts included; without a folder, of drafts.
        firm: Whether a payload beyond that is refused; else it lies in plain memory.
        make_room: Called to let history go, until so many bytes are free.
        biggest: Names the slots that hold the most, for the text of a refusal.
        clock: Tells how long a draft has had no slice.

    Attributes:
        counters: What happened, by name, for `ListSessions`.
    """

    def __init__(
        self,
        folder: SharedFolder | None,
        bytes_max: int,
        *,
        firm: bool = True,
        make_room: Callable[[int], None] = lambda _: None,
        biggest: Callable[[], str] = lambda: "",
        clock: Clock | None = None,
    ) -> None:
        self.counters: dict[str, int] = {}
        self._folder = folder
        self._bytes_max = bytes_max
        self._firm = firm
        self._draft_bytes_max = bytes_max if folder is None else DRAFT_BYTES_MAX
        self._make_room = make_room
        self._biggest = biggest
        self._clock: Clock = clock or SystemClock()
        self._mutex = threading.RLock()  # reentrant: a destructor may run anywhere
        self._opening = tuple(threading.Lock() for _ in range(16))
        self._drafts: dict[str, _Draft] = {}
        self._names: dict[str, str] = {}
        self._files = 0
        self._adopted: dict[str, weakref.ref[Pages | Plain]] = {}
        self._over = UsedNames()
        self._bytes = self._gone = 0
        self._full = 0, 0
        self._silent_until_ns = 0

    # ---------------------------------------------------------------- drafts

    def stage(self, message: Stage, owner: str = "") -> Staged | Refused:
        """Open a draft, take a slice of one, or give one up.

        Args:
            message: A slice, or the question for room.
            owner: Whose share of the room it takes; the session's own unless it is said.
        """
        file, total = message.file, message.total
        if not PAYLOAD_NAME.match(file) or not file.startswith(f"{message.session}-"):
            return Refused("protocol", f"{file[:80]!r} is no payload of session {message.session}")
        if not total:
            self.drop(file)
            return Staged(file, 0, shared=False)
        with self._mutex:
            if file in self._over:
                return Staged(file, total, False)  # a late copy: no client waits for it
        if not 0 < total <= BODY_BYTES_MAX:
            return Refused("protocol", f"a payload of {total} bytes; at most {BODY_BYTES_MAX}")
        draft: _Draft | Refused | None = self._drafts.get(file)
        if draft is None:
            # Slices of one draft may come by several threads.
            with self._opening[hash(file) % len(self._opening)]:
                draft = self._drafts.get(file) or self._opened(
                    message.session, owner or message.session, file, total
                )
        if draft is None:
            return Staged(file, total, False)
        if isinstance(draft, Refused):
            return draft
        if draft.size != total:
            return Refused("protocol", f"payload {file} has {draft.size} bytes, not {total}")
        return self._take(file, draft, message.offset, message.body)

    def _take(self, file: str, draft: _Draft, offset: int, slice_: Datum) -> Staged | Refused:
        end = offset + slice_.size
        if not 0 <= offset <= end <= draft.size:
            return Refused("protocol", f"a slice to {end} of payload {file}, of {draft.size} bytes")
        if len(draft.beyond) >= GAPS_MAX:
            return Refused("protocol", f"{GAPS_MAX} slices of payload {file} came before others")
        with self._mutex:
            draft.touched_ns = self._clock.monotonic_ns()
            if self._drafts.get(file) is not draft:
                return Staged(file, draft.size, False)  # meanwhile: a late copy, as in `stage`
            if not slice_.size or end <= draft.have:
                return Staged(file, draft.have, draft.shared, self._names.get(file, ""))
            draft.writing += 1
        try:
            body_of(draft.memory)[offset:end] = slice_.body
        except BaseException:
            with self._mutex:
                draft.writing -= 1
            raise
        with self._mutex:
            draft.writing -= 1
            draft.add(offset, end)
            return Staged(file, draft.have, draft.shared, self._names.get(file, ""))

    def _opened(self, session: str, owner: str, file: str, total: int) -> _Draft | Refused | None:
        """Return a new draft; None where its name was used up meanwhile."""
        small = total <= PAYLOAD_BYTES_MIN  # many of these together, each read with its grant
        shared = self._folder is not None and not small and self._has_room(total)
        if not shared and self._folder is not None and not small and self._firm:
            shared = self._displaced(owner, total, shared=True) and self._reserved(total)
            if not shared:
                return self._refused(session, total, self._bytes, self._bytes_max)
        if self._folder is not None and not shared and not small:
            self._travels(f"its cap of {self._bytes_max} bytes is reached")
        memory = self._in_folder(self._folder, file, total) if shared else None
        if memory is None:
            drafted = self._drafted()
            full = drafted + max(total, PAYLOAD_BYTES_MIN) > self._draft_bytes_max
            if full and not self._displaced(owner, total, shared=False):
                return self._refused(session, total, drafted, self._draft_bytes_max)
        try:
            found = memory or plain_memory(total, ended=partial(self._ended, file, None, 0))
        except OSError as error:
            self._count("payloads_refused")
            return Refused(NO_ROOM, f"{total} bytes for a payload cannot be had: {error.strerror}")
        draft = _Draft(session, owner, total, found, memory is not None, self._clock.monotonic_ns())
        with self._mutex:
            if file in self._over:
                return None
            self._drafts[file] = draft
        return draft

    def _has_room(self, total: int) -> bool:
        """Count the bytes of a new file if they fit under the cap, history gone if need be."""
        if self._reserved(total):
            return True
        until_ns, least = self._full
        if self._clock.monotonic_ns() < until_ns and total >= least:
            return False  # looking through all history again would only delay the others
        asked = 0
        for _ in range(ROOM_TRIES):
            gone = self._gone
            missing = self._bytes + (asked + 1) * total - self._bytes_max
            if missing > 0:  # else something has gone by itself since
                self._make_room(missing)
                asked += 1
            # Released data take a moment to leave.
            leftovers().wait(ROOM_S)
            if self._reserved(total):
                return True
            if missing > 0 and self._gone == gone:
                break  # history has no more to give; else another payload has taken the room
        self._full = self._clock.monotonic_ns() + FULL_NS, total
        return False

    def _reserved(self, total: int) -> bool:
        with self._mutex:
            if self._bytes + total > self._bytes_max:
                return False
            self._bytes += total
            self._files += 1
            return True

    def _displaced(self, owner: str, total: int, *, shared: bool) -> bool:
        """Give up drafts of those beyond their share for one who stays within; say whether any.

        Otherwise a client that stages more and more and commits nothing would fill the folder.
        A client that still wanted its draft learns of the loss at its commit, and stages again.
        """
        share = (self._bytes_max if shared else self._draft_bytes_max) // SHARES
        staged: Counter[str] = Counter()
        given_up, freed = [], 0
        with self._mutex:
            drafts = [
                (file, draft.owner, draft.size)
                for file, draft in self._drafts.items()
                if draft.shared == shared
            ]
            for _, other, size in drafts:
                staged[other] += size
            if staged[owner] + total > share:
                return False
            for file, other, size in drafts:
                if freed < total and staged[other] > share:
                    staged[other] -= size
                    freed += size
                    given_up.append(file)
            for file in given_up:
                self.drop(file)
        if not given_up:
            return False
        self._count("drafts_displaced", len(given_up))
        leftovers().wait(ROOM_S)
        return freed >= total

    def _drafted(self) -> int:
        """Return the bytes of drafts in plain memory; a small one costs more than it has."""
        with self._mutex:
            plain = [draft.size for draft in self._drafts.values() if not draft.shared]
        return sum(max(size, PAYLOAD_BYTES_MIN) for size in plain)

    def _refused(self, session: str, total: int, used: int, most: int) -> Refused:
        self._count("payloads_refused")
        return Refused(
            NO_ROOM,
            f"session {session[:8]} asked for a payload of {total} bytes; {used} of at most {most}"
            f" are in use{self._biggest()}; raise shared_bytes_max, keep fewer versions, or let go"
            " of arrays, and end locks, that hold old ones",
        )

    def _in_folder(self, folder: SharedFolder | None, file: str, total: int) -> Pages | None:
        """Return the memory of a new file whose bytes are counted; None where it cannot be."""
        assert folder is not None
        try:
            return self._file_memory(folder, file, total)
        except OSError as error:
            with self._mutex:
                self._bytes -= total
                self._files -= 1
            self._travels(str(error.strerror or error))
            return None

    def _travels(self, why: str) -> None:
        """Count a payload that is no file; say so, but of a full folder not for each."""
        self._count("payload_fallbacks")
        now_ns = self._clock.monotonic_ns()
        if self._folder is not None and now_ns >= self._silent_until_ns:
            self._silent_until_ns = now_ns + SILENT_NS
            text = "large data travel over the network, for the shared folder %s takes none: %s"
            _log.warning(text, self._folder.path, why)

    def _file_memory(self, folder: SharedFolder, file: str, total: int) -> Pages:
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        name = file
        if folder.access.group is not None:
            name = self._names[file] = f"draft-{secrets.token_hex(16)}"
        made = os.open(name, flags, 0o600, dir_fd=folder.descriptor)
        try:
            os.fchmod(made, folder.access.draft_mode)
            # Never a hole: a page that is missing later kills the process that touches it.
            os.posix_fallocate(made, 0, total)
            return map_file(
                made, total, writable=True, ended=partial(self._ended, file, folder, total)
            )
        except BaseException:
            os.unlink(name, dir_fd=folder.descriptor)
            self._names.pop(file, None)
            raise
        finally:
            os.close(made)

    def drop(self, file: str) -> None:
        """Give a draft up; nothing where there is none."""
        with self._mutex:
            self._drafts.pop(file, None)
            self._over.add(file)

    # ---------------------------------------------------------------- adoption

    def with_bodies(self, message: _Written) -> _Written:
        """Return a commit or prepare whose named payloads have become bodies.

        What is not here stays without: the shard then says what that means for this lock.
        """
        if not names_payloads(message):
            return message
        session = message.lock.session
        return replace(
            message, writes=tuple([self._adopted_by(w, session) for w in message.writes])
        )

    def _adopted_by(self, write: WriteItem, session: str) -> WriteItem:
        datum = write.datum
        if datum is None or not datum.file or len(datum.body) == datum.size:
            return write
        memory = None
        if datum.file.startswith(f"{session}-"):
            memory = self._adopt(datum.file, datum.size)
        if memory is None:
            self._count("payloads_missing")
            return write
        shared = isinstance(memory, Pages)
        body = body_of(memory).toreadonly()
        # Plain memory has a name for its writer alone.
        file = datum.file if shared else ""
        return WriteItem(write.slot, replace(datum, body=body, file=file))

    def _adopt(self, file: str, size: int) -> Pages | Plain | None:
        """Return the bytes of a whole payload, for good; None where there is none."""
        with self._mutex:
            known = self._adopted.get(file)
            if known is not None:
                memory = known()
                return memory if memory is not None and memory.size == size else None
            draft = self._drafts.get(file)
            if draft is None or draft.size != size or not draft.whole:
                return None
            del self._drafts[file]
            self._adopted[file] = weakref.ref(draft.memory, partial(self._unadopted, file))
            self._over.add(file)
        if draft.shared and self._folder is not None:
            name, descriptor = self._names.get(file, file), self._folder.descriptor
            try:
                os.chmod(name, self._folder.access.file_mode, dir_fd=descriptor)
                if name != file:
                    os.rename(name, file, src_dir_fd=descriptor, dst_dir_fd=descriptor)
                    del self._names[file]
            except OSError as error:  # somebody has cleared the folder
                _log.warning("payload %s is lost: %s", file, error.strerror)
                return None
        self._count("payloads_adopted")
        return draft.memory

    def _ended(self, file: str, folder: SharedFolder | None, counted: int) -> None:
        """Remove a payload without readers, then stop counting its bytes."""
        if folder is not None and folder.descriptor >= 0:
            try:
                os.unlink(self._names.pop(file, file), dir_fd=folder.descriptor)
            except OSError as error:  # the folder went first
                _log.info("payload %s: %s", file, error)
        with self._mutex:
            self._bytes -= counted
            self._files -= folder is not None
            self._gone += 1

    def _unadopted(self, file: str, gone: weakref.ref[Pages | Plain]) -> None:
        """Forget an adopted payload; others of its name, too late to be a draft, end unnoticed."""
        with self._mutex:
            if self._adopted.get(file) is gone:
                del self._adopted[file]

    # ---------------------------------------------------------------- life

    def sweep(self, lives: Callable[[str], bool], works: Callable[[str], bool]) -> None:
        """Give up the drafts that no client will commit any more.

        Args:
            lives: Whether a session is known.
            works: Whether a session holds a lock.
        """
        if not self._drafts:
            return
        late_ns = self._clock.monotonic_ns() - DRAFT_NS
        with self._mutex:
            over = [
                file
                for file, draft in self._drafts.items()
                if not lives(draft.session)
                or (draft.touched_ns < late_ns and not works(draft.session))
            ]
            gone = [self._drafts.pop(file) for file in over]
        if gone:
            self._count("drafts_swept", len(gone))

    def drafts(self) -> dict[str, str]:
        """Return the session of each draft, by its name.  For tests and simulation."""
        with self._mutex:
            return {file: draft.session for file, draft in self._drafts.items()}

    def figures(self) -> dict[str, int]:
        """Return counters, and what there is now: files, bytes, drafts."""
        with self._mutex:
            return {
                **self.counters,
                "payload_files": self._files,
                "payload_bytes": self._bytes,
                "payload_bytes_max": self._bytes_max if self._folder is not None else 0,
                "payload_drafts": len(self._drafts),
            }

    def _count(self, name: str, count: int = 1) -> None:
        with self._mutex:
            self.counters[name] = self.counters.get(name, 0) + count


def names_payloads(message: Commit | Prepare) -> bool:
    """Whether a commit or prepare names data that were sent ahead of it."""
    return any(write.datum is not None and write.datum.file for write in message.writes)


def half_of(folder: SharedFolder | None) -> int:
    """Return half of the bytes that the file system of a folder has; without one, of drafts."""
    if folder is None:
        return DRAFT_BYTES_MAX
    system = os.fstatvfs(folder.descriptor)
    return system.f_blocks * system.f_frsize // 2
