"""Whatever records come in whatever batches, over restarts: a store holds what the ledger says."""

import itertools
import tempfile
from dataclasses import replace
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st
from store_disk import memory_folder
from store_model import State

from enact_dist.core.protocol.datum import Datum, LockId, Position, Slot, Token
from enact_dist.core.protocol.messages import (
    AspectEntry,
    Cause,
    DatumRead,
    Item,
    SlotVersion,
    WriteItem,
)
from enact_dist.core.protocol.records import (
    AspectForgotten,
    AspectRecord,
    AuditRecord,
    BasesMoved,
    DecisionDone,
    DecisionRecord,
    EntitiesMoved,
    ForcedEnded,
    ForcedRecord,
    HistoryForgotten,
    KeptRecord,
    OutcomeRecord,
    Persist,
    PreparedEnded,
    PreparedRecord,
    SessionEnded,
    SessionRecord,
    SlotRecord,
    WorldDropped,
    WorldRecord,
)
from enact_dist.link.store.store import open_store
from enact_dist.terms import Durability

CONTEXTS = ("online", "what_if")
ASPECTS = ("pose", "x")
SLOTS = tuple(Slot(context, *of) for context in CONTEXTS for of in (("a", "pose"), ("b", "x")))
LOCKS = tuple(LockId("session", lane, 1) for lane in range(2))
VERSIONS = tuple(SlotVersion(slot, version) for slot in SLOTS for version in range(1, 4))
LARGE = 66_000
CAUSES = (
    None,
    Cause(LOCKS[0], "commit", "a", "h", 1, 5, 2, (DatumRead(SLOTS[0], 1, 4),), 3, VERSIONS[:2]),
    Cause(LOCKS[1], "fork", "", "", 0, 6, 0, (), 0, ()),
)
_numbers = itertools.count()


class Body(bytes):
    """Bytes that are short to tell."""

    def __repr__(self):
        return f"Body of {len(self)}"


def datum(size):
    """Return a datum like no other."""
    number = next(_numbers)
    return Datum(b"e", Body(number.to_bytes(4, "little") + bytes(size)), size + 4, number)


DATA = st.sampled_from((None, 10, LARGE)).map(lambda size: None if size is None else datum(size))
MANY_VERSIONS = st.lists(st.sampled_from(VERSIONS), max_size=4, unique=True).map(tuple)
STAMPS = st.integers(1, 99)


@st.composite
def states(draw):
    """A state of a slot, of whatever version."""
    slot, stamp_ns = draw(st.sampled_from(SLOTS)), draw(STAMPS)
    history = draw(st.booleans())
    if draw(st.integers(0, 9)) == 0:
        return SlotRecord(slot, 0, 0, None, "", volatile=True, history=history)
    found = draw(DATA)
    reason = "" if found is not None else "DELETED"
    cause = draw(st.sampled_from(CAUSES))
    version = draw(st.integers(1, 3))
    return SlotRecord(slot, version, stamp_ns, found, reason, history=history, cause=cause)


@st.composite
def forks(draw):
    """A state whose datum is to be that of another one, the n-th that is stored by then."""
    number = draw(st.integers(0, 9))
    found = replace(draw(states()), same_as=SlotVersion(SLOTS[0], number))
    return replace(found, volatile=False, version=max(1, found.version))


@st.composite
def prepared(draw):
    """A prepared lock."""
    slots = draw(st.lists(st.sampled_from(SLOTS), unique=True, max_size=3))
    return PreparedRecord(
        draw(st.sampled_from(LOCKS)),
        Token(1, 2),
        (Item(2, *SLOTS[0], 3, 4, nearest=True),),
        tuple(WriteItem(slot, draw(DATA)) for slot in slots),
        tuple(SlotVersion(slot, 1) for slot in slots),
        draw(STAMPS),
        "far",
        Token(3, 4),
        draw(st.sampled_from(CAUSES)),
    )


LOCKED = st.sampled_from(LOCKS)
NAMES = st.sampled_from(("x", "y"))
OLDER = st.sampled_from(((), ("x",), ("y", "x")))
BASES = st.sampled_from(((), (("a", 3),), (("a", 0), ("b", 7))))
STARTS = st.sampled_from(((), (("a", 3, 0),), (("a", 0, 5), ("b", 7, 1 << 62))))
RECORDS = st.one_of(
    *(states() for _ in range(6)),
    *(forks() for _ in range(6)),
    prepared(),
    st.builds(PreparedEnded, LOCKED),
    st.builds(HistoryForgotten, MANY_VERSIONS),
    st.builds(KeptRecord, NAMES, MANY_VERSIONS),
    st.builds(WorldRecord, st.sampled_from(CONTEXTS), NAMES, STAMPS),
    st.builds(WorldDropped, st.sampled_from(CONTEXTS), STAMPS),
    st.builds(AspectForgotten, st.sampled_from(ASPECTS), STAMPS, STAMPS),
    st.builds(BasesMoved, st.builds(WorldDropped, st.sampled_from(CONTEXTS), STAMPS, BASES)),
    st.builds(BasesMoved, st.builds(AspectForgotten, NAMES, STAMPS, STAMPS, STARTS)),
    st.builds(EntitiesMoved, st.sampled_from((("a",), ("b",), ("a", "b"), ("c",)))),
    st.builds(SessionRecord, NAMES, STAMPS),
    st.builds(SessionEnded, NAMES, STAMPS),
    st.builds(
        AspectRecord,
        st.builds(
            AspectEntry, NAMES, NAMES, NAMES, STAMPS, STAMPS, STAMPS, OLDER, reads=st.just(False)
        ),
    ),
    st.builds(OutcomeRecord, LOCKED, st.builds(Position, STAMPS, NAMES), MANY_VERSIONS),
    st.builds(DecisionRecord, LOCKED, st.builds(Position, STAMPS, NAMES), st.just(("s1",))),
    st.builds(DecisionDone, LOCKED),
    st.builds(ForcedRecord, LOCKED, NAMES, st.just(Token(1, 1)), st.just(SLOTS[:2])),
    st.builds(ForcedEnded, LOCKED),
    st.builds(AuditRecord, STAMPS, NAMES, NAMES),
)
PERSISTS = st.tuples(st.sampled_from(Durability), st.lists(RECORDS, max_size=3))
BATCHES = st.lists(
    st.tuples(st.lists(PERSISTS, min_size=1, max_size=3), st.booleans()), min_size=1, max_size=12
)


def at_work(record, state):
    """Return a record as a shard writes it: what it says of another version is so."""
    if not isinstance(record, SlotRecord) or record.same_as is None:
        return record
    ledger = state.ledger
    stored = [*ledger.slots.values(), *ledger.history.values()]
    stored = [found for found in stored if found.datum is not None]
    if not stored:
        return record
    source = stored[record.same_as.version % len(stored)]
    same_as = SlotVersion(source.slot, source.version)
    return replace(record, datum=source.datum, same_as=same_as)


@settings(deadline=None, max_examples=150)
@given(batches=BATCHES)
def test_store_holds_what_the_ledger_says(batches):
    """After each restart; its files are those that its rows name, and no more once all is forced."""
    with tempfile.TemporaryDirectory() as scratch, memory_folder(Path(scratch)) as folder:
        state = State()
        store, _ = open_store(folder / "data", unix_s=1)
        for persists, restarts in (*batches, ((), True)):
            batch = []
            for durability, records in persists:
                for record in records:
                    written = at_work(record, state)
                    batch.append(Persist(1, (written,), durability))
                    state = state.after([(durability, [written])])
            store.write(batch)
            store.rest()
            if restarts:
                store.close()
                store, recovered = open_store(folder / "data", unix_s=1)
                assert not state.difference(recovered)
            files = {path.name for path in (folder / "data" / "blobs").iterdir()}
            named = {blob.name for blob in store._states.blobs.values()}
            assert named <= files
            if restarts or any(persist.durability is Durability.DURABLE for persist in batch):
                assert named == files
        store.close()
