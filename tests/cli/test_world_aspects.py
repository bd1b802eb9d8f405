"""`enact world aspects` against two real shards."""

import numpy as np
import pytest

from enact_dist import Aspect, Durability, Entity, Lock, Retention, Write, connect

PARTS = [Entity(f"part/{number}") for number in range(6)]
CLOUD = Aspect("cloud", np.ndarray, Durability.OS, retention=Retention(versions=3))
PLAN = Aspect("plan", list[int], Durability.VOLATILE, retention=Retention(age_s=90.0))


@pytest.fixture(scope="module")
def cell(cell_file):
    with connect(cell_file) as opened:
        online = opened.world("online")
        for part in PARTS:
            online.init(part, CLOUD, np.zeros(100))
        with Lock(write := Write(online, PARTS[0], CLOUD)) as lock:
            del lock[write]
        opened.world("training").init(PARTS[1], CLOUD, np.zeros(10))
        opened.world("training").init(PARTS[1], PLAN, [1])
        yield opened


def test_each_aspect_is_listed_with_what_there_is_of_it(enact, cell, cell_file):
    """Over all shards and contexts, or of one context."""
    rows = {
        row["aspect"]: row for row in enact("world", "aspects", "--cell", cell_file, "--json").json
    }
    assert rows["cloud"] == {
        "aspect": "cloud",
        "type": "ndarray",
        "durability": "os",
        "versions": 3,
        "age_s": None,
        "history_bytes": None,
        "shards": ["left", "right"],
        "slots": 7,
        "data": 6,
        "size_bytes": 5 * 800 + 80,
        "older_types": [],
    }
    assert rows["plan"]["shards"] == [cell.world("training").list_slots(aspects=("plan",))[0].shard]
    words = ("world", "aspects", "training", "--cell", cell_file)
    rows = {row["aspect"]: row for row in enact(*words, "--json").json}
    assert (rows["cloud"]["slots"], rows["plan"]["data"]) == (1, 1)
    lines = {line.split()[0]: line for line in enact(*words).out.splitlines()}
    assert lines["aspect"].split() == [
        "aspect", "slots", "data", "size", "durability", "retained", "shards", "type",
    ]  # fmt: skip
    assert lines["cloud"].split(maxsplit=8)[1:8] == ["1", "1", "80", "B", "os", "3", "versions"]
    assert "volatile    1 min 30 s" in lines["plan"]
    assert lines["plan"].endswith("list[int]")


def test_an_unknown_world_is_refused(enact, cell, cell_file):
    """By name, as everywhere."""
    told = enact("world", "aspects", "onlin", "--cell", cell_file)
    assert (told.status, "did you mean 'online'?" in told.err) == (1, True)
