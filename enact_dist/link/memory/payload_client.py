"""Large data on the client's side: writes them to the shard's folder, reads by mapping files.

Both need shared memory between client and shard, which the nonce in the shard's WELCOME proves for
one start of it (see `link.memory.shared_folder`).  Otherwise, and after any failure here, the same
bytes go into messages; failures are counted and never reach the caller.

A shard in this process takes the bytes without a copy.  Data filled in place for it go to a file
without a name, so that the writer can be detached from it in the same way.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import threading
import time
import weakref
from typing import TYPE_CHECKING, Any, Final

from enact_dist.core.protocol.datum import Datum
from enact_dist.core.protocol.messages import NO_ROOM, Refused, Stage, Staged
from enact_dist.errors import EnactError
from enact_dist.link.memory.ahead import NamesAhead
from enact_dist.link.memory.maps import (
    Pages,
    anonymous_file,
    body_of,
    cut_off,
    leftovers,
    map_file,
    map_to_fill,
)
from enact_dist.link.memory.shared_folder import OpenedFolder, open_shared
from enact_dist.link.memory.use_marks import ClientPage, retains
from enact_dist.link.refusals import error_of
from enact_dist.wire.limits import DRAFT_NAME, PAYLOAD_BYTES_MIN

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from enact_dist.core.protocol.messages import Answer, Request, Welcome

    Call = Callable[[str, Request], Answer | None]

PARTS_MAX: Final = 512
"""Buffers in one system call; the kernel takes 1024."""
NOTHING: Final = Datum(b"", b"", 0)

_log = logging.getLogger("enact.link")


class Draft:
    """A payload that this process fills; to be committed by its name, or dropped.

    Errors of the system pass through as `OSError`.

    Attributes:
        shard: The shard that stores it.
        file: Its name there; "" if it has none and is committed by its bytes.
        size: Its length in bytes.
    """

    __slots__ = ("_descriptor", "_pages", "file", "shard", "size")

    def __init__(self, shard: str, file: str, size: int, descriptor: int) -> None:
        self.shard, self.file, self.size = shard, file, size
        self._descriptor = descriptor
        self._pages: Pages | None = None

    def fill(self, parts: Sequence[Any]) -> memoryview:
        """Write the parts in order, filling all of it; return the bytes, read-only.

        Writing costs half as much as filling a fresh map: this process touches no new page.
        """
        offset = 0
        left = [memoryview(part).cast("B") for part in parts]
        while left:
            written = os.pwritev(self._descriptor, left[:PARTS_MAX], offset)
            offset += written
            while left and written >= len(left[0]):
                written -= len(left.pop(0))
            if written:
                left[0] = left[0][written:]
        return self.shown()

    def shown(self) -> memoryview:
        """Return the bytes, read-only, in a map that `close` does not detach."""
        return body_of(map_file(self._descriptor, self.size, writable=False)).toreadonly()

    def memory(self) -> memoryview:
        """Return the bytes, writable in place."""
        self._pages = map_to_fill(self._descriptor, self.size)
        return body_of(self._pages)

    def close(self) -> None:
        """Ensure that no later write of this process reaches the file; idempotent.

        Memory that was filled in place stays readable.  It is detached from the file a moment
        later, in another thread, because that takes long.
        """
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor < 0:
            return
        pages, self._pages = self._pages, None
        if pages is None:
            os.close(descriptor)
        else:
            leftovers().start()
            leftovers().later(_cut_off, pages, descriptor)


def _cut_off(pages: Pages, descriptor: int) -> None:
    try:
        cut_off(pages, descriptor)
    except OSError as error:
        _log.warning("a committed array could not be detached from its file: %s", error)


class _Shared:
    """The shared folder of one start of a shard, if this process sees it."""

    __slots__ = ("ahead", "epoch", "folder", "keeps", "name", "nonce", "page")

    def __init__(self, welcome: Welcome, ahead: NamesAhead) -> None:
        self.ahead = ahead
        self.name, self.nonce, self.epoch = welcome.shared, welcome.shared_nonce, welcome.epoch
        self.folder: OpenedFolder | None = None
        self.page: ClientPage | None = None
        self.keeps = False

    def opened(self, file: str, size: int, access: int) -> int:
        """Open a payload; see `OpenedFolder.opened`."""
        assert self.folder is not None
        return self.folder.opened(file, size, access)

    def __del__(self) -> None:
        if self.folder is not None:
            self.folder.close()


class SharedPayloads:
    """The payloads of all shards as one process sees them.  Thread-safe.

    Args:
        session: The session of this process; its payloads carry its name.
        call: Makes one call to a shard; None: no answer.
        count: Adds to a counter of the session.
        inside: Whether the only shard runs in this process and takes data without a copy.
        open_folder: Opens the folder of a name and a nonce, as `open_shared` does.
        now_s: Measures how long no payload of a length was made.

    Attributes:
        inside: As above.
    """

    def __init__(
        self,
        session: str,
        call: Call,
        count: Callable[[str], None],
        *,
        inside: bool = False,
        open_folder: Callable[[str, bytes], OpenedFolder] = open_shared,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.inside: Final = inside
        self._session = session
        self._call = call
        self._count = count
        self._open_folder, self._now_s = open_folder, now_s
        self._rows: Final = itertools.count(1).__next__
        self._mutex = threading.Lock()
        self._shards: dict[str, _Shared] = {}
        self._mapped: weakref.WeakValueDictionary[tuple[str, int, str], Pages] = (
            weakref.WeakValueDictionary()
        )

    def learn(self, welcome: Welcome) -> None:
        """Take from a WELCOME what the shard shares; opened on first use."""
        with self._mutex:
            known = self._shards.get(welcome.shard)
            if known is not None and (known.epoch, known.name) == (welcome.epoch, welcome.shared):
                return
            self._shards[welcome.shard] = shared = _Shared(welcome, NamesAhead(self._rows))
            if shared.name:
                try:
                    shared.folder = self._open_folder(shared.name, shared.nonce)
                    shared.keeps = shared.folder.files >= 0 and retains()
                except EnactError as error:
                    self._count("payload_folders_elsewhere")
                    _log.info("shard %s: %s", welcome.shard, error)

    def _folder(self, shard: str) -> _Shared | None:
        """Return what a shard shares if this process may open its files."""
        shared = self._shards.get(shard)
        if shared is None or shared.folder is None or shared.folder.files < 0:
            return None
        return shared

    # ---------------------------------------------------------------- kept grants

    def sees(self, shard: str) -> bool:
        """Whether this process sees the folder of a shard, whatever it may do there."""
        shared = self._shards.get(shard)
        return shared is not None and shared.folder is not None

    def keeps(self, shard: str) -> bool:
        """Whether a shard may see which of its grants this session uses."""
        shared = self._shards.get(shard)
        return shared is not None and shared.keeps

    def page(self, shard: str, epoch: int) -> ClientPage | None:
        """Return this session's page of one start of a shard; None if there is none here."""
        shared = self._shards.get(shard)
        return shared.page if shared is not None and shared.epoch == epoch else None

    def pages(self) -> list[tuple[str, ClientPage]]:
        """Return the pages of this session, each with its shard."""
        shared = list(self._shards.items())
        return [(shard, each.page) for shard, each in shared if each.page is not None]

    def prove(self, shard: str) -> None:
        """Open this session's page, as its shard has asked; without it, keep no grants there.

        A shard that has forgotten this session meanwhile has made another one.
        """
        with self._mutex:
            shared = self._folder(shard)
            folder = shared.folder if shared is not None and shared.keeps else None
            if shared is None or folder is None:
                return
            try:
                if shared.page is None or not shared.page.is_in(folder.files, self._session):
                    shared.page = ClientPage(folder.files, folder.owner, self._session)
            except OSError as error:
                self.keep_no_more(shard, error)

    def keep_no_more(self, shard: str, error: OSError) -> None:
        """Keep no grants of one start of a shard any more."""
        shared = self._shards.get(shard)
        if shared is not None:
            shared.keeps = False
        self._count("pages_of_grants_failed")
        _log.info("no grants of shard %s are kept: %s", shard, error)

    def leave_pages(self) -> None:
        """Close the pages that a forked child has inherited, without giving marks back.

        The files ahead are left to the parent, too: a child would open the same one as it does.
        """
        for shared in list(self._shards.values()):
            shared.ahead = NamesAhead(self._rows)
            if shared.page is not None:
                shared.page.close()

    # ---------------------------------------------------------------- writing

    def draft(self, shard: str, size: int) -> Draft | None:
        """Make a payload to be filled; None if the bytes have to go into messages.

        Raises:
            NoRoomError: The shard's limit is reached, and it has no history left to remove.
        """
        begun = self.begin(shard, size)
        if not isinstance(begun, Stage):
            return begun
        return self.begun(shard, begun, self._call(shard, begun))

    def begin(self, shard: str, size: int) -> Draft | Stage | None:
        """Open a file that is there already, or return the question for one, for `begun`.

        Returns:
            None if the bytes have to go into messages.
        """
        shared = self._folder(shard)
        if shared is None or size <= PAYLOAD_BYTES_MIN:
            return None
        with self._mutex:
            number, ready = shared.ahead.take(size, self._now_s())
        file = f"{self._session}-{number:x}"
        if ready:
            with contextlib.suppress(OSError):  # not there: it is asked for
                return Draft(shard, file, size, shared.opened(file, size, os.O_RDWR))
        with self._mutex:
            return Stage(self._session, file, 0, size, NOTHING, shared.ahead.asks(size))

    def begun(self, shard: str, asked: Stage, answer: Answer | None) -> Draft | None:
        """Open the file that a shard has made as asked; None if messages must carry the bytes.

        Raises:
            NoRoomError: As `draft`.
        """
        if isinstance(answer, Refused) and answer.code == NO_ROOM:
            raise error_of(answer)
        file, size, shared = asked.file, asked.total, self._folder(shard)
        made = answer if isinstance(answer, Staged) and answer.shared else None
        if shared is not None and made is not None and DRAFT_NAME.match(made.draft):
            name = made.draft or file
            try:
                return Draft(shard, file, size, shared.opened(name, size, os.O_RDWR))
            except OSError as error:
                # Most likely the folder is read-only here.
                with self._mutex:
                    shared.ahead.unusable(size)
                _log.info("payload %s of shard %s: %s", file, shard, error)
        self._count("payload_fallbacks")
        if isinstance(answer, Staged):
            self.drop(shard, file)
        return None

    def nameless(self, shard: str, size: int) -> tuple[Draft, memoryview, memoryview] | None:
        """Make memory to be filled in place and passed to a shard in this process without a copy.

        Returns:
            The draft, its writable bytes, and the same bytes for the shard; None if they are few,
            are copied anyway, or no such memory is available.
        """
        if not self.inside or size <= PAYLOAD_BYTES_MIN:
            return None
        try:
            draft = Draft(shard, "", size, anonymous_file(size))
            try:
                return draft, draft.memory(), draft.shown()
            except BaseException:
                draft.close()
                raise
        except OSError as error:
            self._count("payload_fallbacks")
            _log.info("%d bytes to be filled have no file: %s", size, error)
            return None

    def filled(self, draft: Draft, parts: Sequence[Any]) -> memoryview | None:
        """Fill a payload; return its bytes, or None if that fails and messages must carry them."""
        try:
            return draft.fill(parts)
        except OSError as error:
            self._failed(draft, error)
            return None
        finally:
            draft.close()

    def memory(self, draft: Draft) -> memoryview | None:
        """Return the memory of a payload to be filled in place; None if that fails."""
        try:
            return draft.memory()
        except OSError as error:
            draft.close()
            self._failed(draft, error)
            return None

    def _failed(self, draft: Draft, error: OSError) -> None:
        self._count("payload_fallbacks")
        _log.info("payload %s of shard %s: %s", draft.file, draft.shard, error)
        self.drop(draft.shard, draft.file)

    def drop(self, shard: str, file: str) -> None:
        """Tell a shard that a payload will not be committed; without this it notices later."""
        try:
            self._call(shard, Stage(self._session, file, 0, 0, NOTHING))
        except EnactError as error:
            _log.info("cannot give up payload %s of shard %s: %s", file, shard, error)

    # ---------------------------------------------------------------- reading

    def mapped(self, shard: str, epoch: int, file: str, size: int) -> memoryview | None:
        """Return the bytes of a payload without a copy; None if they have to be fetched.

        A map lasts while its bytes are in use.  No map is cached for later readers, so replaced
        data leave memory with their last reader.
        """
        shared = self._folder(shard)
        if shared is None or shared.epoch != epoch:
            return None
        key = shard, epoch, file
        pages = self._mapped.get(key)
        if pages is None or pages.size != size:
            try:
                descriptor = shared.opened(file, size, os.O_RDONLY)
                try:
                    pages = map_file(descriptor, size, writable=False)
                finally:
                    os.close(descriptor)
            except OSError as error:
                self._count("maps_failed")
                _log.info("payload %s of shard %s cannot be mapped: %s", file, shard, error)
                return None
            self._mapped[key] = pages
        return body_of(pages).toreadonly()

    def close(self) -> None:
        """Close all folders; mapped payloads stay."""
        with self._mutex:
            self._shards.clear()
