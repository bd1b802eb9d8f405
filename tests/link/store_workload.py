"""A shard with a real store on a folder, driven by a seed; says on the way what it promised.

As a program: ``python store_workload.py FOLDER SAID BOOT SEED UNIX_S STEPS END`` runs until `STEPS`
acts are done, then kills itself or (END is ``close``) closes the store.  SAID gets one pickle per
`write` call: (kind, content), see `Driver.say`.  BOOT is a file that stands for the system's boot
id, UNIX_S what the wall clock says at the start; a further argument names an edit of `WRONG`.

All of it runs in one thread, so that a trace of its system calls is in the order of what happened.
"""

import os
import pickle
import random
import signal
import sys
from dataclasses import replace
from pathlib import Path

from enact_dist.core.protocol.datum import Datum, LockId, Position, Slot, Token
from enact_dist.core.protocol.messages import (
    RESOLVED_ABORTED,
    RESOLVED_COMMITTED,
    Acquire,
    AspectEntry,
    Break,
    Commit,
    DropWorld,
    Finish,
    Finished,
    ForceAbort,
    Fork,
    Goodbye,
    Granted,
    Hello,
    Item,
    KeepVersions,
    ListLocks,
    PlacementMap,
    Prepare,
    Register,
    Release,
    Resolve,
    Resolved,
    ShardEntry,
    SlotVersion,
    WriteItem,
)
from enact_dist.core.protocol.records import (
    Call,
    Called,
    Persist,
    Persisted,
    Reply,
    SlotRecord,
    Tick,
)
from enact_dist.core.shard.shard import Shard
from enact_dist.core.shard.state import ShardSettings
from enact_dist.link.folder import mark as store_mark
from enact_dist.link.folder.blobs import BlobFolder
from enact_dist.link.folder.mark import MarkFile
from enact_dist.link.store import medium as store_module
from enact_dist.link.store.database import Database
from enact_dist.link.store.states import States
from enact_dist.link.store.store import open_store
from enact_dist.terms import Access

ASPECTS = {"kept": "durable", "swift": "os", "volatile": "volatile"}
RETAINED = {"kept": 2, "swift": 3, "volatile": 3}
SETTINGS = ShardSettings(
    "s0",
    PlacementMap(1, (ShardEntry("s0", ()), ShardEntry("s1", ())), ()),
    worlds=("online",),
    aspects=tuple(AspectEntry(name, "", ASPECTS[name], RETAINED[name]) for name in ASPECTS),
)
LOG_BYTES = 150_000
"""The log is carried into the database and begun anew this often, many times in one run."""
SIZES = (0, 40, 300, 2_000, 9_000, 66_000)
ENTITIES = 5
FORKS_MAX = 3
PROMISING = {"Committed", "Prepared", "Welcome", "Finished", "Forked", "Dropped", "Kept"}
"""The answers that promise something."""
FAR_TOKEN = Token(7, 7)


def flat_datum(datum):
    """Return a datum with its body as bytes."""
    return None if datum is None else replace(datum, body=bytes(datum.body), fault=None)


def flat_record(record):
    """Return a record that can be pickled and compared."""
    if isinstance(record, SlotRecord):
        return replace(record, datum=flat_datum(record.datum))
    if hasattr(record, "writes"):
        writes = tuple(WriteItem(write.slot, flat_datum(write.datum)) for write in record.writes)
        return replace(record, writes=writes)
    return record


class Driver:
    """One run of the shard."""

    def __init__(self, folder, said, seed, unix_s, opened=None):
        self.rng = random.Random(seed)
        self.said = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        self.store, recovered = opened or open_store(folder, unix_s=unix_s)
        self.now_ns, self.wall_ns = 10**9, unix_s * 10**9
        self.say("opened", recovered.epoch)
        self.shard = Shard(SETTINGS, recovered, now_ns=self.now_ns, wall_ns=self.wall_ns)
        self.epoch = recovered.epoch
        self.queue, self.calls, self.replies = [], [], {}
        self.handles = 0
        self.seq = 0
        self.sessions = [record.session for record in recovered.sessions]
        self.prepared = [record.lock for record in recovered.prepared]
        self.given_up = [record.lock for record in recovered.forced]
        self.unanswered = []
        for session in self.sessions:
            self.send(Hello(session, self.epoch, 10**10, "a", "h", 1, False))

    def say(self, kind, content=None):
        """Tell the test what happened, in the order of the system calls around it."""
        os.write(self.said, pickle.dumps((kind, content)))

    # ---------------------------------------------------------------- messages and effects

    def send(self, message):
        """Hand a request to the shard; return its answer if it comes at once."""
        self.handles += 1
        self.unanswered.append((self.handles, message))
        self.perform(self.handle(message, self.handles))
        return self.replies.get(self.handles)

    def handle(self, message, handle=0):
        return self.shard.handle(message, reply_to=handle, now_ns=self.now_ns, wall_ns=self.wall_ns)

    def perform(self, effects):
        for effect in effects:
            if isinstance(effect, Persist):
                self.queue.append(effect)
            elif isinstance(effect, Call):
                self.calls.append(effect)
            elif isinstance(effect, Reply):
                self.replies[effect.reply_to] = effect.answer
                asked = dict(self.unanswered).get(effect.reply_to)
                if type(effect.answer).__name__ in PROMISING:
                    self.say("answer", (flat_record(asked), effect.answer))

    def flush(self):
        """Write what is queued as one batch, as the store thread does, and report it."""
        batch, self.queue = self.queue, []
        if not batch:
            return
        flat = [(p.durability, [flat_record(record) for record in p.records]) for p in batch]
        self.say("begun", flat)
        self.store.write(batch)
        self.say("kept")
        for persist in batch:
            if persist.ticket:
                self.perform(self.handle(Persisted(persist.ticket)))
        self.store.rest()

    # ---------------------------------------------------------------- acts

    def run(self, steps):
        acts = {
            self.commit: 10,
            self.commit_large: 3,
            self.prepare: 4,
            self.decide: 4,
            self.hear: 4,
            self.fork: 3,
            self.drop: 1,
            self.keep: 3,
            self.hello: 1,
            self.goodbye: 1,
            self.break_one: 1,
            self.later: 2,
            self.much_later: 1,
        }
        for aspect in ("kept", "kept", "kept", "swift"):
            self.commit_large(aspect)
            self.flush()
        for act in (self.fork, self.keep):
            act()
            self.flush()
        for _ in range(steps):
            (act,) = self.rng.choices(list(acts), list(acts.values()))
            act()
            if self.rng.random() < 0.6:
                self.flush()
        self.flush()

    def session(self):
        """Return some session."""
        if not self.sessions:
            self.hello()
            self.flush()
        return self.rng.choice(self.sessions)

    def worlds(self):
        """Return the world contexts that there are."""
        return list(self.shard.state.catalogue.worlds)

    def acquire(self, slots):
        """Lock slots; return the grant, None where they are not free."""
        self.seq += 1
        seq = self.epoch * 10_000 + self.seq
        lock = LockId(self.session(), self.rng.randrange(2), seq)
        items = tuple(Item(int(Access.WRITE), *slot) for slot in slots)
        granted = self.send(Acquire(lock, self.epoch, 1, 0, items, 0, 10**11, 0))
        if isinstance(granted, Granted):
            return granted
        self.send(Release(lock))
        return None

    def some_slots(self, count):
        names = [(e, a) for e in range(ENTITIES) for a in ASPECTS]
        world = self.rng.choice([*self.worlds(), "online", "online"])
        return [Slot(world, f"e{e}", a) for e, a in self.rng.sample(names, count)]

    def writes(self, slots):
        return tuple(WriteItem(slot, self.datum()) for slot in slots)

    def datum(self):
        if self.rng.random() < 0.15:
            return None
        (size,) = self.rng.choices(SIZES, (3, 3, 3, 3, 3, 1))
        return Datum(self.rng.randbytes(5), self.rng.randbytes(size), size, self.rng.randrange(99))

    def commit(self):
        """Commit, one in three times for another shard too."""
        slots = self.some_slots(self.rng.randrange(1, 4))
        granted = self.acquire(slots)
        if granted is None:
            return
        far = ("s1",) if self.rng.random() < 0.3 else ()
        writes = self.writes(slots)
        self.send(Commit(granted.lock, granted.token, writes, 0, participants=far))

    def commit_large(self, aspect=""):
        """Commit a body in a file: one that a power cut may take, or one that it may not."""
        slot = Slot("online", "e0", aspect or self.rng.choice(("swift", "swift", "kept")))
        granted = self.acquire([slot])
        if granted is not None:
            datum = Datum(b"large", self.rng.randbytes(SIZES[-1]), SIZES[-1])
            self.send(Commit(granted.lock, granted.token, (WriteItem(slot, datum),), 0))

    def prepare(self):
        """Prepare for another shard's decision."""
        slots = self.some_slots(self.rng.randrange(1, 3))
        granted = self.acquire(slots)
        if granted is None:
            return
        writes = self.writes(slots)
        self.send(Prepare(granted.lock, granted.token, writes, 0, (), "s1", FAR_TOKEN))
        self.flush()
        self.prepared.append(granted.lock)

    def decide(self):
        """Let the other shard say what became of something prepared here, or give it up."""
        if not self.prepared:
            return
        lock = self.prepared.pop(self.rng.randrange(len(self.prepared)))
        how = self.rng.random()
        if how < 0.5:
            self.send(Finish(lock, Position(self.wall_ns, "s1")))
        elif how < 0.8:
            self.resolve(lock, RESOLVED_COMMITTED if how < 0.6 else RESOLVED_ABORTED)
        else:
            for holder in self.send(ListLocks()).holders:
                if holder.lock == lock:
                    self.send(ForceAbort(holder.number, "test"))
                    self.given_up.append(lock)

    def resolve(self, lock, kind):
        answer = Resolved(lock, kind, Position(self.wall_ns, "s1"))
        self.perform(self.handle(Called("s1", Resolve(lock, FAR_TOKEN, "s0"), answer)))

    def hear(self):
        """Let the other shard answer what it was told or asked."""
        if self.given_up and self.rng.random() < 0.3:
            lock = self.given_up.pop()
            self.resolve(lock, self.rng.choice((RESOLVED_COMMITTED, RESOLVED_ABORTED)))
        calls, self.calls = self.calls, []
        for call in calls:
            if isinstance(call.request, Finish):
                finished = Finished(call.request.lock)
                self.perform(self.handle(Called(call.shard, call.request, finished)))

    def fork(self):
        """Fork a context as of now, or of a while ago."""
        if len(self.worlds()) > FORKS_MAX:
            self.drop()
        source, name = self.rng.choice(self.worlds()), f"fork{self.epoch}-{self.handles}"
        at_ns = self.shard.state.stamps.last_ns - self.rng.choice((0, 0, 10**8))
        if at_ns > 0:
            self.send(Fork(self.session(), name, source, at_ns))

    def drop(self):
        """Drop a context that is not in the configuration."""
        others = [world for world in self.worlds() if world not in SETTINGS.worlds]
        if others:
            self.send(DropWorld(self.session(), self.rng.choice(others)))

    def keep(self):
        """Keep the newest versions of some slots under a label, or let go of it."""
        slots = self.some_slots(3) if self.rng.random() < 0.8 else []
        newest = [SlotVersion(slot, self.shard.state.slots[slot].version) for slot in slots]
        versions = tuple(version for version in newest if version.version)
        self.send(KeepVersions(self.session(), self.rng.choice("xy"), versions))

    def hello(self):
        name = f"session{len(self.sessions)}-{self.epoch}-{self.handles}"
        self.send(Hello(name, 0, 10**10, "a", "h", 1, False))
        # What it registers goes to the disk with its record.
        self.shard.state.sessions.by_id[name].present = True
        aspects = tuple(AspectEntry(a, "int", durability) for a, durability in ASPECTS.items())
        self.send(Register(name, ("online", f"w{self.rng.randrange(3)}"), aspects))
        self.flush()
        self.sessions.append(name)

    def goodbye(self):
        if len(self.sessions) > 1:
            self.send(Goodbye(self.sessions.pop(self.rng.randrange(len(self.sessions)))))

    def break_one(self):
        granted = self.acquire(self.some_slots(1))
        if granted is None:
            return
        for holder in self.send(ListLocks()).holders:
            if holder.lock == granted.lock:
                self.send(Break(holder.number, "test"))

    def later(self):
        self.now_ns += 10**8
        self.wall_ns += 10**8
        self.perform(self.handle(Tick()))

    def much_later(self):
        """Let a day pass: outcomes of sessions that ended are forgotten then."""
        self.wall_ns += 25 * 3600 * 10**9


def _not_forced(commit):
    return lambda self, rows, gone, *, forced: commit(self, rows, gone, forced=forced and False)


def _names_not_forced(_sync_names):
    return lambda _self: None


def _body_not_forced(write):
    return lambda self, body, *, durable: write(self, body, durable=False)._replace(synced=durable)


def _not_forced_later(_force):
    return lambda _self, blob: blob._replace(synced=True)


def _gone_with_the_first(_last):
    return lambda _self, _name: True


def _unlinked_early(discard):
    return lambda self, replaced, *, forced: discard(self, replaced, forced=forced or True)


def _marked_early(note):
    return lambda self, batch, *, forced: note(self, batch + 1, forced=forced)


WRONG = {
    "durable commits are not forced": (Database, "commit", _not_forced),
    "names of large bodies are not forced": (BlobFolder, "sync_names", _names_not_forced),
    "large bodies are not forced": (BlobFolder, "write", _body_not_forced),
    "the file of a fork is not forced": (BlobFolder, "force", _not_forced_later),
    "a file goes with its first row": (States, "_last", _gone_with_the_first),
    "a replaced body is unlinked early": (store_module.FolderMedium, "_discard", _unlinked_early),
    "the mark runs ahead of the disk": (MarkFile, "note", _marked_early),
}
"""Wrong edits of the store: what they replace, and by what."""


def main(folder, said, boot, seed, unix_s, steps, end, wrong=""):
    if wrong:
        owner, name, edit = WRONG[wrong]
        setattr(owner, name, edit(getattr(owner, name)))
    store_module.LOG_BYTES = LOG_BYTES
    store_mark._BOOT_ID = Path(boot)
    driver = Driver(Path(folder), said, int(seed), int(unix_s))
    driver.run(int(steps))
    if end == "close":
        driver.store.close()
        driver.say("closed")
    else:
        os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    main(*sys.argv[1:])
