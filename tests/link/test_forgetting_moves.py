"""Aspects that are forgotten, and entities that move between shards: versions and the past."""

import time

import pytest
from forgotten_cells import (
    NEW_POSE,
    NOW_NS,
    TWO,
    TWO_NAMES,
    killed_at,
    put,
    two_stores,
)
from rebalance_cells import ENTITIES, POSE, StoppedCell, placement
from store_writer import persist

from enact_dist import Entities, Position, View, ViewEach
from enact_dist.core.protocol.messages import AspectEntry
from enact_dist.core.protocol.placement import shard_of
from enact_dist.core.protocol.records import AspectRecord
from enact_dist.errors import ForgottenError, StoreError
from enact_dist.link.offline.forgetting import forget, look
from enact_dist.link.offline.rebalance import rebalance
from enact_dist.link.store.store import open_store


def test_versions_are_never_used_again_where_an_entity_moves(tmp_path):
    """Also on a shard that never had the aspect, or has forgotten it at another time."""
    cell = StoppedCell(tmp_path, TWO)
    cell.fill(6, rounds=8)
    home = shard_of(ENTITIES[0].name, TWO)
    away = {"left": "right", "right": "left"}[home]
    entity, stays = (next(e for e in ENTITIES if shard_of(e.name, TWO) == s) for s in (home, away))
    with cell.opened() as cells:
        last = cell.put(cells, "online", entity, 40)
    forget({home: cell.folders[home]}, ["pose"], now_ns=NOW_NS)
    forget({away: cell.folders[away]}, ["pose"], now_ns=NOW_NS)
    with cell.opened() as cells:
        first = put(cells, stays, NEW_POSE, "a")
        assert first < last

    cell.where = placement("left", "right", pins=[(entity.name, away), ("**", away)])
    rebalance(cell.folders, cell.where, unix_s=int(time.time()))

    with cell.opened() as cells:
        assert put(cells, entity, NEW_POSE, "b", where=cell.where) > last
        assert put(cells, stays, NEW_POSE, "c", where=cell.where) == first + 1
        online = cells[away].world("online")
        made = online.history(stays, NEW_POSE)[0].position.stamp_ns
        before = online.at(Position(made - 1, away))
        assert before.view(old := View(before, stays, NEW_POSE)).get(old) is None


def past_of(cell, entity, versions):
    """Return what a slot has been at the stamps of its versions, and what labels keep of it."""
    online = cell.world("online")
    found = []
    for version in versions:
        past = online.at(Position(version.position.stamp_ns, "local"))
        found.append(past.view(view := View(past, entity, POSE))[view])
    known = [(one.version, one.datum()) for one in online.history(entity, POSE)]
    return found, known, [(one.version, one.datum()) for one in cell.pinned()["best"]]


@pytest.mark.parametrize("away", TWO_NAMES)
@pytest.mark.parametrize("earlier", [False, True])
def test_what_another_shard_forgot_is_known_where_it_was_not(tmp_path, earlier, away):
    """The past and labels of who forgot nothing, or did before, stay readable in a rebalance."""
    cell = StoppedCell(tmp_path, TWO)
    mine, other = (next(e for e in ENTITIES if shard_of(e.name, TWO) == s) for s in TWO_NAMES)
    with cell.opened() as cells:
        for one in cells.values():
            one.create_world("online")
        for entity in (mine, other):
            cell.put(cells, "online", entity, 2)
    if earlier:
        forget({"left": cell.folders["left"]}, ["pose"], now_ns=time.time_ns())
    with cell.opened() as cells:
        cell.put(cells, "online", mine, 3)
        versions = cells["left"].world("online").history(mine, POSE)[-3:]
        cells["left"].pin("best", versions[:1])
        before = past_of(cells["left"], mine, versions)
    forget({"right": cell.folders["right"]}, ["pose"], now_ns=time.time_ns())

    for home in ("left", away, "left"):
        cell.where = placement(*TWO_NAMES, pins=[(mine.name, home)])
        rebalance(cell.folders, cell.where, unix_s=int(time.time()))
        with cell.opened() as cells:
            assert past_of(cells[home], mine, versions) == before
            past = cells[home].world("online").at(Position(versions[-1].position.stamp_ns, "local"))
            for asked in (View(past, other, POSE), ViewEach(past, Entities("part/*"), POSE)):
                with pytest.raises(ForgottenError):  # it may have been on either shard
                    past.view(asked)
    with cell.opened() as cells:
        assert cell.put(cells, "online", mine, 1) == versions[-1].version + 1


@pytest.mark.parametrize(("old", "new"), [TWO_NAMES, TWO_NAMES[::-1]])
def test_two_types_after_a_restore_are_told_with_what_makes_them_one(tmp_path, old, new):
    """Which shard has the old one is known by when each has forgotten it."""
    other = AspectRecord(AspectEntry("aspect", "str", "durable", 0))
    never = two_stores(tmp_path / "never", **{new: [other]})
    with pytest.raises(
        StoreError, match=r"is .* on left and .* on right: start the cell as it was"
    ):
        rebalance(never, TWO, unix_s=1)
    folders = two_stores(tmp_path)
    forget({new: folders[new]}, ["aspect"], now_ns=NOW_NS)
    store, _ = open_store(folders[new], unix_s=1)
    store.write([persist(other)])
    store.close()
    with pytest.raises(
        StoreError, match=f"{new} has forgotten it since, .* forget aspect --shard {old}`"
    ):
        rebalance(folders, TWO, unix_s=1)
    forget({old: folders[old]}, ["aspect"], now_ns=NOW_NS)
    rebalance(folders, TWO, unix_s=1)


def test_what_was_forgotten_is_not_said_to_be_a_matter_of_retention_alone(tmp_path):
    """Whoever asks for the past is told of both reasons, and since when it is known."""
    cell = StoppedCell(tmp_path, TWO)
    cell.fill(11, rounds=4)
    forget(cell.folders, ["pose"], now_ns=NOW_NS)
    entity = next(e for e in ENTITIES if shard_of(e.name, TWO) == "left")
    with cell.opened() as cells:
        past = cells["left"].world("online").at(Position(NOW_NS - 1, "left"))
        with pytest.raises(
            ForgottenError, match="or than the last `enact shard forget pose`"
        ) as said:
            past.view(View(past, entity, NEW_POSE))
    assert said.value.oldest_ns >= NOW_NS


def test_a_rebalance_and_a_forgetting_wait_for_each_other(tmp_path):
    """Each names the one that was cut off, and what ends it."""
    cell = StoppedCell(tmp_path, TWO)
    cell.fill(7, rounds=4)
    assert killed_at(cell, 5)
    with pytest.raises(
        StoreError, match=r"of right; leave --shard out, or let .* --shard left --shard right --yes"
    ):
        forget({"left": cell.folders["left"]}, ["pose"], now_ns=NOW_NS)
    with pytest.raises(
        StoreError, match=r"middle of forgetting pose; let `enact shard forget pose"
    ):
        rebalance(cell.folders, TWO, unix_s=1)
    (cell.folder / "left" / "moving").write_text('{"rebalance": "x", "shards": ["left", "right"]}')
    with pytest.raises(StoreError, match=r"middle of a rebalance; let `enact shard rebalance`"):
        look(cell.folders, ["pose"])
