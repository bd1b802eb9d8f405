"""Payloads at a shard: large data that arrived, or were written, ahead of their commit.

::

    Stage(total) ──> draft ── filled by a client of this host in the shared folder,
                       │      or by slices that come in Stage messages
    Commit, Prepare ───┴──> adopted: read-only, its bytes become the body of the datum
    last datum gone ──────> the file is removed; processes that have mapped it keep its content

The handler works in front of the shard: the core sees bodies and never learns where they are
stored.  A payload lasts as long as its bytes are in use, a draft as long as its client.
Files that a client will ask for are made ahead (`link.memory.ahead`); they are drafts, too.

Rules that a change must keep:

- A name is used once.  Readers learn of a payload only after its commit, so no reader sees a
  half-filled one.
- Bytes count against the limit from before the file is made until it is gone.
- A client that still has a draft mapped for writing could change it after the commit.  Our client
  hands out read-only arrays from then on and detaches itself some milliseconds later; a hostile one
  of the same user could do worse.
"""

from __future__ import annotations

import logging
import threading
import weakref
from collections import deque
from dataclasses import replace
from errno import EEXIST
from functools import partial
from typing import TYPE_CHECKING, Final, TypeVar

from enact_dist.core.protocol.messages import NO_ROOM, PROTOCOL, Refused, Staged, WriteItem
from enact_dist.link.clock import Clock, SystemClock
from enact_dist.link.memory.ahead import BYTES_MAX, FILES_MAX, AheadOf
from enact_dist.link.memory.drafts import (
    DRAFT_BYTES_MAX,
    Drafted,
    beyond_share,
    given_up,
    names_payloads,
    no_room,
    plain_bytes,
    unused,
)
from enact_dist.link.memory.maps import Pages, PlainMemory, body_of, leftovers, plain_memory
from enact_dist.link.memory.names import UsedNames
from enact_dist.link.memory.payload_files import PayloadFiles
from enact_dist.link.memory.shared_folder import SharedFolder
from enact_dist.wire.limits import BODY_BYTES_MAX, PAYLOAD_BYTES_MIN, PAYLOAD_NAME

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.core.protocol.datum import Datum
    from enact_dist.core.protocol.messages import Commit, Prepare, Stage

    _Written = TypeVar("_Written", Commit, Prepare)

GAPS_MAX: Final = 1024
"""Slices of one draft that may arrive before a preceding one."""
DRAFT_NS: Final = 30_000_000_000
"""A draft of a session without a lock is dropped after this time without a slice."""
FULL_NS: Final = 100_000_000
"""After a payload did not fit, the handler frees no room for one as large during this time."""
ROOM_S: Final = 1.0
"""How long a new draft waits for files that are being removed."""
SILENT_NS: Final = 60_000_000_000
"""Shortest time between two log lines about payloads outside the folder; all are counted."""
ROOM_TRIES: Final = 8
"""How often history is removed for a draft, more each time, while others take that room."""

_log = logging.getLogger("enact.shard")


class PayloadHandler:
    """The payloads of one shard.  Thread-safe; never waits for the shard.

    Args:
        folder: Where clients of this host find them, or its files; None: they stay in this process.
        bytes_max: Byte limit of the files, drafts included; without a folder, of the drafts.
        firm: Whether a payload beyond the limit is refused; otherwise it goes to plain memory.
        make_room: Called to remove history until so many bytes are free.
        biggest: Names the largest slots, for the text of a refusal.
        clock: Measures how long a draft has had no slice.

    Attributes:
        counters: Counters by name, for `ListSessions`.
    """

    def __init__(
        self,
        folder: SharedFolder | PayloadFiles | None,
        bytes_max: int,
        *,
        firm: bool = True,
        make_room: Callable[[int], None] = lambda _: None,
        biggest: Callable[[], str] = lambda: "",
        clock: Clock | None = None,
    ) -> None:
        self.counters: dict[str, int] = {}
        self._disk = PayloadFiles(folder) if isinstance(folder, SharedFolder) else folder
        self._bytes_max = bytes_max
        self._firm = firm
        self._draft_bytes_max = bytes_max if folder is None else DRAFT_BYTES_MAX
        self._make_room = make_room
        self._biggest = biggest
        self._clock: Clock = clock or SystemClock()
        self._mutex = threading.RLock()  # reentrant: a destructor may run anywhere
        self._opening = tuple(threading.Lock() for _ in range(16))
        self._drafts: dict[str, Drafted] = {}
        self._files = 0
        self.wants_ahead: deque[AheadOf] = deque()  # what `make_ahead` has to do
        self._adopted: dict[str, weakref.ref[Pages | PlainMemory]] = {}
        self._over, self._taken_back = UsedNames(), UsedNames()
        self._bytes = self._gone = 0
        self._full = 0, 0
        self._silent_until_ns = 0

    # ---------------------------------------------------------------- drafts

    def stage(self, message: Stage, owner: str = "") -> Staged | Refused:
        """Open a draft, take a slice of one, or drop one.

        Args:
            message: A slice, or a request for room.
            owner: The identity whose share of the room it takes; default: the session's.
        """
        file, total = message.file, message.total
        if not PAYLOAD_NAME.match(file) or not file.startswith(f"{message.session}-"):
            return Refused(PROTOCOL, f"{file[:80]!r} is no payload of session {message.session}")
        if not total:
            self.drop(file)
            return Staged(file, 0, shared=False)
        with self._mutex:
            if file in self._over:
                return Staged(file, total, False)  # a late copy that no client waits for
        if not 0 < total <= BODY_BYTES_MAX:
            return Refused(PROTOCOL, f"a payload of {total} bytes; at most {BODY_BYTES_MAX}")
        draft: Drafted | Refused | None = self._drafts.get(file)
        if draft is None:
            # Slices of one draft may come from several threads.
            with self._opening[hash(file) % len(self._opening)]:
                draft = self._drafts.get(file) or self._opened(
                    message.session, owner or message.session, file, total
                )
        if not isinstance(draft, Drafted):
            return draft or Staged(file, total, False)
        if draft.size != total:
            return Refused(PROTOCOL, f"payload {file} has {draft.size} bytes, not {total}")
        if not draft.asked or message.ahead != draft.ahead:
            draft.asked, draft.ahead = True, message.ahead if draft.shared else 0
            self._want(file, draft)
        return self._take(file, draft, message.offset, message.body)

    # ---------------------------------------------------------------- files ahead

    def make_ahead(self) -> None:
        """Make the files that are wanted ahead; to be called once answers have been sent."""
        while self.wants_ahead:
            try:
                wanted = self.wants_ahead.popleft()
            except IndexError:  # another thread was faster
                return
            names = wanted.names()
            if sum(file in self._drafts for file in names) > wanted.behind // 2:
                continue  # several at once disturb a client less than one after each commit
            for file in names:
                opening = self._opening[hash(file) % len(self._opening)]
                if not opening.acquire(blocking=False):
                    break  # perhaps another client waits for room: this one shall not wait for it
                try:
                    if not self._made_ahead(file, wanted):
                        break
                finally:
                    opening.release()

    def _want(self, file: str, draft: Drafted) -> None:
        if draft.ahead:
            self.wants_ahead.append(AheadOf(file, draft.owner, draft.size, draft.ahead))

    def _made_ahead(self, file: str, wanted: AheadOf) -> bool:
        """Make one file unless its name is in use, or was; return False if there is no room."""
        session, size = wanted.session, wanted.size
        with self._mutex:
            if any(file in known for known in (self._drafts, self._over, self._taken_back)):
                return True
            mine = [draft.size for draft in self._drafts.values() if draft.session == session]
            many = len(mine) > FILES_MAX or sum(mine) + size > BYTES_MAX
            short = self._bytes + size > self._bytes_max // 2
            if self._disk is None or many or short or self._disk.is_nearly_full():
                return False
            self._bytes += size
            self._files += 1
        try:
            memory = self._filed(self._disk, file, size)
        except OSError:
            return False  # a client that asks for it will hear why
        now_ns = self._clock.monotonic_ns()
        draft = Drafted(
            session, wanted.owner, size, memory, True, now_ns, ahead=wanted.behind, asked=False
        )
        with self._mutex:
            if file not in self._over:
                self._drafts[file] = draft
        return True

    def _gave_back(self, missing: int) -> bool:
        """Remove files made ahead, and not asked for, of so many bytes; return if any were."""
        with self._mutex:
            files = unused(self._drafts, missing)
            self._remove(files)
        if files:
            leftovers().wait(ROOM_S)
        return bool(files)

    def _remove(self, files: list[str]) -> list[Drafted]:
        """Drop and return drafts, and count those made ahead.  The mutex is held.

        A file made ahead comes again only if its client asks for it: it may be filling the one that
        is removed, and its commit would publish the new one, with nothing in it.
        """
        gone = [self._drafts.pop(file) for file in files]
        for file, draft in zip(files, gone, strict=True):
            if not draft.asked:
                self._taken_back.add(file)
                self._count("files_ahead_removed")
        return gone

    def _take(self, file: str, draft: Drafted, offset: int, slice_: Datum) -> Staged | Refused:
        end = offset + slice_.size
        if not 0 <= offset <= end <= draft.size:
            return Refused(PROTOCOL, f"a slice up to {end} of payload {file} of {draft.size} bytes")
        if len(draft.beyond) >= GAPS_MAX:
            return Refused(PROTOCOL, f"{GAPS_MAX} slices of payload {file} came ahead of others")
        with self._mutex:
            draft.touched_ns = self._clock.monotonic_ns()
            if self._drafts.get(file) is not draft:
                return Staged(file, draft.size, False)  # a late copy, as in `stage`
            if not slice_.size or end <= draft.have:
                return Staged(file, draft.have, draft.shared)
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
            return Staged(file, draft.have, draft.shared)

    def _opened(self, session: str, owner: str, file: str, total: int) -> Drafted | Refused | None:
        """Return a new draft; None if its name has been used meanwhile."""
        small = total <= PAYLOAD_BYTES_MIN  # often many together, and read with the grant
        memory: Pages | None = None
        if self._disk is not None and not small:
            if self._has_room(total) or (
                self._firm and self._displaced(owner, total, shared=True) and self._reserved(total)
            ):
                memory = self._in_folder(self._disk, file, total)
            elif self._firm:
                return self._refused(session, total, self._bytes, self._bytes_max)
            else:
                self._travels(f"its limit of {self._bytes_max} bytes is reached", self._disk)
        if memory is None:
            with self._mutex:
                drafted = plain_bytes(self._drafts)
            full = drafted + max(total, PAYLOAD_BYTES_MIN) > self._draft_bytes_max
            if full and not self._displaced(owner, total, shared=False):
                return self._refused(session, total, drafted, self._draft_bytes_max)
        try:
            found = memory or plain_memory(total, ended=partial(self._ended, file, None, 0))
        except OSError as error:
            self._count("payloads_refused")
            return Refused(NO_ROOM, f"no memory for a payload of {total} bytes: {error.strerror}")
        draft = Drafted(
            session, owner, total, found, memory is not None, self._clock.monotonic_ns()
        )
        with self._mutex:
            if file in self._over:
                return None
            self._drafts[file] = draft
        return draft

    def _has_room(self, total: int) -> bool:
        """Count the bytes of a new file if they fit under the limit, removing history if needed."""
        if self._reserved(total):
            return True
        if self._gave_back(self._bytes + total - self._bytes_max) and self._reserved(total):
            return True
        until_ns, least = self._full
        if self._clock.monotonic_ns() < until_ns and total >= least:
            return False  # searching all history again would only delay others
        asked = 0
        for _ in range(ROOM_TRIES):
            gone = self._gone
            missing = self._bytes + (asked + 1) * total - self._bytes_max
            if missing > 0:  # otherwise room has been freed meanwhile
                self._make_room(missing)
                asked += 1
            # Released data take a moment to disappear.
            leftovers().wait(ROOM_S)
            if self._reserved(total):
                return True
            if missing > 0 and self._gone == gone:
                break  # no more history to remove; otherwise another payload took the room
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
        """Drop drafts of clients beyond their share for one within its share; return if any.

        Otherwise a client that only stages and never commits would fill the folder.  A client that
        still wanted its draft learns of the loss at its commit and stages it again.
        """
        most = self._bytes_max if shared else self._draft_bytes_max
        with self._mutex:
            files, freed = beyond_share(self._drafts, most, owner, total, shared=shared)
            for file in files:
                if self._drafts[file].asked:
                    self._over.add(file)
            displaced = sum(draft.asked for draft in self._remove(files))
        if files:
            self._count("drafts_displaced", displaced)
            leftovers().wait(ROOM_S)
        return bool(files) and freed >= total

    def _refused(self, session: str, total: int, used: int, most: int) -> Refused:
        self._count("payloads_refused")
        return no_room(session, total, used, most, self._biggest())

    def _in_folder(self, disk: PayloadFiles, file: str, total: int) -> Pages | None:
        """Return the memory of a new file whose bytes are counted; None if that fails."""
        why = ""  # not the error itself, which would keep the frames of all callers, and their data
        for again in (False, True):
            try:
                return self._filed(disk, file, total)
            except OSError as error:
                why, code = str(error.strerror or error), error.errno
            # Unused files may have filled the folder, or this one has yet to disappear.
            more = not again and (self._gave_back(total) or code == EEXIST)
            if not (more and leftovers().wait(ROOM_S) and self._reserved(total)):
                break
        self._travels(why, disk)
        return None

    def _filed(self, disk: PayloadFiles, file: str, total: int) -> Pages:
        try:
            return disk.make(file, total, partial(self._ended, file, disk, total))
        except OSError:
            with self._mutex:
                self._bytes -= total
                self._files -= 1
            raise

    def _travels(self, why: str, disk: PayloadFiles) -> None:
        """Count a payload outside the folder, and log it; a full folder is logged less often."""
        self._count("payload_fallbacks")
        now_ns = self._clock.monotonic_ns()
        if now_ns >= self._silent_until_ns:
            self._silent_until_ns = now_ns + SILENT_NS
            text = "large data go over the network because the shared folder %s takes none: %s"
            _log.warning(text, disk.path, why)

    def drop(self, file: str) -> None:
        """Drop a draft, if it exists."""
        with self._mutex:
            draft = self._drafts.pop(file, None)
            self._over.add(file)
        if draft is not None:
            self._want(file, draft)

    # ---------------------------------------------------------------- adoption

    def with_bodies(self, message: _Written) -> _Written:
        """Return a commit or prepare with its named payloads replaced by bodies.

        Missing payloads stay without a body; the shard decides what that means for the lock.
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
        # PlainMemory memory has a name only for its writer.
        file = datum.file if shared else ""
        return WriteItem(write.slot, replace(datum, body=body, file=file))

    def _adopt(self, file: str, size: int) -> Pages | PlainMemory | None:
        """Return the bytes of a complete payload and adopt it; None if there is none."""
        if file not in self._drafts and file not in self._adopted:
            with self._opening[hash(file) % len(self._opening)]:
                pass  # its client may have found a file ahead that is not yet a draft here
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
            if not draft.asked:
                self._count("files_ahead_used")
        self._want(file, draft)
        if draft.shared and self._disk is not None and not self._disk.publish(file):
            return None
        self._count("payloads_adopted")
        return draft.memory

    def _ended(self, file: str, disk: PayloadFiles | None, counted: int) -> None:
        """Delete a payload without readers, then stop counting its bytes."""
        if disk is not None:
            disk.unlink(file)
        with self._mutex:
            self._bytes -= counted
            self._files -= disk is not None
            self._gone += 1

    def _unadopted(self, file: str, gone: weakref.ref[Pages | PlainMemory]) -> None:
        """Forget an adopted payload; a late draft of the same name then ends silently."""
        with self._mutex:
            if self._adopted.get(file) is gone:
                del self._adopted[file]

    # ---------------------------------------------------------------- life

    def sweep(self, lives: Callable[[str], bool], works: Callable[[str], bool]) -> None:
        """Drop the drafts that no client will commit any more.

        Args:
            lives: Whether a session is known.
            works: Whether a session holds a lock.
        """
        if not self._drafts:
            return
        late_ns = self._clock.monotonic_ns() - DRAFT_NS
        with self._mutex:
            gone = self._remove(given_up(self._drafts, lives, works, late_ns))
        if gone:  # freed once others may go on
            self._count("drafts_swept", sum(draft.asked for draft in gone))

    def drafts(self) -> dict[str, str]:
        """Return the session of each draft, by its name."""
        if not self._drafts:
            return {}
        with self._mutex:
            return {file: draft.session for file, draft in self._drafts.items()}

    def figures(self) -> dict[str, int]:
        """Return counters and current values: files, bytes, drafts."""
        with self._mutex:
            ahead = [draft.size for draft in self._drafts.values() if not draft.asked]
            return {
                **self.counters,
                "payload_files": self._files,
                "payload_bytes": self._bytes,
                "payload_bytes_max": self._bytes_max if self._disk is not None else 0,
                "payload_drafts": len(self._drafts) - len(ahead),
                "files_ahead": len(ahead),
                "files_ahead_bytes": sum(ahead),
            }

    def _count(self, name: str, count: int = 1) -> None:
        with self._mutex:
            self.counters[name] = self.counters.get(name, 0) + count
