"""What the simulated threads do: small locks of every kind on few slots, so that they collide.

Every write sets a slot to one more than was read under the same lock, and names its lock in the
body; every creation looks for its label first.  So a lost update or a phantom shows at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from random import Random
from typing import TYPE_CHECKING

from enact_dist.core.client.lock import MultiLock
from enact_dist.core.client.plan import AwaitedNews, Phase, Reading
from enact_dist.core.protocol.datum import Datum, Slot
from enact_dist.core.protocol.messages import (
    AspectEntry,
    DatumRead,
    Fetch,
    Gone,
    Item,
    Slice,
    SlotVersion,
    WriteItem,
)
from enact_dist.core.protocol.placement import shard_of
from enact_dist.terms import Access
from enact_dist.verify.simulation.cells import CONTEXTS
from enact_dist.verify.simulation.data import datum_of, label_of, value_of
from enact_dist.verify.simulation.hosts.client_host import (
    ClientNode,
    ParallelCalls,
    Sleep,
    Steps,
    Thread,
)
from enact_dist.verify.simulation.hosts.payloads import DRAFT_NS
from enact_dist.verify.simulation.hosts.world import MS, S
from enact_dist.verify.simulation.judges.causes import reads_of
from enact_dist.verify.simulation.judges.growth import OLDER
from enact_dist.verify.simulation.judges.history import Entry, RunHistory
from enact_dist.verify.simulation.work import keeping
from enact_dist.verify.simulation.work.captures import Captures, drawn_stamp_ns
from enact_dist.verify.simulation.work.growth import ATTEMPTS_MAX, Growth
from enact_dist.verify.simulation.work.staging import Stager

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.verify.simulation.hosts.world import SimulatedWorld
    from enact_dist.verify.simulation.judges.model import Model

ASPECTS = (
    AspectEntry("count", OLDER, "durable", 6),
    AspectEntry("note", OLDER, "os", 3),
    AspectEntry("frame", OLDER, "volatile", 4),
    AspectEntry("made", "str", "durable"),
)
PLAIN = ("count", "note", "frame")
ENTITIES = ("piece", "bench", "tray/4", "tray/7")
"""They lie on different shards, by twos and on all of three: a test looks after that."""
LABELS = 40
"""Things that creators look for, and create when no other has: about as many as there are looks."""
KINDS = {
    "increment": 26,
    "derive": 14,
    "across": 12,
    "cross": 8,
    "read": 6,
    "view": 8,
    "read each": 7,
    "write each": 4,
    "create": 12,
    "capture": 12,
    "view set": 6,
    "use set": 8,
}
"""What threads do, and how often."""
SETS = ("view set", "use set")
"""Jobs whose views ask for data of one capture stamp."""
LARGE = 64 * 1024 + 1
"""Bytes of a datum that does not travel with the grant."""
WORKS_NS = tuple(ms * MS for ms in (0, 0, 0, 0, 2, 20, 20, 100, 100, 500, 2000))
"""How long a lock may be held before it ends."""


@dataclass(frozen=True, slots=True)
class Job:
    """One thing that a thread does under one lock, with luck of its own."""

    name: str
    kind: str
    items: tuple[Item, ...]
    luck: Random
    wait_ns: int
    hold_ns: int
    work_ns: int
    abandons: bool
    expects: bool
    label: str = ""
    rests_ns: int = 0
    """How long it rests after the first slice of a large datum; with this all data are large."""
    meanwhile: Callable[[], Thread] | None = None
    """What it does besides while it has its lock."""
    after: tuple[DatumRead, ...] = ()
    """What it has seen: its lock waits for news."""
    gives_up: Callable[[], bool] | None = None
    """Whether a lock that waits for news is given up."""


class Workload:
    """Draws jobs and does them."""

    def __init__(
        self,
        world: SimulatedWorld,
        history: RunHistory,
        model: Model,
        *,
        entities: int,
        folders: bool = False,
    ) -> None:
        self._world, self._history, self._model = world, history, model
        self._stager = Stager(world, folders=folders)
        self._captures = Captures(world, model)
        self.growth = Growth(world, model, ASPECTS)
        self._entities = ENTITIES[:entities]
        # With one entity nearly all locks want the same few slots.
        one = world.schedule.stream("the one aspect").choice(PLAIN)
        self._aspects = PLAIN if entities > 1 else (one,)
        self.keepers = keeping.Keepers(world, model, entities=self._entities, aspects=self._aspects)

    # ---------------------------------------------------------------- drawing

    def job(self, name: str, random: Random) -> Job:
        """Draw a job."""
        kind = random.choices(list(KINDS), list(KINDS.values()))[0]
        items = getattr(self, "_" + kind.replace(" ", "_"))(random)
        hold_ns = random.choice((60 * S, 60 * S, 60 * S, 300 * MS, 1500 * MS))
        return Job(
            name,
            kind,
            items,
            random,
            wait_ns=random.choice((0, 200 * MS, 2 * S, 8 * S)),
            hold_ns=hold_ns,
            work_ns=random.choice(WORKS_NS),
            abandons=random.random() < 0.08,
            expects=kind == "cross" or random.random() < (0.1 if kind in SETS else 0.7),
            label=f"package-{random.randrange(LABELS)}",
        )

    def _slot(self, random: Random) -> tuple[str, str, str]:
        return random.choice(CONTEXTS), random.choice(self._entities), random.choice(self._aspects)

    def _increment(self, random: Random) -> tuple[Item, ...]:
        return self._written(random, random.choice((1, 2, 2, 3)))

    def _written(self, random: Random, count: int) -> tuple[Item, ...]:
        """Writes lie on one entity or on several, so on one shard or on several."""
        some = random.choice(([random.choice(self._entities)], self._entities, self._entities))
        slots = {
            (random.choice(CONTEXTS), random.choice(some), random.choice(self._aspects)): None
            for _ in range(count)
        }
        return tuple(Item(Access.WRITE, *slot) for slot in slots)

    def _besides(self, random: Random, items: tuple[Item, ...], access: Access) -> tuple[Item, ...]:
        named = {item[1:4] for item in items}
        slots = {self._slot(random): None for _ in range(random.choice((1, 1, 2)))}
        return tuple(Item(access, *slot) for slot in slots if slot not in named)

    def _derive(self, random: Random) -> tuple[Item, ...]:
        items = self._written(random, 1)
        items += self._besides(random, items, Access.READ)
        return items + self._besides(random, items, Access.VIEW)

    def _cross(self, random: Random) -> tuple[Item, ...]:
        """Write one of two slots and view the other: write skew, if the view is not expected."""
        here, there = random.sample(CONTEXTS, 2)
        one, other = random.choice((self._entities[:1] * 2, random.sample(ENTITIES[:2], 2)))
        if one != other:
            here = there = "online"
        return Item(Access.WRITE, here, one, "count"), Item(Access.VIEW, there, other, "count")

    def _across(self, random: Random) -> tuple[Item, ...]:
        """Write one of two entities and read the other, named in either order."""
        entities = random.sample(ENTITIES, 2)
        access = random.sample((Access.WRITE, Access.READ), 2)
        return tuple(
            Item(how, CONTEXTS[0], entity, "count")
            for how, entity in zip(access, entities, strict=True)
        )

    def _read(self, random: Random) -> tuple[Item, ...]:
        return self._besides(random, (), Access.READ)

    def _view(self, random: Random) -> tuple[Item, ...]:
        views: tuple[Item, ...] = self._besides(random, (), Access.VIEW)
        if random.random() < 0.35:
            each = random.choice((("**", "count"), ("**", "note"), ("tray/*", "frame")))
            views = (Item(Access.VIEW_EACH, random.choice(CONTEXTS), *each),)
        elif random.random() < 0.7:
            views = tuple(
                Item(Access.VIEW, context, entity, "count")
                for context in CONTEXTS
                for entity in self._entities
            )
        return views + self._besides(random, views, Access.READ) if random.random() < 0.5 else views

    def _read_each(self, random: Random) -> tuple[Item, ...]:
        pattern, aspect = random.choice((("made/*", "made"), ("tray/*", "count"), ("**", "frame")))
        each = Item(Access.READ_EACH, random.choice(CONTEXTS), pattern, aspect)
        # What is written may lie in the column that is read (mode SIX of the lock table).
        return (each, *self._written(random, random.choice((0, 1))))

    def _write_each(self, random: Random) -> tuple[Item, ...]:
        pattern, aspect = random.choice((("tray/*", "count"), ("**", "note")))
        return (Item(Access.WRITE_EACH, random.choice(CONTEXTS), pattern, aspect),)

    def _create(self, random: Random) -> tuple[Item, ...]:
        return (Item(Access.WRITE_EACH, random.choice(CONTEXTS), "made/*", "made"),)

    def _of_one_kind(self, random: Random) -> list[tuple[str, str, str]]:
        """Return two or three slots of one aspect."""
        aspect = random.choice(("note", "frame", "frame", "count"))
        slots = [(c, entity, aspect) for c in CONTEXTS for entity in self._entities]
        return random.sample(slots, min(len(slots), random.choice((2, 3))))

    def _capture(self, random: Random) -> tuple[Item, ...]:
        return tuple(Item(Access.WRITE, *slot) for slot in self._of_one_kind(random))

    def _view_set(self, random: Random) -> tuple[Item, ...]:
        return tuple(Item(Access.VIEW, *slot) for slot in self._of_one_kind(random))

    def _use_set(self, random: Random) -> tuple[Item, ...]:
        """Write what is made of a set."""
        made = Item(Access.WRITE, random.choice(CONTEXTS), random.choice(self._entities), "note")
        views = (view for view in self._view_set(random) if view[1:4] != made[1:4])
        return (made, *views)

    def lingering(self, host: ClientNode) -> tuple[Thread, Thread]:
        """Return two threads: one takes its time for a large datum, one gives a draft up."""
        entity = self._entities[0]
        item = Item(Access.WRITE, "online", entity, "frame")
        luck = self._world.schedule.stream("who takes its time")
        name = f"{host.name}/slow"
        job = Job(
            name, "derive", (item,), luck, 8 * S, 60 * S, 0, False, False, rests_ns=DRAFT_NS + S
        )
        shard = shard_of(entity, host.client.placement)
        gives_up = self._stager.given_up(host, shard, datum_of("never committed", size=LARGE))
        return self._once(host, job), gives_up

    def _once(self, host: ClientNode, job: Job) -> Thread:
        if self._world.schedule.begins(job.name):
            yield from self.do(host, 0, job)

    # ---------------------------------------------------------------- doing

    def thread(self, host: ClientNode, lane: int) -> Thread:
        """Do one job after the other until the run winds down."""
        schedule, number = self._world.schedule, 0
        random = schedule.stream(f"work of {host.name} in lane {lane}")
        while not self._world.winding_down:
            yield Sleep(random.choice((0, 5 * MS, 30 * MS, 150 * MS)))
            luck = Random(random.getrandbits(64))
            items, times = self._stager.burst(host, lane, luck) or self.keepers.repeats(luck)
            for again in range(times):
                job = self.job(f"{host.name}/{lane}.{number}", luck)
                if items:
                    job = self._repeated(job, items)
                number += 1
                if schedule.begins(job.name):
                    yield from self.do(host, lane, job)
                else:
                    yield Sleep(job.work_ns + MS)
                if again == times - 1 or self._winds_down():
                    break
                yield Sleep(luck.choice(keeping.RESTS_NS))

    def _winds_down(self) -> bool:
        return self._world.winding_down

    @staticmethod
    def _repeated(job: Job, items: tuple[Item, ...]) -> Job:
        """Return a job like another one that is done once more with the same data."""
        luck = Random(job.luck.getrandbits(64))
        work_ns = luck.choice(keeping.WORKS_NS)
        return replace(job, kind="increment", items=items, luck=luck, work_ns=work_ns)

    def do(
        self, host: ClientNode, lane: int, job: Job, *, lock_views: bool = False, attempt: int = 1
    ) -> Steps[Entry | None]:
        """Do one job under one lock; where its views were of no moment, again with them locked.

        Returns:
            The last lock that it asked for; None if it asked for none.
        """
        client, growth = host.client, self.growth
        newer, lapses = growth.written_newer(host, job.items), host.catalogue.lapses
        if not (yield from growth.compared(host, job.items, newer, job.luck)):
            return None
        items = tuple(self._with_known(host, item) for item in job.items)
        if job.kind in SETS:
            items = yield from self._captures.stamped(host, items, job.luck)
        begun_ns, own = self._world.now_ns, dict(host.own)
        lock = yield from self.keepers.begin(host, lane, job.items, hold_ns=job.hold_ns)
        kept = lock is not None
        if lock is None:
            begun_ns, own = self._world.now_ns, dict(host.own)
            lock = client.begin(
                lane,
                client.plan(items, lock_views=lock_views),
                now_ns=host.local_ns,
                wait_ns=job.wait_ns,
                hold_ns=job.hold_ns,
            )
            if not lock_views:
                self.keepers.may_keep(host, lock, job.items)
            if job.after and len(lock.plan.locks) == 1 and not lock.plan.views:
                lock.news = AwaitedNews(job.after, job.wait_ns)
        entry = Entry(lock, items, job.kind, begun_ns, newer=newer)
        self._history.begin(entry)
        if kept:
            self._model.keeping.begun(entry)
        self._world.tell(job.name, "asks for", *map(told_of, items))
        yield from host.drive(lock, job.gives_up)
        if lock.phase is Phase.HELD:
            self._world.tell(job.name, "has its lock")
            self._model.of_clients.shows_news(entry)
            self._model.of_clients.holds(host, entry)
            self._model.of_clients.shows_own(own, entry)
            fits = host.catalogue.lapses == lapses or (
                yield from growth.compared(host, items, newer, job.luck)
            )
            data = yield from self.data(host, lock)
            growth.shown(newer, (data or {}).values())
            if lock.phase is Phase.HELD and job.work_ns:
                yield Sleep(job.work_ns)
            if job.meanwhile is not None:
                yield from job.meanwhile()
            if data is None or job.abandons or not fits:
                lock.release()
            elif lock.phase is Phase.HELD:
                yield from self._finish(host, entry, job, data)
            yield from host.drive(lock)
        self._stager.ended(host, lock)
        yield from self.keepers.asked_later(host, entry, job.luck)
        self._history.end(entry, now_ns=self._world.now_ns)
        self._world.tell(job.name, "ends as", entry.told.value if entry.told else "-", lock.cause)
        self._model.of_clients.told(host, entry)
        if lock.no_cut:
            self._world.tally["views that became reads"] += 1
            return (yield from self.do(host, lane, job, lock_views=True))
        if (yield from growth.looks_again(host, lock)) and attempt < ATTEMPTS_MAX:
            again = self.do(host, lane, job, lock_views=lock_views, attempt=attempt + 1)
            return (yield from again)
        return entry

    @staticmethod
    def _with_known(host: ClientNode, item: Item) -> Item:
        """Say which version the client still has, as `link.client.fetch` does."""
        slot = Slot(item.context, item.entity, item.aspect)
        known = host.cache.get(slot)
        if known is None or Access(item.access).each:
            return item
        shard, epoch, version, _ = known
        current = host.client.epoch(shard) == epoch
        return item._replace(known=version) if current else item

    # ---------------------------------------------------------------- reading

    def data(self, host: ClientNode, lock: MultiLock) -> Steps[dict[Slot, Datum | None] | None]:
        """Return the datum of each slot read, fetching what did not come with the grant."""
        data: dict[Slot, Datum | None] = {}
        for reading in lock.states:
            state = reading.state
            datum = state.datum
            known = host.cache.get(state.slot)
            if state.same or state.large:
                here = (reading.shard, reading.epoch, state.version)
                if known is not None and known[:3] == here:
                    datum = known[3]
                    self._world.tally["data reused"] += 1
                else:
                    datum = yield from self._fetched(host, lock, reading)
                    if datum is None:
                        return None
            self._model.of_clients.datum_seen(reading, datum)
            data[state.slot] = datum
            if datum is not None:
                host.cache[state.slot] = (reading.shard, reading.epoch, state.version, datum)
        return data

    def _fetched(self, host: ClientNode, lock: MultiLock, reading: Reading) -> Steps[Datum | None]:
        state, mapped = reading.state, host.files.mapped(reading)
        if mapped is not None:
            return mapped
        request = Fetch(lock.lock, reading.epoch, state.slot, state.version, 0, 1 << 20)
        for _ in range(5):
            (answer,) = yield ParallelCalls([(reading.shard, request)])
            if isinstance(answer, Slice):
                self._world.tally["data fetched"] += 1
                stamp_ns, encoding = answer.stamp_ns, answer.encoding
                return Datum(encoding, bytes(answer.body.body), answer.body.size, stamp_ns)
            if isinstance(answer, Gone) and lock.valid(host.local_ns) and lock.parts:
                self._world.violation("what a held lock names stays fetchable", lock.lock, state)
            if answer is not None:
                return None
        return None

    # ---------------------------------------------------------------- writing

    def _finish(
        self, host: ClientNode, entry: Entry, job: Job, data: dict[Slot, Datum | None]
    ) -> Thread:
        lock = entry.lock
        writes: dict[str, list[WriteItem]] = {}
        for slot in self._slots_to_write(job, data):
            shard = shard_of(slot.entity, host.client.placement)
            writes.setdefault(shard, []).append(
                WriteItem(slot, self._datum(entry, job, slot, data))
            )
        if not writes and (yield from host.kept.finish(lock)):
            entry.unasked = True
            self._model.keeping.ended(entry)
            return
        for shard, items in writes.items():
            writes[shard] = yield from self._stager.staged(
                host, shard, items, job.luck, rests_ns=job.rests_ns
            )
        if len(writes) > 1:
            self._world.tally["locks that write on several shards"] += 1
            self._world.tally["locks that write on three shards"] += len(writes) > 2
        expects: list[SlotVersion] = []
        views = {Slot(*item[1:4]) for item in job.items if item.access == Access.VIEW}
        if job.expects and views:
            expects = [
                SlotVersion(reading.state.slot, reading.state.version)
                for reading in lock.states
                if reading.state.slot in views
            ]
            entry.expects = True
        finish_s = job.luck.choice((10, 10, 3))
        lock.finish(
            writes,
            give_up_ns=host.local_ns + finish_s * S,
            expects=expects,
            reads=reads_of(entry),
        )

    def _slots_to_write(self, job: Job, data: dict[Slot, Datum | None]) -> list[Slot]:
        if job.kind == "create":
            if any(datum is not None and label_of(datum) == job.label for datum in data.values()):
                self._world.tally["labels found"] += 1
                return []
            name = f"made/{job.luck.getrandbits(64):016x}"
            return [Slot(job.items[0].context, name, "made")]
        if job.kind == "write each":
            item = job.items[0]
            return [Slot(item.context, found.entity, item.aspect) for found in data]
        return [
            Slot(item.context, item.entity, item.aspect)
            for item in job.items
            if item.access == Access.WRITE
        ]

    def _datum(
        self, entry: Entry, job: Job, slot: Slot, data: dict[Slot, Datum | None]
    ) -> Datum | None:
        random, lock = job.luck, entry.lock
        if job.kind == "create":
            return datum_of(f"{lock.lock}|{job.label}")
        if job.kind == "increment" and random.random() < 0.05:
            return None
        old = data.get(slot)
        value = 1 if old is None else value_of(old) + 1
        share = self._stager.large.get(slot.aspect)
        large = job.rests_ns or (share is not None and random.random() < share)
        datum = datum_of(f"{lock.lock}|{value}", size=LARGE if large else 0)
        encoding = self.growth.encoding(entry.newer, slot)
        stamp_ns = drawn_stamp_ns(random, self._world.now_ns)
        return replace(datum, encoding=encoding, stamp_ns=stamp_ns)


def told_of(item: Item) -> str:
    """Return an item as a story shows it."""
    access = Access(item.access).name.lower().replace("_", " ")
    return f"{access} {item.context}/{item.entity}/{item.aspect}"
