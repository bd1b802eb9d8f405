"""Entities move between the folders of a stopped cell: nothing is lost, nothing there twice."""

import os
import shutil
import signal
import time
from types import SimpleNamespace

import pytest
from rebalance_cells import ENTITIES, LATE, POSE, StoppedCell, placement
from store_writer import fill, persist, slot_record

from enact_dist.core.protocol.datum import LockId, Position, Token
from enact_dist.core.protocol.messages import SlotVersion, WriteItem
from enact_dist.core.protocol.placement import shard_of
from enact_dist.core.protocol.records import (
    DecisionRecord,
    PreparedRecord,
    SessionRecord,
    WorldRecord,
)
from enact_dist.core.shard.state import ShardSettings
from enact_dist.errors import StoreError
from enact_dist.link.folder.folder import refuse_strangers
from enact_dist.link.folder.moving_marks import moving_mark
from enact_dist.link.offline import rebalance as module
from enact_dist.link.offline.rebalance import look, rebalance
from enact_dist.link.opening import open_host
from enact_dist.link.store.store import open_store, read_store

TWO = placement("left", "right")
THREE = placement("left", "right", "third", pins=[("part/0", "third")])


def move(cell, where, **more):
    """Rebalance a cell to another placement, whose shards it has from then on."""
    stays = cell.folders
    cell.where = where
    return rebalance({**stays, **cell.folders}, where, unix_s=int(time.time()), **more)


def stored(cell, folders=None):
    """Return what the folders hold, by what it is about, and on which shard entities are."""
    slots, labels, places = {}, {}, {}
    for shard, folder in (folders or cell.folders).items():
        with read_store(folder) as found:
            for record in (*found.slots, *found.history):
                places.setdefault(record.slot.entity, set()).add(shard)
                body = None if record.datum is None else bytes(record.datum.body)
                known = slots.setdefault((record.slot, record.version), [])
                known.append((record.stamp_ns, body, record.null_reason, record.cause))
            for record in found.kept:
                labels[record.label] = labels.get(record.label, frozenset()) | set(record.versions)
    return slots, labels, places


def bases(cell):
    """Return above which version the slots of each entity started, by context."""
    found = {}
    for folder in cell.folders.values():
        with read_store(folder) as held:
            here = {(record.slot.context, record.slot.entity) for record in held.slots}
            for name, base, moved in (
                (d.name, d.version_base, d.entity_bases) for d in held.dropped
            ):
                starts = {pair: dict(moved).get(pair[1], base) for pair in here if pair[0] == name}
                assert not starts.keys() & found.keys()
                found |= starts
    return found


@pytest.mark.parametrize("seed", [1, 2])
def test_all_is_as_before_and_goes_on(memory, seed):
    """Data, versions, history, labels, causes, forks and the past, to a new shard and back."""
    cell = StoppedCell(memory, TWO)
    cell.fill(seed, rounds=15)
    probes_ns = cell.probes_ns()
    before, _ = cell.shown(probes_ns)
    with cell.opened() as cells:
        epochs = {shard: one.shards()[0].epoch for shard, one in cells.items()}

    moved = move(cell, THREE).moves
    after, places = cell.shown(probes_ns)

    assert {m.target for m in moved} == {"third"}
    assert before == after
    assert places == {entity: {shard_of(entity, THREE)} for entity in places}
    with cell.opened() as cells:
        assert min(one.shards()[0].epoch for one in cells.values()) > max(epochs.values())
        for entity in ENTITIES:
            versions, _ = before["slots"].get(("online", entity, POSE), ([], []))
            last = versions[-1][0][0] if versions else 0
            assert cell.put(cells, "online", entity, 1) == last + 1
    cell.probes_ns()  # a start lets go of what is outside its retention, and of until when it was
    before, _ = cell.shown(probes_ns)
    everywhere = cell.folders
    assert {m.source for m in move(cell, TWO).moves} == {"third"}
    assert cell.shown(probes_ns)[0] == before
    assert not stored(cell, {"third": everywhere["third"]})[0]
    assert move(cell, TWO).moves == []


def test_versions_of_a_dropped_context_are_never_used_again(tmp_path):
    """Neither those that a new shard has never seen, nor of a context that was made again."""
    cell = StoppedCell(tmp_path, TWO)
    cell.fill(3)
    elsewhere = {"left": "right", "right": "left"}[shard_of(LATE.name, TWO)]
    with cell.opened() as cells:
        cells[shard_of(LATE.name, TWO)].create_world("gone")
        gone = cell.put(cells, "gone", LATE, 99)
        cells[shard_of(LATE.name, TWO)].drop_world("gone")
    with cell.opened() as cells:
        for one in cells.values():
            one.create_world("twice")
        last = cell.put(cells, "twice", LATE, 9)
        for one in cells.values():
            one.drop_world("twice")
            one.create_world("twice")
        staying = next(e for e in ENTITIES if shard_of(e.name, TWO) == elsewhere)
        first = cell.put(cells, "twice", staying, 1)

    move(cell, placement("left", "right", pins=[(LATE.name, elsewhere), ("**", elsewhere)]))

    with cell.opened() as cells:
        assert cell.put(cells, "twice", LATE, 1) > last
        assert cell.put(cells, "twice", staying, 1) == first + 1
        cells[elsewhere].create_world("gone")
        assert cell.put(cells, "gone", LATE, 1) > gone


# ---------------------------------------------------------------- cut off


class Killer:
    """Ends its process like kill -9 before the n-th act; counts them."""

    def __init__(self, at):
        self.at, self.acts = at, []

    def act(self, name):
        """Die, if it is time."""
        self.acts.append(name)
        if len(self.acts) == self.at:
            os.kill(os.getpid(), signal.SIGKILL)

    def moved(self, entities, size):
        """Do nothing."""

    def waits(self, wait_s):
        """Do nothing."""


def killed_at(cell, where, number):
    """Rebalance in a child process that is killed at an act; return whether it was."""
    child = os.fork()
    if not child:
        try:
            move(cell, where, progress=Killer(number))
        finally:
            os._exit(0)
    return os.WIFSIGNALED(os.waitpid(child, 0)[1])


def test_killed_at_any_act_it_is_taken_up(memory, monkeypatch):
    """Killed at each act, and once more on the way: then all is where it belongs, once."""
    monkeypatch.setattr(module, "BATCH_STATES", 36)
    origin = StoppedCell(memory / "origin", TWO)
    origin.fill(4, rounds=12)
    slots, labels, _ = stored(origin)
    started = bases(origin)
    assert len(set(started.values())) > 1
    assert all(len(states) == 1 for states in slots.values())
    number, was_killed = 0, True
    while was_killed:
        number += 1
        cell = StoppedCell(memory / f"run{number}", TWO)
        shutil.copytree(origin.folder, cell.folder)
        was_killed = killed_at(cell, THREE, number)
        if was_killed:
            killed_at(cell, THREE, 2 + number % 7)
            move(cell, THREE)
        cell.where = THREE
        found, kept, places = stored(cell)
        assert found == slots, number
        assert kept == labels, number
        assert bases(cell) == started, number
        assert all(where == {shard_of(entity, THREE)} for entity, where in places.items()), number
        assert look(cell.folders, THREE) == ([], False, 0.0)
        shutil.rmtree(cell.folder)
    assert number > 20


def test_a_folder_in_the_midst_of_it_serves_nobody(tmp_path):
    """Its shard does not start, and each folder that takes part is asked for."""
    cell = StoppedCell(tmp_path, TWO)
    cell.fill(5, rounds=4)
    acts = Killer(0)
    move(StoppedCell(shutil.copytree(tmp_path, tmp_path.with_name(f"{tmp_path.name}-copy")), TWO), THREE,
         progress=acts)  # fmt: skip
    first_copy = next(n for n, name in enumerate(acts.acts) if name.startswith("forget"))
    assert killed_at(cell, THREE, first_copy + 1)

    for shard in ("left", "right", "third"):
        with pytest.raises(StoreError, match=r"middle of a rebalance with .*left, right, third"):
            open_store(tmp_path / shard, unix_s=1)
    with pytest.raises(StoreError, match=r"of third; name their folders too, with --store"):
        rebalance({n: tmp_path / n for n in ("left", "right")}, TWO, unix_s=1)

    cell.where = THREE
    assert look(cell.folders, THREE).resumed
    assert move(cell, THREE).resumed
    open_store(tmp_path / "third", unix_s=1)[0].close()


# ---------------------------------------------------------------- what is refused


def two_stores(tmp_path, **records):
    """Make two folders with these records each; return them."""
    folders = {name: tmp_path / name for name in ("left", "right")}
    for name, folder in folders.items():
        store, _ = open_store(folder, unix_s=1)
        if name in records:
            store.write([persist(*records[name])])
        store.close()
    return folders


DECISION = DecisionRecord(LockId("ann", 0, 1), Position(5, "left"), ("right",))
HERE = slot_record("part/1", 1)
PROMISE = PreparedRecord(
    LockId("ann", 0, 1), Token(1, 2), (), (WriteItem(HERE.slot, None),),
    (SlotVersion(HERE.slot, 1),), 77, "right", Token(3, 4),
)  # fmt: skip
FORK = WorldRecord("what_if", "online", 7)


@pytest.mark.parametrize(
    ("left", "right", "said"),
    [
        ([DECISION], [], "1 commits over shards are not settled on left: start all shards"),
        ([HERE], [HERE], "the entity part/1 is on left and right"),
        ([HERE], [slot_record("part/1", 2)], "the entity part/1 is on left and right"),
        ([FORK], [slot_record("part/2", 1)], "the fork what_if of online is not whole, right"),
        ([WorldRecord("a", "b", 1)], [WorldRecord("a")], "context a is another one on right"),
    ],
)
def test_what_would_lose_something_is_refused(tmp_path, left, right, said):
    """Before anything is changed, and with what to do about it."""
    folders = two_stores(tmp_path, left=left, right=right)
    where = placement("left", "right", pins=[("part/1", "left"), ("**", "right")])
    for act in (look, lambda *words: rebalance(*words, unix_s=1)):
        with pytest.raises(StoreError, match=f"nothing was moved: .*{said}"):
            act(folders, where)
    open_store(folders["left"], unix_s=1)[0].close()


@pytest.mark.parametrize("record", [HERE, PROMISE])
def test_entities_of_other_shards_are_refused_at_the_start(tmp_path, record):
    """Also those that a commit over shards has written nothing of yet."""
    with read_store(two_stores(tmp_path, left=[record])["left"]) as held:
        refuse_strangers(tmp_path, held, "left", placement("left", "right", pins=[("**", "left")]))
        with pytest.raises(
            StoreError, match=r"on other shards than left: part/1 \(of right\); the shard"
        ):
            refuse_strangers(tmp_path, held, "left", placement("left", "right", pins=[("**", "right")]))  # fmt: skip


def test_a_look_changes_nothing(tmp_path):
    """Not even a folder for a new shard, made by hand, is anything but empty."""
    folders = two_stores(tmp_path, left=[HERE])
    epochs = {name: stored_epoch(folder) for name, folder in folders.items()}
    folders["third"] = tmp_path / "third"
    folders["third"].mkdir()
    where = placement("left", "right", "third", pins=[("**", "third")])
    assert [move.target for move in look(folders, where).moves] == ["third"]
    assert not any(folders.pop("third").iterdir())
    assert {name: stored_epoch(folder) for name, folder in folders.items()} == epochs


def stored_epoch(folder):
    """Return the epoch that a folder has."""
    with read_store(folder) as found:
        return found.epoch


def test_a_folder_in_use_is_refused(tmp_path):
    """By a daemon, say."""
    folders = two_stores(tmp_path)
    store, _ = open_store(folders["right"], unix_s=1)
    for act in (look, lambda *words: rebalance(*words, unix_s=1)):
        with pytest.raises(StoreError, match=r"right is in use by process"):
            act(folders, TWO)
    store.close()


def test_leases_of_before_the_stop_end_first(tmp_path, monkeypatch):
    """A client that was cut off in a lock may believe in it for a TTL; no shard starts until then."""
    folders = two_stores(tmp_path, left=[HERE, SessionRecord("ann", 600_000_000_000)])
    slept_s = []

    def slept(wait_s):
        slept_s.append(wait_s)
        for folder in folders.values():
            assert moving_mark(folder) is not None

    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=time.monotonic, sleep=slept))
    started_s = time.monotonic()
    found = rebalance(folders, placement("left", "right", pins=[("**", "right")]), unix_s=1)
    took_s = time.monotonic() - started_s

    assert slept_s == [found.waited_s]
    assert 600.0 - took_s <= found.waited_s <= 600.0
    assert [moving_mark(folder) for folder in folders.values()] == [None, None]


def test_a_renamed_shard_starts_with_a_warning_that_names_its_old_folder(tmp_path, caplog):
    """Once: its data seemed to be gone, and nothing said where they are."""
    for name in ("left", "left.replaced-17", "main"):
        fill(tmp_path / name, 1)
    (tmp_path / "notes").mkdir()
    for _ in range(2):
        open_host(ShardSettings("right", TWO), tmp_path / "right").close()

    (told,) = (line for line in caplog.messages if "does not name" in line)
    assert told.endswith(f"enact shard rebalance --store main={tmp_path / 'main'}")
