"""Kept grants on simulated hosts: the pages in plain memory, and a client that goes through them.

The shard's side is the real `ShardMarks`.  Its pages are simulated: cells stay when the shard's
process dies, marks vanish with the client's process.  A client stops for a while between any two of
its steps, and dies, sleeps or loses its shard there; while a shard looks at marks, clients go on.

Some clients are on a file system without locks, some on another host than their shards: of these
some keep nothing, and the others listen for recalls.  What such a client does with a far grant are
steps of its core alone, so it stands nowhere within them.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeAlias, cast

from enact_dist.core.protocol.messages import FAR, PROVE, Release
from enact_dist.core.state.tenure import KEPT_OF_SESSION_MAX
from enact_dist.link.memory.use_marks import PAGE_BYTES, PROOF, ShardMarks, ShardPage
from enact_dist.verify.simulation.hosts.world import MS

if TYPE_CHECKING:
    from random import Random

    from enact_dist.core.client.client import Client
    from enact_dist.core.client.kept import KeptGrant
    from enact_dist.core.client.lock import MultiLock
    from enact_dist.core.protocol.messages import Item
    from enact_dist.link.memory.shared_folder import SharedFolder

STOPS_NS: Final = tuple(us * MS // 1000 for us in (0, 0, 0, 50, 1_000, 5_000, 30_000))
"""How long a client stands between two steps, and before the first of them."""
FIRST_STOPS_NS: Final = (*STOPS_NS[2:], 100 * MS)


class Sight(enum.Enum):
    """What a client sees of the pages of its shards."""

    HERE = "on the host of its shards"
    BLIND = "where no locks of files work"
    AWAY = "on another host"
    FAR = "on another host, and it listens for recalls"


@dataclass(frozen=True, slots=True)
class Stop:
    """Stand between two steps; a shard that acts meanwhile may let this client go on."""

    duration_ns: int


Steps: TypeAlias = Generator[Stop, Any, "MultiLock | None"]


class SimulatedPage(ShardPage):
    """One session's page at one start of a shard, with the marks of the client's process.

    Attributes:
        marks: The locked bytes, each with the moment in which it was locked.
        cleared: The grants whose cells were cleared, each with the moment.
        freed_ns: When a byte was unlocked, in true time.
        uses: The marks of blocks whose clients have found that their grants live.
    """

    __slots__ = ("_between", "_moment", "_now", "cleared", "freed_ns", "marks", "uses")

    def __init__(self, between: Callable[[], None], now: Callable[[], int]) -> None:
        self.descriptor = -1
        self.cells = memoryview(bytearray(PAGE_BYTES)).cast("Q")
        self.places: dict[int, int] = {}
        self.free = list(range(KEPT_OF_SESSION_MAX))
        self.proven = False
        self.marks: dict[int, int] = {}
        self.cleared: dict[int, int] = {}
        self.freed_ns: dict[int, int] = {}
        self.uses: set[int] = set()
        self._between, self._now, self._moment = between, now, 0

    def locked(self, byte: int) -> bool:
        """Whether the client has locked a byte; clients go on before and after that."""
        self._between()
        found = byte in self.marks
        self._between()
        return found

    def set(self, place: int, number: int) -> None:
        """Set a cell; 0 clears it."""
        before: int = self.cells[place]
        if before and not number:
            self._moment += 1
            self.cleared[before] = self._moment
        super().set(place, number)

    def wipe(self) -> None:
        """Clear all cells: a client that looks at them again finds no grant of this start."""
        for place in range(KEPT_OF_SESSION_MAX):
            self.set(place, 0)

    def close(self) -> None:
        """Let the shard's side go; the client may still have it."""

    def numbers(self) -> list[int]:
        """Return the numbers of all grants that are said to live."""
        return list(filter(None, self.cells.tolist()))

    # ---------------------------------------------------------------- the client's side

    def mark(self, number: int) -> None:
        """Show that a block uses a grant."""
        self._moment += 1
        self.marks[number] = self._moment

    def unmark(self, number: int) -> None:
        """Show that no block uses it any more."""
        self.uses.discard(number)
        if self.marks.pop(number, None) is not None:
            self.freed_ns[number] = self._now()

    def vanish(self) -> None:
        """Free all marks, as the kernel does when a process ends or closes the file."""
        for number in list(self.marks):
            self.unmark(number)

    def lives(self, place: int, number: int) -> bool:
        """Whether a grant is not over."""
        return bool(self.cells[place] == number)


class SimulatedMarks(ShardMarks):
    """The pages of one start of a shard.

    Args:
        epoch: Of that start.
        between: Lets a client go on that stands between two steps.
        now: Returns true time.

    Attributes:
        made: Each page that was ever made, by its session.
        gone: The folder was removed, so no page can be opened any more.
    """

    def __init__(self, epoch: int, between: Callable[[str], None], now: Callable[[], int]) -> None:
        super().__init__(cast("SharedFolder", _NoFolder()))
        self.epoch, self._between, self._now = epoch, between, now
        self.made: dict[str, SimulatedPage] = {}
        self.gone = False

    def _made(self, session: str) -> SimulatedPage:
        page = self.made[session] = SimulatedPage(lambda: self._between(session), self._now)
        return page

    def sweep(self) -> None:
        """Remove the pages of a start that is over, as the next one does, or a power cut."""
        self.gone = True
        for page in self.made.values():
            page.wipe()


class _NoFolder:
    """What stands for a shard's shared folder: its pages are in plain memory."""

    descriptor = files = -1


class _Shared:
    """The shared folder of one start of a shard, as one client has it."""

    __slots__ = ("epoch", "keeps", "marks", "page")

    def __init__(self, epoch: int, marks: SimulatedMarks | None) -> None:
        self.epoch, self.marks = epoch, marks
        self.page: SimulatedPage | None = None
        self.keeps = marks is not None


class KeptLocks:
    """What a client does with the grants that it keeps, as `link.client.locks` does it.

    Attributes:
        looked: Called when a cell says that a grant lives.
        stands: Called before a stop between two steps, with what happens next and the shard.
    """

    def __init__(
        self,
        client: Client,
        sight: Sight,
        luck: Random,
        *,
        marks_of: Callable[[str], SimulatedMarks | None],
        now: Callable[[], int],
        say: Callable[[str, Release], None],
    ) -> None:
        self._client, self._luck, self._sight = client, luck, sight
        self._marks_of, self._now, self._say = marks_of, now, say
        self._shards: dict[str, _Shared] = {}
        self.looked: Callable[[KeptGrant, SimulatedPage | None], None] = lambda _grant, _page: None
        self.listens: Callable[[str], None] = lambda _shard: None
        self.stands: Callable[[str], None] = lambda _shard: None

    # ---------------------------------------------------------------- pages

    def learn(self, shard: str, epoch: int) -> None:
        """Take from a WELCOME what the shard shares."""
        known = self._shards.get(shard)
        if known is not None and known.epoch == epoch:
            return
        if known is not None and known.page is not None:
            known.page.vanish()  # closed with its last reference
        marks = self._marks_of(shard) if self._sight in (Sight.HERE, Sight.BLIND) else None
        if marks is not None and (marks.epoch != epoch or marks.gone):
            marks = None
        self._shards[shard] = _Shared(epoch, marks)

    def keeps(self, shard: str) -> bool:
        """Whether a shard may see which of its grants this session uses."""
        shared = self._shards.get(shard)
        return self._sight is Sight.FAR or (shared is not None and shared.keeps)

    def page(self, shard: str, epoch: int) -> SimulatedPage | None:
        """Return this session's page of one start of a shard; None if there is none here."""
        shared = self._shards.get(shard)
        return shared.page if shared is not None and shared.epoch == epoch else None

    def _prove(self, shard: str) -> None:
        shared = self._shards.get(shard)
        if shared is None or not shared.keeps or shared.marks is None:
            return
        page = shared.marks.made.get(self._client.session)
        if page is None or shared.marks.gone or self._sight is Sight.BLIND:
            shared.keeps = False
        elif shared.page is not page:  # a shard that has forgotten this session makes another one
            shared.page = page
            page.mark(PROOF)

    def vanish(self) -> None:
        """The process ends, and its marks with it."""
        for shared in self._shards.values():
            if shared.page is not None:
                shared.page.vanish()

    # ---------------------------------------------------------------- locks

    def _stop(self, shard: str) -> Stop:
        self.stands(shard)
        return Stop(self._luck.choice(STOPS_NS))

    @staticmethod
    def _may_begin(grant: KeptGrant, page: SimulatedPage) -> bool:
        """Look at the cell of a grant whose mark was taken."""
        return page.lives(grant.place, grant.token.number)

    @staticmethod
    def _may_stay(grant: KeptGrant, page: SimulatedPage) -> bool:
        """Look at the cell of a grant whose mark was given back."""
        return page.lives(grant.place, grant.token.number)

    def begin(self, lane: int, items: tuple[Item, ...], *, hold_ns: int) -> Steps:
        """Begin a lock under a kept grant; None if it has to be asked for."""
        grant = self._client.kept.take(items)
        if grant is None:
            return None
        if grant.far:
            return self._begin_far(lane, grant, hold_ns)
        self.stands(grant.shard)
        yield Stop(self._luck.choice(FIRST_STOPS_NS))
        page = self.page(grant.shard, grant.token.epoch)
        if page is None:
            return None
        lock, number, now_ns = None, grant.token.number, self._now()
        page.mark(number)
        yield self._stop(grant.shard)
        if self._may_begin(grant, page):
            page.uses.add(number)
            self.looked(grant, page)
            yield self._stop(grant.shard)
            lock = self._client.begin_kept(lane, grant, now_ns=now_ns, hold_ns=hold_ns)
        if lock is None:
            page.unmark(number)
        return lock

    def _begin_far(self, lane: int, grant: KeptGrant, hold_ns: int) -> MultiLock | None:
        now_ns = self._now()
        lock = self._client.begin_kept(lane, grant, now_ns=now_ns, hold_ns=hold_ns)
        if lock is not None:
            self.looked(grant, None)
        else:
            self._client.kept.give_back(grant)
            self.give_back()
        return lock

    def give_back(self) -> None:
        """Send the releases of far grants."""
        given, self._client.kept.given_back = self._client.kept.given_back, []
        for shard, release in given:
            self._say(shard, release)

    def finish(self, lock: MultiLock) -> Generator[Stop, Any, bool]:
        """End a lock that writes nothing without a call; False if its shard has to be asked."""
        grant = lock.keeping.grant if lock.keeping is not None else None
        if grant is not None and grant.far:
            return lock.finish_kept(self._now())
        page = self.page(grant.shard, grant.token.epoch) if grant is not None else None
        if grant is None or page is None or not self._may_stay(grant, page):
            return False
        yield self._stop(grant.shard)
        return lock.finish_kept(self._now())

    def leave(self, lock: MultiLock) -> Generator[Stop, Any, None]:
        """Give the mark of a block back, and keep its grant if that still lives."""
        keeping, part = lock.keeping, lock.parts[0] if lock.parts else None
        self.give_back()
        if keeping is None or part is None or part.token is None:
            return
        grant, number = keeping.take_grant(), part.token.number
        page = self.page(part.shard, part.token.epoch)
        if page is not None and keeping.begun_ns:
            yield self._stop(part.shard)
            page.unmark(number)
            keeping.begun_ns = 0
        if keeping.said in (PROVE, FAR) and self._sight is Sight.FAR:
            self.listens(part.shard)
        elif keeping.said == PROVE:
            self._prove(part.shard)
        elif page is not None and grant is not None:
            yield self._stop(part.shard)
            if self._may_stay(grant, page):
                yield self._stop(part.shard)
                self._client.kept.put_back(grant)
            else:
                self._say(part.shard, Release(grant.origin))
