"""Aspects are forgotten in the folders of a stopped cell: whole, for good, and nothing else."""

import shutil

import pytest
from forgotten_cells import (
    GONE,
    NEW_POSE,
    NOW_NS,
    TWO,
    TWO_NAMES,
    Killer,
    killed_at,
    of_aspect,
    put,
    rest_of,
    two_stores,
)
from rebalance_cells import ENTITIES, POSE, StoppedCell, placement
from store_writer import persist, slot_record

from enact_dist import Aspect, Lock, Position, View, Write, local
from enact_dist.core.protocol.datum import LockId, Slot, Token
from enact_dist.core.protocol.messages import AspectEntry, Item, SlotVersion, WriteItem
from enact_dist.core.protocol.placement import shard_of
from enact_dist.core.protocol.records import AspectRecord, DecisionRecord, PreparedRecord
from enact_dist.errors import DatumTypeError, ForgottenError, MisuseError, StoreError
from enact_dist.link.folder.moving_marks import mark, moving_mark
from enact_dist.link.offline.forgetting import forget, look
from enact_dist.link.store.store import open_store, read_store
from enact_dist.terms import Access


def test_an_aspect_goes_with_all_it_has_and_comes_back_of_another_type(tmp_path):
    """Nothing else changes; versions go on above, what was is not known, lineage says so."""
    cell = StoppedCell(tmp_path, TWO)
    cell.fill(1)
    entity, note = ENTITIES[0], Aspect("note", str)
    with cell.opened() as cells:
        last = cell.put(cells, "online", entity, 2)
        online = cells[shard_of(entity.name, TWO)].world("online")
        pose, write = View(online, entity, POSE), Write(online, entity, note)
        with Lock(pose, write) as lock:
            lock[write] = f"from {lock[pose]}"
    before = {name: rest_of(folder) for name, folder in cell.folders.items()}
    there = {name: of_aspect(folder) for name, folder in cell.folders.items()}
    states = [one for folder in cell.folders.values() for one in everything(folder)]
    largest = max(one.version for one in states if one.slot.aspect == "pose")

    found = forget(cell.folders, ["pose"], now_ns=NOW_NS)

    assert {g.shard: (g.type == "list", g.versions, g.kept) for g in found.going} == there
    assert all(versions and kept for _, versions, kept in there.values())
    assert all(of_aspect(folder) == GONE for folder in cell.folders.values())
    assert {name: rest_of(folder) for name, folder in cell.folders.items()} == before
    assert forget(cell.folders, ["pose"], now_ns=NOW_NS).going == []
    with cell.opened() as cells:
        here = cells[shard_of(entity.name, TWO)]
        online = here.world("online")
        assert put(cells, entity, NEW_POSE, "new") == largest + 1
        (newest,) = online.history(entity, NEW_POSE)
        assert newest.position.stamp_ns > NOW_NS
        with pytest.raises(DatumTypeError, match="`enact shard forget pose`"):
            cell.put(cells, "online", entity, 1)
        past = online.at(lock.position)
        for aspect, error in ((NEW_POSE, ForgottenError), (POSE, DatumTypeError)):
            with pytest.raises(error):
                past.view(View(past, entity, aspect))
        causes = here.why(online, entity, note).children
        assert [(c.slot.aspect, c.version, c.kind) for c in causes] == [("pose", last, "forgotten")]
        assert online.fork("copy").history(entity, NEW_POSE)[-1].version > largest


def everything(folder):
    """Return all states of a folder."""
    with read_store(folder) as found:
        return [*found.slots, *found.history]


def test_a_look_changes_nothing(tmp_path):
    """It says the same as is done then."""
    cell = StoppedCell(tmp_path, TWO)
    cell.fill(2, rounds=8)
    rows = {name: everything(folder) for name, folder in cell.folders.items()}
    found = look(cell.folders, ["pose", "swift"])
    assert {name: everything(folder) for name, folder in cell.folders.items()} == rows
    assert {g.aspect for g in found.going} == {"pose", "swift"}
    assert forget(cell.folders, ["pose", "swift"], now_ns=NOW_NS).going == found.going


# ---------------------------------------------------------------- cut off


ACTS = (
    "open left", "open right", "mark left", "mark right", "forget on left", "unlink on left",
    "forget on right", "unlink on right", "unmark left", "unmark right",
)  # fmt: skip
"""What is done, in this order."""


def test_killed_at_any_act_it_is_taken_up(memory):
    """Each shard has all of it or nothing, and serves nobody until a run has come to its end."""
    origin = StoppedCell(memory / "origin", TWO)
    origin.fill(4, rounds=12)
    there = {name: of_aspect(folder) for name, folder in origin.folders.items()}
    rest = {name: rest_of(folder) for name, folder in origin.folders.items()}
    number, was_killed, halves = 0, True, 0
    while was_killed:
        number += 1
        cell = StoppedCell(memory / f"run{number}", TWO)
        shutil.copytree(origin.folder, cell.folder)
        was_killed = killed_at(cell, number)
        found = {name: of_aspect(folder) for name, folder in cell.folders.items()}
        assert all(found[name] in (there[name], GONE) for name in found), number
        if len({one == GONE for one in found.values()}) == 2:
            halves += 1
            for folder in cell.folders.values():
                with pytest.raises(
                    StoreError, match=r"forgetting pose .* pose --shard left --shard right --y"
                ):
                    open_store(folder, unix_s=1)
        if was_killed:
            killed_at(cell, 1 + number % 7)
            forget(cell.folders, ["pose"], now_ns=NOW_NS)
        assert all(of_aspect(folder) == GONE for folder in cell.folders.values()), number
        assert {name: rest_of(folder) for name, folder in cell.folders.items()} == rest, number
        assert [moving_mark(folder) for folder in cell.folders.values()] == [None, None]
        shutil.rmtree(cell.folder)
    assert number > 10
    assert halves


def test_what_came_since_stays_where_only_marks_were_left(tmp_path):
    """A shard that could start has the new type: who lets the others start takes nothing of it."""
    cell = StoppedCell(tmp_path, TWO)
    cell.fill(5, rounds=4)
    copy = StoppedCell(shutil.copytree(tmp_path, tmp_path.with_name("copy")), TWO)
    acts = Killer(0)
    forget(copy.folders, ["pose"], now_ns=NOW_NS, progress=acts)
    assert tuple(acts.acts) == ACTS
    assert killed_at(cell, ACTS.index("unmark right") + 1)
    with local(cell.folders["left"]) as left:
        entity = next(e for e in ENTITIES if shard_of(e.name, TWO) == "left")
        version = put({"left": left}, entity, NEW_POSE, "new")
    with pytest.raises(StoreError, match="middle of forgetting pose"):
        open_store(cell.folders["right"], unix_s=1)

    found = forget(cell.folders, ["pose"], now_ns=NOW_NS)

    assert (found.aspects, found.going, found.done) == ((), [], ("pose",))
    with cell.opened() as cells:
        online = cells["left"].world("online")
        assert [v.version for v in online.history(entity, NEW_POSE)] == [version]


@pytest.mark.parametrize("behind_s", [0, 3600])
@pytest.mark.parametrize("act", ["forget on right", "unmark left", "unmark right"])
def test_a_shard_that_was_restored_in_between_forgets_as_well(tmp_path, act, behind_s):
    """It has the aspect again and no mark; that it has forgotten it once before says nothing."""
    cell = StoppedCell(tmp_path / "cell", TWO)
    cell.fill(9, rounds=4)
    clock_ns = NOW_NS - behind_s * 10**9
    forget(cell.folders, ["pose"], now_ns=NOW_NS)
    entity = next(e for e in ENTITIES if shard_of(e.name, TWO) == "left")
    with cell.opened() as cells:
        last = cell.put(cells, "online", entity, 5)
    backup = shutil.copytree(cell.folders["left"], tmp_path / "backup")
    assert killed_at(cell, ACTS.index(act) + 1, now_ns=clock_ns)
    shutil.rmtree(cell.folders["left"])
    shutil.copytree(backup, cell.folders["left"])
    assert of_aspect(cell.folders["left"])[0]

    found = forget(cell.folders, ["pose"], now_ns=clock_ns)

    assert (found.aspects, found.resumed, found.done) == (("pose",), True, ())
    assert [of_aspect(folder) for folder in cell.folders.values()] == [GONE, GONE]
    assert [moving_mark(folder) for folder in cell.folders.values()] == [None, None]
    with cell.opened() as cells:
        assert put(cells, entity, NEW_POSE, "new") > last


def test_a_restored_shard_takes_nothing_from_one_that_served_since(tmp_path):
    """One was restored before its mark was off, one has data by the new type, one has its mark."""
    cell = StoppedCell(
        tmp_path / "cell", placement(*TWO_NAMES, "third", pins=[("part/9", "third")])
    )
    cell.fill(10, rounds=4)
    backup = shutil.copytree(cell.folders["right"], tmp_path / "backup")
    assert killed_at(
        cell, 3 + 3 + 3 * 2 + 2
    )  # three were opened, marked and let it go, one is free
    assert [moving_mark(folder) is None for folder in cell.folders.values()] == [True, False, False]
    with local(cell.folders["left"]) as left:
        entity = next(e for e in ENTITIES if shard_of(e.name, cell.where) == "left")
        version = put({"left": left}, entity, NEW_POSE, "new", where=cell.where)
    shutil.rmtree(cell.folders["right"])
    shutil.copytree(backup, cell.folders["right"])

    found = forget(cell.folders, ["pose"], now_ns=NOW_NS)

    assert {going.shard for going in found.going} == {"right"}
    assert of_aspect(cell.folders["right"]) == of_aspect(cell.folders["third"]) == GONE
    with local(cell.folders["left"]) as left:
        (kept,) = left.world("online").history(entity, NEW_POSE)
        assert (kept.version, kept.datum()) == (version, "new")


def test_a_run_of_one_shard_is_taken_up_on_that_one_alone(tmp_path):
    """The other never was to forget anything."""
    cell = StoppedCell(tmp_path, TWO)
    cell.fill(8, rounds=4)
    whole = cell.folders
    cell.where = placement("right", pins=[("**", "right")])
    assert killed_at(cell, 4)
    with pytest.raises(
        StoreError, match=r"covers only right; let `enact shard forget pose --shard right -"
    ):
        forget(whole, ["pose"], now_ns=NOW_NS)
    assert of_aspect(whole["left"])[0]
    assert forget({"right": whole["right"]}, ["pose"], now_ns=NOW_NS).resumed
    assert (of_aspect(whole["left"])[0], of_aspect(whole["right"])) == (True, GONE)


def test_a_run_whose_aspect_no_folder_has_any_more_comes_to_its_end(tmp_path):
    """The only shard that had it was restored from a backup of before: nothing is left to do."""
    folders = two_stores(tmp_path)
    mark(folders, lambda _: None, {"gone": NOW_NS})

    found = forget(folders, ["gone"], now_ns=NOW_NS)

    assert (found.resumed, found.going) == (True, [])
    assert [moving_mark(folder) for folder in folders.values()] == [None, None]


# ---------------------------------------------------------------- what is refused


LOCK = LockId("ann", 0, 1)
HERE = slot_record("part/1", 1)
READ = Item(int(Access.READ), *HERE.slot, 0)
OTHER = Slot("online", "part/1", "other")


def promise(items, *slots):
    """Return a prepared lock with these items and writes."""
    writes = tuple(WriteItem(slot, None) for slot in slots)
    versions = tuple(SlotVersion(slot, 1) for slot in slots)
    return PreparedRecord(LOCK, Token(1, 2), items, writes, versions, 77, "far", Token(3, 4))


@pytest.mark.parametrize(
    ("record", "said"),
    [
        (promise((), HERE.slot), "lock ann.0.1 is prepared on right, decided on far, and names as"),
        (promise((READ,), OTHER), "lock ann.0.1 is prepared on right, decided on far, and names a"),
        (DecisionRecord(LOCK, Position(5, "right"), ("left", "far")), "right has decided .* far"),
    ],
)
def test_commits_in_doubt_are_in_the_way(tmp_path, record, said):
    """If they name the aspect, or may; nothing is changed then."""
    folders = two_stores(tmp_path, left=[HERE], right=[record])
    for act in (look, lambda *words: forget(*words, now_ns=NOW_NS)):
        with pytest.raises(StoreError, match=f"nothing was forgotten: .*{said}"):
            act(folders, ["aspect"])
    assert of_aspect(folders["left"], "aspect") == (True, 1, 0)
    assert moving_mark(folders["left"]) is None


@pytest.mark.parametrize(
    "record", [promise((), OTHER), DecisionRecord(LOCK, Position(5, "right"), ("left",))]
)
def test_commits_in_doubt_of_others_are_not(tmp_path, record):
    """They are settled when the cell runs again."""
    folders = two_stores(tmp_path, left=[HERE], right=[record])
    forget(folders, ["aspect"], now_ns=NOW_NS)
    with read_store(folders["right"]) as found:
        assert len(found.prepared) + len(found.decisions) == 1
    assert [of_aspect(folder, "aspect") for folder in folders.values()] == [GONE, GONE]


def test_unknown_aspects_are_refused(tmp_path):
    """Known are those that were forgotten before, too: asked again, nothing is left to do."""
    folders = two_stores(tmp_path, left=[HERE])
    for act in (look, lambda *words: forget(*words, now_ns=NOW_NS)):
        with pytest.raises(
            MisuseError, match=r"an aspect spect; did you mean 'aspect'\? \(known: aspect\)"
        ):
            act(folders, ["aspect", "spect"])
    assert of_aspect(folders["left"], "aspect") == (True, 1, 0)
    for _ in range(2):
        forget(folders, ["aspect"], now_ns=NOW_NS)


def test_an_aspect_that_was_only_registered_since_goes_on_above_its_first_data(tmp_path):
    """Nothing but the record of the time before tells of them; each is later than the last one."""
    folders = two_stores(tmp_path, left=[slot_record("part/1", 7)])
    last_ns = 0
    for number in range(3):
        assert forget(folders, ["aspect"], now_ns=NOW_NS - number).going
        for folder in folders.values():
            with read_store(folder) as found:
                (record,) = found.forgotten
            assert (record.version_base, record.at_ns > last_ns) == (7, True)
        last_ns = record.at_ns
        store, _ = open_store(folders["right"], unix_s=1)
        store.write([persist(AspectRecord(AspectEntry("aspect", "str", "durable", 0)))])
        store.close()


def test_a_shard_that_runs_is_named(tmp_path):
    """By its name, its process and what to do."""
    folders = two_stores(tmp_path, left=[HERE])
    store, _ = open_store(folders["right"], unix_s=1)
    for act in (look, lambda *words: forget(*words, now_ns=NOW_NS)):
        with pytest.raises(StoreError, match=r"shard right: .* in use by process \d+.*stop that"):
            act(folders, ["aspect"])
    store.close()
    assert of_aspect(folders["left"], "aspect") == (True, 1, 0)
