"""History, causes, forks and kept versions in the store: all comes back, and no file is there twice."""

from dataclasses import replace

import pytest
from store_writer import persist, slot_record

from enact_dist.core.protocol.datum import LockId, Slot, Token
from enact_dist.core.protocol.messages import (
    AspectEntry,
    Cause,
    DatumRead,
    Item,
    SlotVersion,
    WriteItem,
)
from enact_dist.core.protocol.records import (
    AspectRecord,
    HistoryForgotten,
    KeptRecord,
    PreparedEnded,
    PreparedRecord,
    SlotRecord,
    WorldDropped,
    WorldRecord,
)
from enact_dist.errors import StoreError
from enact_dist.link.folder import mark as store_mark
from enact_dist.link.store.store import open_store
from enact_dist.terms import Durability, NullReason

SLOT = slot_record("a", 1).slot
FORK = SLOT._replace(context="what_if")
LARGE = 70_000
LOCK = LockId("ann", 3, 4)
CAUSE = Cause(
    LOCK,
    "commit",
    "planner",
    "robot",
    77,
    20,
    5,
    (DatumRead(Slot("online", "camera", "image"), 9, 18),),
    2,
    (SlotVersion(SLOT, 2),),
)


def state(version, *, size=40, slot=SLOT, **more):
    """Return a version of a slot that leaves the one before it in history."""
    record = slot_record("a", version, size=size)
    return replace(record, slot=slot, **{"history": True, **more})


def forked(version, of, *, size=LARGE):
    """Return a version of the fork's slot with the bytes of one of the source's."""
    datum = slot_record("a", of, size=size).datum
    return SlotRecord(FORK, version, 900, datum, "", same_as=SlotVersion(SLOT, of))


class Folder:
    """A data folder that is written, reopened and counted."""

    def __init__(self, path):
        self.path = path
        self.store, self.recovered = open_store(path, unix_s=1)

    def write(self, *records, durability=Durability.DURABLE):
        """Write each record as a batch of its own, and do what waits for it."""
        for record in records:
            self.store.write([persist(record, durability=durability)])
            self.store.rest()

    def reopen(self, *, power_cut=False):
        """Begin anew; return what is recovered."""
        self.store.close()
        if power_cut:
            mark = store_mark.read_mark(self.path)
            file = store_mark.MarkFile.open(self.path, mark.batch)
            file._boot = bytes(range(16))
            file.note(mark.batch, forced=True)
            file.close()
        self.store, self.recovered = open_store(self.path, unix_s=1)
        return self.recovered

    @property
    def log_bytes(self):
        """How long the log is that was never begun anew."""
        return (self.path / "store.db-wal").stat().st_size

    @property
    def files(self):
        """The names of all files of large bodies."""
        return {path.name for path in (self.path / "blobs").iterdir()}


@pytest.fixture
def folder(tmp_path):
    """An open, empty data folder."""
    folder = Folder(tmp_path / "data")
    yield folder
    folder.store.close()


def versions_of(records):
    return [(record.slot, record.version) for record in records]


@pytest.mark.parametrize("size", [40, LARGE])
def test_replaced_states_come_back_oldest_first(folder, size):
    """Each with its body, stamp and reason; the newest apart; null ones are states too."""
    null = SlotRecord(SLOT, 3, 30, None, NullReason.DELETED.name, history=True)
    folder.write(state(1, size=size), state(2, size=size), null, state(4, size=size))

    found = folder.reopen()

    assert versions_of(found.slots) == [(SLOT, 4)]
    assert versions_of(found.history) == [(SLOT, 1), (SLOT, 2), (SLOT, 3)]
    for record in (*found.history[:2], *found.slots):
        wanted = state(record.version, size=size)
        assert bytes(record.datum.body) == wanted.datum.body
        assert (record.stamp_ns, record.history) == (wanted.stamp_ns, False)
    assert found.history[2] == replace(null, history=False)
    assert len(folder.files) == (3 if size == LARGE else 0)


def test_state_that_is_not_to_stay_goes_with_its_file(folder):
    """Without `history` a record replaces as ever; what was history before it stays."""
    folder.write(state(1, size=LARGE), state(2, size=LARGE), state(3, size=LARGE, history=False))
    assert len(folder.files) == 2
    assert versions_of(folder.reopen().history) == [(SLOT, 1)]


def test_forgotten_versions_go_with_their_files(folder):
    """Over a restart too; versions that are not there are no error."""
    folder.write(*(state(version, size=LARGE) for version in range(1, 5)))
    folder.write(HistoryForgotten((SlotVersion(SLOT, 1), SlotVersion(SLOT, 99))))
    assert len(folder.files) == 3
    assert versions_of(folder.reopen().history) == [(SLOT, 2), (SLOT, 3)]
    folder.write(HistoryForgotten((SlotVersion(SLOT, 2), SlotVersion(SLOT, 4))))
    assert versions_of(folder.reopen().history) == [(SLOT, 3)]
    assert len(folder.files) == 2


def test_versions_of_one_batch_are_all_there(folder):
    """A batch of several commits is as many versions; those that it forgets are never written."""
    folder.store.write(
        [
            *(persist(state(version, size=LARGE)) for version in (1, 2, 3, 4)),
            persist(HistoryForgotten((SlotVersion(SLOT, 2),))),
        ]
    )
    assert len(folder.files) == 3
    found = folder.reopen()
    assert versions_of(found.history) == [(SLOT, 1), (SLOT, 3)]
    assert versions_of(found.slots) == [(SLOT, 4)]


def test_volatile_state_is_no_history(folder):
    """What a slot was before its aspect became volatile stays; that it was volatile does not."""
    folder.write(state(1), SlotRecord(SLOT, 2, 20, None, "", volatile=True, history=True), state(1))
    found = folder.reopen()
    assert versions_of(found.history) == versions_of(found.slots) == [(SLOT, 1)]


def test_version_that_is_set_again_replaces_the_one_in_history(folder):
    """Versions start again where an aspect was volatile: the later one of a number counts."""
    folder.write(state(1, size=LARGE), state(2), SlotRecord(SLOT, 0, 0, None, "", volatile=True))
    folder.write(state(1, stamp_ns=500), state(2, stamp_ns=600))
    found = folder.reopen()
    assert [(record.version, record.stamp_ns) for record in found.history] == [(1, 500)]
    assert [(record.version, record.stamp_ns) for record in found.slots] == [(2, 600)]
    assert folder.files == set()


@pytest.mark.parametrize("size", [200, 10_000, 60_000])
def test_update_with_history_writes_as_many_pages_as_one_without(tmp_path, size):
    """A new version takes the place of the one that is forgotten with it; nothing is copied."""
    logs = {}
    for retention in (1, 16):
        folder = Folder(tmp_path / str(retention))
        for version in range(1, 81):
            if version == 41:
                folder.reopen()
                begun = folder.log_bytes
            for name in "abc":
                record = state(version, size=size, slot=SLOT._replace(entity=name))
                old = SlotVersion(record.slot, version - retention)
                records = (replace(record, history=retention > 1), HistoryForgotten((old,)))
                folder.store.write([persist(*records, durability=Durability.OS)])
        logs[retention] = folder.log_bytes - begun
        folder.store.close()
    assert logs[16] < 1.1 * logs[1]


# ---------------------------------------------------------------- causes


def test_cause_comes_back_with_its_version(folder):
    """Newest, replaced and prepared, all fields of it; a version without one has none."""
    folder.write(state(1), state(2, cause=CAUSE), state(3, cause=CAUSE._replace(reads=())))
    prepared = prepared_record(cause=CAUSE)
    folder.write(prepared)
    found = folder.reopen()
    assert [record.cause for record in found.history] == [None, CAUSE]
    assert [record.cause for record in found.slots] == [CAUSE._replace(reads=())]
    assert [record.cause for record in found.prepared] == [CAUSE]


def test_cause_of_several_states_is_stored_once(folder):
    """A commit of n data stores n versions, not n²; it goes with the last state that names it."""
    slots = [SLOT._replace(entity=f"e{number}") for number in range(500)]
    cause = CAUSE._replace(writes=tuple(SlotVersion(slot, 1) for slot in slots))
    folder.store.write([persist(*(state(1, slot=slot, cause=cause) for slot in slots))])
    found = folder.reopen()
    assert {record.cause for record in found.slots} == {cause}
    assert (folder.path / "store.db").stat().st_size < 1 << 20
    kind = "SELECT count(*) FROM record WHERE kind = 14"
    for versions, left in ((2, 1), (3, 0)):
        folder.store.write([persist(*(state(versions, slot=slot) for slot in slots))])
        gone = tuple(SlotVersion(slot, 1) for slot in (slots[1:] if left else slots[:1]))
        folder.store.write([persist(HistoryForgotten(gone))])
        folder.reopen()
        assert folder.store._medium._database._connection.execute(kind).fetchall() == [(left,)]


def test_missing_cause_is_refused(folder):
    """A row that another one names is as needed as that one."""
    records = (state(1, cause=CAUSE), state(1, slot=FORK, cause=CAUSE))
    folder.store.write([persist(*records)])
    folder.store._medium._database._connection.execute("DELETE FROM record WHERE kind = 14")
    with pytest.raises(StoreError, match="the cause of online:a/aspect is missing"):
        folder.reopen()


# ---------------------------------------------------------------- forks and shared files


def test_fork_names_the_file_of_its_source(folder):
    """Of its newest and of a replaced version; the file goes with the last state that names it."""
    folder.write(state(1, size=LARGE), state(2, size=LARGE), forked(1, 1), forked(2, 2))
    assert len(folder.files) == 2
    found = folder.reopen()
    assert {bytes(r.datum.body) for r in found.slots} == {state(2, size=LARGE).datum.body}
    assert found.slots[0].datum.body.obj is found.slots[1].datum.body.obj

    folder.write(HistoryForgotten((SlotVersion(SLOT, 1),)))
    folder.write(replace(state(3), history=False))
    assert len(folder.files) == 1
    (newest,) = [record for record in folder.reopen().slots if record.slot == FORK]
    assert bytes(newest.datum.body) == state(2, size=LARGE).datum.body
    folder.write(WorldDropped("what_if", 2))
    assert folder.files == set()


def test_fork_and_end_of_its_source_in_one_batch(folder):
    """Whichever comes first, the bytes are there: the file stays, or they are written anew."""
    for number, order in enumerate((1, -1), 1):
        source = state(number * 10, size=LARGE)
        folder.write(source)
        fork = forked(number, number * 10)
        end = SlotRecord(SLOT, number * 10 + 1, 99, None, "DELETED")
        folder.store.write([persist(*[fork, end][::order])])
        folder.store.rest()
        assert len(folder.files) == 1
        (found,) = [record for record in folder.reopen().slots if record.slot == FORK]
        assert bytes(found.datum.body) == source.datum.body


def test_fork_of_what_is_made_in_its_batch(folder):
    """Also before anything is written, a file is written once."""
    folder.store.write([persist(state(1, size=LARGE), forked(1, 1))])
    assert len(folder.files) == 1
    assert len(folder.reopen().slots) == 2


@pytest.mark.parametrize("source", [None, state(1), state(1, size=LARGE + 1)])
def test_fork_of_what_is_not_stored_brings_its_bytes(folder, source):
    """A source that is unknown, small or something else: the bytes are written anew."""
    if source is not None:
        folder.write(source)
    folder.write(forked(1, 1))
    (found,) = [record for record in folder.reopen().slots if record.slot == FORK]
    assert bytes(found.datum.body) == state(1, size=LARGE).datum.body


def test_durable_fork_of_an_os_version_forces_its_file(folder, monkeypatch):
    """Nothing is copied, and a power cut must not take it from then on, from the source neither."""
    folder.write(state(1, size=LARGE), durability=Durability.OS)
    forced = []
    monkeypatch.setattr("enact_dist.link.folder.blobs.os.fdatasync", forced.append)
    folder.write(forked(1, 1), forked(2, 1))
    assert len(forced) == 1
    (name,) = folder.files
    end = replace(state(2), history=False)
    folder.write(WorldDropped("what_if", 2), end, durability=Durability.OS)
    assert folder.files == {name}, "the rows that a power cut brings back need it"
    folder.write(WorldRecord("other"))
    assert folder.files == set()


def test_file_that_a_fork_has_forced_must_be_there_after_a_power_cut(folder):
    """It is refused by the fork's name, although its source may lose it."""
    folder.write(state(1, size=LARGE), durability=Durability.OS)
    folder.write(forked(1, 1))
    (path,) = (folder.path / "blobs").iterdir()
    path.unlink()
    with pytest.raises(StoreError, match="cannot be used"):
        folder.reopen(power_cut=True)


def test_os_fork_of_a_durable_version_keeps_the_forced_file_until_all_is_forced(folder):
    """A power cut may bring back the row that named it last."""
    folder.write(state(1, size=LARGE))
    folder.write(forked(1, 1), replace(state(2), history=False), durability=Durability.OS)
    folder.write(WorldDropped("what_if", 1), durability=Durability.OS)
    assert len(folder.files) == 1
    folder.write(WorldRecord("other"))
    assert folder.files == set()


def test_prepared_body_becomes_the_version_that_stays_in_history(folder):
    """The file that was promised is the version's, also once that is replaced."""
    prepared = prepared_record()
    folder.write(prepared)
    promised = folder.files
    written = SlotRecord(SLOT, 1, 80, prepared.writes[0].datum, "", history=True)
    folder.store.write([persist(written, PreparedEnded(LOCK)), persist(state(2))])
    folder.store.rest()
    assert folder.files == promised
    (found,) = folder.reopen().history
    assert bytes(found.datum.body) == prepared.writes[0].datum.body


def prepared_record(cause=None):
    datum = slot_record("a", 1, size=LARGE).datum
    return PreparedRecord(
        LOCK,
        Token(1, 2),
        (Item(2, *SLOT),),
        (WriteItem(SLOT, datum),),
        (SlotVersion(SLOT, 1),),
        77,
        "far",
        Token(3, 4),
        cause,
    )


# ---------------------------------------------------------------- worlds, labels, retention


def test_dropped_world_leaves_only_its_version_base(folder):
    """States, history and the world go; a fork of it stays; made again it begins above."""
    folder.write(WorldRecord("online"), WorldRecord("what_if", "online", 15))
    folder.write(state(1, size=LARGE), state(2), forked(1, 1), WorldDropped("online", 2))
    found = folder.reopen()
    assert found.worlds == [WorldRecord("what_if", "online", 15)]
    assert found.dropped == [WorldDropped("online", 2)]
    assert (versions_of(found.slots), found.history) == ([(FORK, 1)], [])
    assert len(folder.files) == 1
    folder.write(WorldRecord("online"), state(3))
    found = folder.reopen()
    assert len(found.worlds) == 2
    assert found.dropped == [WorldDropped("online", 2)]
    assert sorted(versions_of(found.slots)) == [(SLOT, 3), (FORK, 1)]


def test_labels_and_retention_come_back(folder):
    """A label's last word counts, and without versions it is gone; aspects keep their limits."""
    kept = KeptRecord("evening", (SlotVersion(SLOT, 1), SlotVersion(FORK, 2)))
    aspect = AspectEntry("image", "int", "os", 16, 10**9, 1 << 24)
    folder.write(
        KeptRecord("evening", (SlotVersion(SLOT, 9),)), kept, KeptRecord("x", kept.versions)
    )
    folder.write(KeptRecord("x", ()), AspectRecord(aspect))
    found = folder.reopen()
    assert (found.kept, found.aspects) == ([kept], [aspect])


# ---------------------------------------------------------------- what is checked when


def test_file_of_history_is_checked_when_it_is_asked_for(folder):
    """A start reads no content of history; whoever asks for a damaged one is told its file."""
    folder.write(*(state(version, size=LARGE) for version in (1, 2, 3)))
    (damaged,) = [path for path in (folder.path / "blobs").iterdir() if "-1." in path.name]
    content = bytearray(damaged.read_bytes())
    content[500] ^= 4
    damaged.write_bytes(content)
    found = folder.reopen()
    faults = [record.datum.fault() for record in found.history]
    assert faults == [f"{damaged} is damaged: its checksum is wrong", ""]
    assert [record.datum.fault for record in found.slots] == [None]


@pytest.mark.parametrize("spoil", ["missing", "short"])
def test_file_of_history_must_be_there_at_the_start(folder, spoil):
    """Existence and length are checked at once, and refused by name."""
    folder.write(state(1, size=LARGE), state(2))
    (path,) = (folder.path / "blobs").iterdir()
    path.unlink() if spoil == "missing" else path.write_bytes(b"x")
    with pytest.raises(StoreError, match="holds online:a/aspect, version 1, and cannot be used"):
        folder.reopen()


def test_history_after_a_power_cut_is_checked_whole_where_it_was_not_forced(folder):
    """A file of the right length may hold anything then; its version is null, and its cause stays."""
    folder.write(state(1, size=LARGE, cause=CAUSE), durability=Durability.OS)
    folder.write(state(2))
    (path,) = (folder.path / "blobs").iterdir()
    path.write_bytes(bytes(LARGE))
    lost = SlotRecord(SLOT, 1, 10, None, "LOST", cause=CAUSE)
    assert folder.reopen(power_cut=True).history == [lost]
    assert folder.files == set()
    assert folder.reopen().history == [lost]
