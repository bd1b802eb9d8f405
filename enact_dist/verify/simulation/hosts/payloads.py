"""Large data that travel apart from their commits, on a bad network: both ends, and their judge.

Each simulated shard has a real `PayloadHandler`, new with each start.  In some runs it has a
folder, in which clients fill files (`hosts.folders`); otherwise it keeps plain memory.  Clients
bring some of their large data in slices, which are lost, doubled, late and cut off by crashes; some
name a payload of which only a part has come, or nothing.  Whatever happens, a commit has all of its
bytes, and a payload is gone as soon as nothing of its shard shows it any more.  A draft ends with
its session, or, where the session holds no lock, after 30 s of its shard without a slice.

Of a folder: what a commit publishes is what its client has written, and stays that; every file
belongs to a draft or to data that are still shown; what the handler counts is what is there.
"""

from __future__ import annotations

import weakref
from dataclasses import replace
from functools import partial
from random import Random
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.datum import Datum
from enact_dist.core.protocol.messages import Commit, EpochChanged, Prepare, Stage, Staged
from enact_dist.core.protocol.records import Persist, PreparedRecord, SlotRecord
from enact_dist.link.memory.maps import Pages, PlainMemory, leftovers
from enact_dist.link.memory.payload_handler import PayloadHandler
from enact_dist.verify.simulation.hosts.world import MS, Host, S
from enact_dist.wire.limits import PAYLOAD_BYTES_MIN

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from enact_dist.core.protocol.messages import Answer, Request, WriteItem
    from enact_dist.core.protocol.records import Effect
    from enact_dist.core.shard.shard import Shard
    from enact_dist.core.state.tenure import Tenure
    from enact_dist.verify.simulation.hosts.folders import Folder, Folders

BYTES_MAX: Final = 64 << 20
OTHER: Final = "f" * 16
"""A session of which nothing else is simulated."""
NEEDS_NS: Final = tuple(ms * MS for ms in (0, 1, 5, 30, 200))
"""How long after files were made ahead another client needs their room."""
DRAFT_NS: Final = 30 * S
"""A draft of a session without a lock ends when it has had no slice for longer."""


class HostClock:
    """The clocks of a simulated host, as the real parts read them."""

    def __init__(self, host: Host) -> None:
        self._host = host

    def monotonic_ns(self) -> int:
        """Return what its steady clock shows."""
        return self._host.local_ns

    def wall_ns(self) -> int:
        """Return what its wall clock shows."""
        return self._host.wall_ns


class ShardPayloads:
    """The payloads of one life of a shard, and who may still hold them."""

    def __init__(
        self,
        host: Host,
        shard: Shard,
        is_unused: Callable[[Tenure], bool],
        folders: Folders,
        folder: Folder | None,
    ) -> None:
        self._world, self._shard, self._host = host.world, shard, host
        self._is_unused = is_unused
        self._written, self._folder, self._folders = folders.written, folder, folders
        self._needs = self._world.schedule.place(f"{host.name}-room")
        bytes_max = BYTES_MAX if folder is None else folders.bytes_max
        self.handler = PayloadHandler(folder, bytes_max, firm=folders.firm, clock=HostClock(host))
        self._adopted: dict[str, weakref.ref[Pages | PlainMemory]] = {}
        self._drafts: dict[str, tuple[str, int, int]] = {}
        """Of each draft its session, its first and its newest slice, by the shard's clock."""

    def stage(self, message: Stage) -> Answer:
        """Take a slice, as the shard's link does."""
        if message.total and message.session not in self._shard.state.sessions.by_id:
            return EpochChanged(self._shard.epoch)
        self._world.tally["slices staged"] += 1
        answer = self.handler.stage(message)
        file, now_ns = message.file, self._host.local_ns
        if not message.total:
            self._world.tally["drafts dropped"] += self._drafts.pop(file, None) is not None
        elif isinstance(answer, Staged) and file in self.handler.drafts():
            _, begun_ns, _ = self._drafts.get(file, ("", now_ns, now_ns))
            self._drafts[file] = message.session, begun_ns, now_ns
        return answer

    def with_bodies(self, message: Request) -> Request:
        """Put in what a commit names, as the shard's link does."""
        if not isinstance(message, Commit | Prepare):
            return message
        bare = tuple(_as_in_a_frame(write) for write in message.writes)
        message = replace(message, writes=bare)
        found: Commit | Prepare
        if isinstance(message, Commit):
            found = self.handler.with_bodies(message)
        else:
            found = self.handler.with_bodies(message)
        for before, after in zip(message.writes, found.writes, strict=True):
            memory = _memory_of(after.datum)
            if before.datum is None or not before.datum.file or memory is None:
                continue
            known = self._adopted.get(before.datum.file)
            again = known is not None and known() is memory
            self._world.tally["payloads adopted again" if again else "payloads adopted"] += 1
            self._adopted[before.datum.file] = weakref.ref(memory)
            if message.token.epoch == self._shard.epoch:  # else it is refused, whatever it names
                self._check_written(before.datum.file, after.datum)
            _, begun_ns, _ = self._drafts.pop(before.datum.file, ("", self._host.local_ns, 0))
            late = self._host.local_ns - begun_ns > DRAFT_NS
            self._world.tally["payloads adopted after a long time"] += late
        return found

    def _check_written(self, file: str, datum: Datum | None) -> None:
        written = self._written.get(file)
        if written is not None and (datum is None or datum.body != written):
            self._world.violation("a commit publishes what its client wrote", file)

    def make_ahead(self) -> None:
        """Make files that clients will ask for, as the shard's link does after an answer."""
        if self._folder is not None:
            self._folder.ahead = True
            self.handler.make_ahead()
            self._folder.ahead = False
            bits, fault = self._needs.next(), self._needs.fault
            needed = (bits & 0xFFFF) < self._folders.needed * 0x10000
            if needed and self._world.schedule.allows(fault):
                luck = Random(bits)
                delay_ns = luck.choice(NEEDS_NS)
                self._host.later(delay_ns, partial(self._need_room, fault, luck))

    def _need_room(self, fault: str, luck: Random) -> None:
        """Let another client ask for room that files ahead have, and give it up at once."""
        figures, size = self.handler.figures(), PAYLOAD_BYTES_MIN + 1
        if figures["files_ahead"]:
            files = luck.randint(1, figures["files_ahead"])
            total = figures["payload_bytes_max"] - figures["payload_bytes"] + files * size
            self._world.befell(fault, f"{files} files ahead of {self._host.name} make room")
            file = f"{OTHER}-{fault.rpartition('.')[2]}"
            self.handler.stage(Stage(OTHER, file, 0, total, Datum(b"", b"", 0)))
            self.handler.drop(file)
            leftovers().wait(60.0)  # a large file is freed by a thread

    def look(self) -> None:
        """Give up drafts as the shard's link does at each tick: those that must end, no others."""
        state, now_ns = self._shard.state, self._host.local_ns
        sessions, before = state.sessions.by_id, self._holders()
        self.handler.sweep(sessions.__contains__, state.tenures.works)
        left, after = self.handler.drafts(), self._holders()
        for file in left:
            if file in self._adopted:
                self._world.violation("a payload is made once", file)
        for file, (session, _, newest_ns) in list(self._drafts.items()):
            if session not in sessions:
                over = "drafts end with their session"
            elif now_ns - newest_ns <= DRAFT_NS or session in before & after:
                over = ""
            elif session in before | after and file in left:
                over = ""  # its client went on while the shard looked
            else:
                over = "drafts end after a time without a slice"
                self._world.tally["drafts given up for want of slices"] += 1
            if over and file in left:
                self._world.violation(over, file)
            if not over and file not in left and not self.handler.counters.get("drafts_displaced"):
                self._world.violation("a draft stays while its client may commit it", file)
            if over or file not in left:
                del self._drafts[file]
        for file, session in left.items():
            if session not in sessions:
                self._world.violation("drafts end with their session", file)
        self._check_folder(left)

    def _check_folder(self, drafts: Iterable[str]) -> None:
        """A folder has the files that may still be used, and as many as are counted."""
        if self._folder is None:
            return
        names, figures = self._folder.names(), self.handler.figures()
        held = {file for file, adopted in self._adopted.items() if adopted() is not None}
        if not names <= held.union(drafts):
            self._world.violation("no file is left", names.difference(held, drafts))
        sizes = self._folder.sizes()
        if (figures["payload_files"], figures["payload_bytes"]) != (len(sizes), sum(sizes)):
            self._world.violation("what is counted is there", figures, sizes)

    def end(self) -> None:
        """End with the process, which closes nothing."""
        figures = self.handler.figures()
        self.tally_counters()
        self._world.tally["files ahead at a crash"] += figures["files_ahead"]
        if self._folder is not None:
            self._folder.abandon()
        self.handler.sweep(lambda _: False, lambda _: False)  # as the kernel takes its memory

    def tally_counters(self) -> None:
        """Add the counters of the handler to the tally of the run."""
        for name, count in self.handler.counters.items():
            self._world.tally[f"handler: {name}"] += count

    def _holders(self) -> set[str]:
        """Return the sessions with a lock, other than kept grants that they do not use."""
        if not self._drafts:
            return set()
        tenures = self._shard.state.tenures.by_lock.values()
        return {tenure.lock.session for tenure in tenures if not self._is_unused(tenure)}

    def check_released(self) -> None:
        """When nothing is under way, a payload lives as long as a slot or a reader shows it."""
        held = set()
        for datum in _shown(self._shard):
            held.add(id(_memory_of(datum)))
            if datum is not None and datum.file:
                self._check_written(datum.file, datum)
        self.handler.sweep(lambda _: False, lambda _: False)
        self._check_folder(())
        for file, adopted in self._adopted.items():
            memory = adopted()
            if memory is None:
                self._world.tally["payloads released"] += 1
            elif id(memory) not in held:
                self._world.violation("a payload ends with its last holder", file)
            else:
                self._world.tally["payloads held to the end"] += 1


def _as_in_a_frame(write: WriteItem) -> WriteItem:
    """Leave out the bytes of a datum that names a payload, as its frame does."""
    datum = write.datum
    if datum is None or not datum.file:
        return write
    return write._replace(datum=replace(datum, body=b""))


def _memory_of(datum: Datum | None) -> Pages | PlainMemory | None:
    body = None if datum is None else datum.body
    if isinstance(body, memoryview) and isinstance(body.obj, Pages | PlainMemory):
        return body.obj
    return None


def _shown(shard: Shard) -> Iterator[Datum | None]:
    """Yield all data that an idle shard can still show."""
    slots = shard.state.slots
    for column in slots.columns():
        for slot, content in slots.matching(column, "**"):
            yield content.datum
            found = slots.history.of(slot)
            if found is not None:
                yield from (old.datum for old in found.states)
                yield from (kept.content.datum for kept in found.kept.values())
    for lock in shard.state.pins:
        yield from shard.state.pins.get(lock).values()


def copied(datum: Datum | None) -> Datum | None:
    """Return a datum that holds on to no payload: what a disk or a judge keeps."""
    if datum is None or _memory_of(datum) is None:
        return datum
    return replace(datum, body=bytes(datum.body))


def as_kept(effect: Effect) -> Effect:
    """Return what a disk keeps of an effect; others stay as they are."""
    if not isinstance(effect, Persist):
        return effect
    records = list(effect.records)
    for index, record in enumerate(records):
        if isinstance(record, SlotRecord) and _memory_of(record.datum) is not None:
            records[index] = replace(record, datum=copied(record.datum))
        elif isinstance(record, PreparedRecord) and any(_memory_of(w.datum) for w in record.writes):
            writes = tuple(write._replace(datum=copied(write.datum)) for write in record.writes)
            records[index] = replace(record, writes=writes)
    if all(one is other for one, other in zip(records, effect.records, strict=True)):
        return effect
    return replace(effect, records=tuple(records))
