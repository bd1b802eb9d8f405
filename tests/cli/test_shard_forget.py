"""`enact shard forget`: what goes is said first; nothing goes without a word."""

import json

import numpy as np
import pytest

from enact_dist import Aspect, Durability, Entity, Lock, Write, local
from enact_dist.core.protocol.messages import AspectEntry
from enact_dist.core.protocol.records import AspectRecord, Persist, WorldRecord
from enact_dist.errors import LinkError
from enact_dist.link.store.store import open_store

NUMBER, CLOUD = Aspect("number", int), Aspect("cloud", np.ndarray, Durability.OS)


@pytest.fixture
def stopped(write_cell):
    """A cell that was stopped, with one entity on each shard."""
    file = write_cell(
        '[[pins]]\nentities = "part/left"\nshard = "left"\n'
        '[[pins]]\nentities = "part/right"\nshard = "right"\n'
    )
    for shard in ("left", "right"):
        with local(file.parent / "data" / shard) as cell:
            online = cell.create_world("online")
            number, cloud = (Write(online, Entity(f"part/{shard}"), a) for a in (NUMBER, CLOUD))
            for value in (1, 2):
                with Lock(number, cloud) as lock:
                    lock[number], lock[cloud] = value, np.zeros(10_000)
            cell.pin("best", online.history(number.entity, NUMBER)[:1])
    return file


def test_what_would_go_is_said_and_stays(enact, stopped):
    """With a word on how to let it go, and status 1 unless nothing else was asked."""
    for words, status in ((("--dry-run",), 0), ((), 1)):
        told = enact("shard", "forget", "number", "cloud", "--cell", stopped, *words)
        rows = [line.split() for line in told.out.splitlines()]
        assert rows[1] == ["left", "number", "int", "1", "2", "-", "1", "(best)"]
        assert rows[2] == ["left", "cloud", "ndarray", "1", "2", "160", "kB", "-"]
        assert "would go: 8 versions with 320 kB, for good" in told.out
        assert told.status == status
        assert ("to let it go: enact shard forget number cloud --yes" in told.err) == (status == 1)


def test_it_goes_and_another_type_comes(enact, stopped):
    """On all shards; asked once more, nothing is left to do."""
    words = ("shard", "forget", "number", "--cell", stopped, "--yes")
    told = enact(*words)
    assert told.status == 0, told.err
    assert "goes: 4 versions, for good" in told.out
    assert "forgot number: 2 slots with 4 versions; the shards may start" in told.out
    again = enact(*words, "--json")
    assert (again.status, again.json["going"], again.json["done"]) == (0, [], True)
    assert enact(*words).out == "nothing is here any more of number\n"
    with local(stopped.parent / "data" / "left") as cell:
        write = Write(cell.world("online"), Entity("part/left"), Aspect("number", str))
        with Lock(write) as lock:
            lock[write] = "three"
        assert cell.pinned() == {}


def test_json_says_all_of_it(enact, stopped):
    """For scripts: what goes by shard and aspect."""
    told = enact("shard", "forget", "cloud", "--cell", stopped, "--dry-run", "--json").json
    assert (told["done"], told["aspects"], told["elsewhere"]) == (False, ["cloud"], [])
    assert told["going"][1] == {
        "shard": "right",
        "aspect": "cloud",
        "type": "ndarray",
        "slots": 1,
        "versions": 2,
        "size": 160_000,
        "kept": 0,
        "labels": [],
    }


def test_unknown_aspects_and_running_shards_are_refused(enact, stopped):
    """By name, and with what was meant perhaps."""
    told = enact("shard", "forget", "nubmer", "--cell", stopped, "--yes")
    assert (told.status, "did you mean 'number'? (known: cloud, number)" in told.err) == (1, True)
    store, _ = open_store(stopped.parent / "data" / "right", unix_s=1)
    for words in ((), ("--yes",)):
        told = enact("shard", "forget", "number", "--cell", stopped, *words)
        assert (told.status, "shard right: data folder" in told.err) == (1, True)
    store.close()


def test_shards_elsewhere_are_named_with_what_to_do_there(enact, stopped):
    """What is here goes; of a shard without data here it is unknown whether it has some."""
    text = stopped.read_text()
    stopped.write_text(
        text.replace("[shards.right]", '[shards.right]\nhost = "far"')
        + '[shards.new]\nlisten = "tcp/127.0.0.1:2"\n'
    )
    told = enact("shard", "forget", "number", "--cell", stopped, "--yes", "--json")
    assert told.status == 0, told.err
    assert [one["shard"] for one in told.json["going"]] == ["left"]
    command = "run `enact shard forget number --yes` there as well, before any shard starts"
    assert f"enact: shard right is on host far: {command}" in told.err
    assert "shard new has no data in" in told.err
    assert json.loads(told.out)["elsewhere"][0] in told.err
    right = f"right={stopped.parent}/data/right"
    told = enact(
        "shard", "forget", "number", "--cell", stopped, "--yes", "--json", "--store", right
    )
    assert [one["shard"] for one in told.json["going"]] == ["right"]


def test_one_shard_alone_forgets(enact, stopped):
    """Of one that was restored from an old backup; the others keep what they have."""
    words = ("shard", "forget", "number", "--cell", stopped, "--shard", "right")
    assert "enact shard forget number --shard right --yes" in enact(*words).err
    told = enact(*words, "--yes", "--json")
    assert [one["shard"] for one in told.json["going"]] == ["right"]
    left = enact("shard", "forget", "number", "--cell", stopped, "--dry-run", "--json").json
    assert [one["shard"] for one in left["going"]] == ["left"]
    assert "has no shard 'middle'" in enact(*words, "--shard", "middle").err


def test_what_has_no_data_goes_at_once(enact, stopped):
    """A client of an earlier release had filled the catalogue: the shard opens, and says so."""
    store, _ = open_store(stopped.parent / "data" / "left", unix_s=1)
    fat = [AspectRecord(AspectEntry(f"fat{n}", "x" * 60_000, "os")) for n in range(60)]
    worlds = [WorldRecord(f"w{n}") for n in range(5_000)]
    store.write([Persist(0, (*worlds, *fat), Durability.DURABLE)])
    store.close()
    with local(stopped.parent / "data" / "left") as cell:
        assert ("number", "int", "durable") in {
            (a.aspect, a.type, a.durability) for a in cell.aspects()
        }
        assert cell.shards()[0].counters["catalogue_left_out"] > 0
        with pytest.raises(LinkError, match=r"world contexts.* at most 4096; .*forget --unused"):
            cell.create_world("lab")

    said = enact("shard", "forget", "--unused", "--cell", stopped)
    done = enact("shard", "forget", "--unused", "--cell", stopped, "--yes")
    again = enact("shard", "forget", "--unused", "--cell", stopped, "--yes", "--json")

    assert said.status == 1
    assert "would go: 5000 world contexts without data: w0, w1" in said.out
    assert "to let it go: enact shard forget --unused --yes" in said.err
    assert done.status == 0, done.err
    assert "and 5000 world contexts without data" in done.out
    assert (again.json["aspects"], again.json["worlds"]) == ([], [])
    with local(stopped.parent / "data" / "left") as cell:
        assert "catalogue_left_out" not in cell.shards()[0].counters
        cell.create_world("lab")
        assert [info.version for info in cell.world("online").list_slots("**")] == [2, 2]
        assert sorted({one.aspect for one in cell.aspects()}) == ["cloud", "number"]


def test_unused_wants_all_shards_and_nothing_named_is_refused(enact, stopped):
    """What one shard has no data of another may be full of."""
    told = enact("shard", "forget", "--unused", "--cell", stopped, "--shard", "left")
    assert (told.status, "--unused needs the data of all shards" in told.err) == (2, True)
    told = enact("shard", "forget", "--cell", stopped)
    assert (told.status, "or --unused for all without data" in told.err) == (2, True)


@pytest.mark.slow
def test_a_put_after_it_tells_the_version_that_it_made(enact, stopped, spawn, until):
    """Which goes on above those that are gone; the other type is taken."""
    assert enact("shard", "forget", "number", "--cell", stopped, "--yes").status == 0
    for shard in ("left", "right"):
        until(spawn("shard", "run", shard, "--cell", stopped), "ready: shard")
    words = ("world", "put", "online", "part/new/number", '"three"', "--new", "--cell", stopped)
    assert enact(*words).out == "online:part/new/number set, v3\n"
    assert enact(*words).out == "online:part/new/number set, v4\n"
