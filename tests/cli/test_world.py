"""`enact world` against two real shards."""

import json
import signal
import time
from dataclasses import dataclass

import numpy as np
import pytest

from enact_dist import Aspect, Entity, connect


@dataclass(frozen=True, slots=True)
class Surface:
    vertices_m: np.ndarray
    name: str


SURFACE = Aspect("surface", Surface)
COUNT = Aspect("count", int)
IMAGE = Aspect("image", np.ndarray)


@pytest.fixture(scope="module")
def cell(cell_file):
    with connect(cell_file, actor="test") as opened:
        online = opened.world("online")
        online.init(Entity("tray/package/1"), COUNT, 1)
        online.init(Entity("tray/package/2"), COUNT, 2)
        online.init(Entity("tray/package/1"), SURFACE, Surface(np.zeros((10, 3)), "milk"))
        online.init(Entity("camera"), IMAGE, np.arange(30.0))
        yield opened


@pytest.fixture
def at(enact, cell, cell_file):
    """Call `enact world VERB … --cell FILE`."""
    return lambda *words: enact("world", *words, "--cell", cell_file)


def test_ls_counts_entities_and_data(at):
    """Each world context is listed with what it holds."""
    worlds = {row["world"]: row for row in at("ls", "--json").json}

    assert set(worlds) == {"online", "training"}
    assert worlds["online"]["entities"] >= 3
    assert worlds["online"]["size_bytes"] >= 480
    assert worlds["training"]["data"] == 0
    assert at("ls").out.splitlines()[0].split() == [
        "world",
        "entities",
        "data",
        "size",
        "fork",
        "of",
    ]


def test_tree_shows_aspects_below_their_entities(at):
    """The tree follows the slash paths; a pattern limits it."""
    lines = at("tree", "online", "tray/**").out.splitlines()

    assert lines[0] == "online (3 data)"
    assert lines[1:4] == ["  tray/", "    package/", "      1/"]
    assert lines[4].startswith("        count  v1  ")
    assert "camera" not in "".join(lines)


@pytest.mark.parametrize(
    ("pattern", "hint"), [("tray", "; tray/** matches "), ("camra", "; did you mean 'camera'?")]
)
def test_tree_of_nothing_names_what_there_is(at, pattern, hint):
    """A pattern that would match, or the closest name."""
    (line,) = at("tree", "online", pattern).out.splitlines()
    assert line.startswith("online: none of its ")
    assert f"entities matches {pattern!r}{hint}" in line
    assert at("tree", "online", pattern, "--json").json == []


def test_tree_as_json_names_every_slot(at):
    """A program gets entity, aspect, version, size and shard."""
    slots = at("tree", "online", "camera", "--json").json

    assert [(slot["entity"], slot["aspect"], slot["version"]) for slot in slots] == [
        ("camera", "image", 1)
    ]
    assert slots[0]["size_bytes"] >= 240
    assert slots[0]["shard"] in {"left", "right"}


def test_get_prints_a_record_without_its_class(at):
    """A dataclass is readable where its Python type is not known."""
    assert at("get", "online", "tray/package/1/surface").out.splitlines() == [
        "Surface",
        "  vertices_m: array 10 x 3 float64, 0.0 to 0.0",
        "  name: milk",
    ]


def test_get_saves_arrays(at, tmp_path):
    """--out writes the whole data, not the summary."""
    result = at("get", "online", "camera/image", "--out", tmp_path / "image.npy")

    assert result.status == 0
    assert (np.load(tmp_path / "image.npy") == np.arange(30.0)).all()


@pytest.mark.parametrize("verb", [("get", "online"), ("at", "online", "-0.001s", "get")])
def test_get_that_saves_says_so_as_json(at, verb, tmp_path):
    """A program that asked for JSON got a line for people."""
    path = tmp_path / "image.npy"
    saved = at(*verb, "camera/image", "--out", path, "--json").json

    assert saved == {"path": str(path), "size_bytes": path.stat().st_size}


def test_get_of_null_is_refused_with_its_reason(at):
    """A datum that is not known is an error that says why, status 1."""
    result = at("get", "online", "nobody/count")

    assert result.status == 1
    assert "nobody" in result.err
    assert "never set" in result.err


@pytest.mark.parametrize("past", [False, True], ids=["now", "past"])
def test_what_is_null_is_told_in_words_of_the_command_line(at, past):
    """What is close to what was typed, and which command shows it; nothing of Python."""
    words = ("at", "online", time.time(), "get") if past else ("get", "online")

    told = at(*words, "tray/pakage/1/count").err

    is_null = "is null (never set); enact world tree online shows what there is"
    if past:  # it may have come later
        is_null = "was null (not set by then); enact world history online tray/pakage/1/count lists"
        is_null += " what came later, if anything"
    name = "online:tray/pakage/1/count"
    assert told == f"enact: {name} {is_null}; did you mean 'tray/package/1/count'?\n"


def test_what_was_deleted_was_not_misspelt(at):
    """Where the datum was there once, nothing else is proposed."""
    at("put", "online", "tray/package/3/count", "5")
    at("put", "online", "tray/package/3/count", "null")

    told = at("get", "online", "tray/package/3/count").err

    assert "tray/package/3/count is null (deleted)" in told
    assert "did you mean" not in told


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("tree", "onlin"), "did you mean 'online'? (it has online, training"),
        (("tree", "onlin"), "; enact world create onlin, or cell.create_world('onlin'), makes it"),
        (("get", "online", "camera/imge"), "'imge' is registered; did you mean 'image'? (known: "),
        (("put", "online", "a/cuont", "1"), "did you mean 'count'? (known: "),
        (("diff", "online", "training", "--aspect", "cuont"), "did you mean 'count'? (known: "),
    ],
)
def test_name_that_is_close_is_proposed(at, words, said):
    """Of world contexts and of aspects, with all that there are."""
    result = at(*words)

    assert (result.status, result.out) == (1, "")
    assert said in result.err


def test_create_makes_a_world_context_once(at, cell):
    """A second time it is there and stays as it is."""
    try:
        assert at("create", "planning").out == "planning is made\n"
        at("put", "planning", "piece/count", "3")
        assert at("create", "planning", "--json").json == {"world": "planning", "new": False}
        assert at("create", "planning").out == "planning was there\n"
        assert at("get", "planning", "piece/count").out == "3\n"
    finally:
        cell.drop_world("planning")


def test_name_that_no_world_context_can_have_is_a_usage_error(at, capsys):
    """It is refused where it is read."""
    with pytest.raises(SystemExit) as caught:
        at("create", "a/b")

    assert caught.value.code == 2
    assert "argument NAME: 'a/b' cannot name a world context" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("get", "nowhere", "camera/image"), "no world context 'nowhere'"),
        (("get", "online", "camera/imge"), "imge"),
        (("put", "online", "camera/imge", "1"), "no aspect 'imge' is registered"),
        (
            ("put", "online", "camera/count", '"many"'),
            "camera/count is not set: int: asked int, found str",
        ),
        (("put", "online", "tray/package/1/surface", "{}"), "write it from Python"),
    ],
)
def test_mistakes_are_refused_with_status_1(at, words, reason):
    """A wrong name or type changes nothing and is named."""
    result = at(*words)

    assert result.status == 1
    assert reason in result.err


def test_put_sets_deletes_and_counts_versions(at):
    """Each put is one committed version; null is one, too."""
    assert at("put", "online", "bench/count", "5").out == "online:bench/count set, v1\n"
    assert at("get", "online", "bench/count").out == "5\n"
    assert at("put", "online", "bench/count", "null", "--json").json["version"] == 2
    assert at("get", "online", "bench/count").status == 1


def test_put_registers_a_new_aspect_only_when_told(at):
    """--new makes an aspect of the value's type, which holds from then on."""
    assert at("put", "online", "robot/speed_m_s", "0.5", "--new").status == 0
    assert at("put", "online", "robot/speed_m_s", "2").status == 0
    assert at("get", "online", "robot/speed_m_s", "--json").out == "2.0\n"
    assert at("put", "online", "robot/speed_m_s", "true").status == 1


def test_put_takes_an_array_from_a_file(at, tmp_path):
    """An .npy becomes the datum."""
    np.save(tmp_path / "a.npy", np.eye(3, dtype=np.float32))

    assert at("put", "online", "robot/image", f"@{tmp_path}/a.npy").status == 0
    assert at("get", "online", "robot/image", "--json").json["dtype"] == "float32"


def test_watch_shows_what_is_there_and_leaves_after_enough(at):
    """The first lines of a watch are the present state."""
    lines = at("watch", "online", "tray/**", "--aspect", "count", "--count", "2").out.splitlines()

    assert sorted(line.split()[1] for line in lines) == [
        "online:tray/package/1/count", "online:tray/package/2/count"
    ]  # fmt: skip


def test_watch_of_an_aspect_that_nobody_knows_says_so_and_goes_on(spawn, until, at, cell_file):
    """It may come later: then it is shown."""
    words = ("world", "watch", "online", "--cell", cell_file, "--count", "1")
    watch = spawn(*words, "--aspect", "coutn_of_later", "--aspect", "count_of_later")

    at("put", "online", "bench/count_of_later", "3", "--new")

    told = "".join(until(watch, "online:bench/count_of_later  v1"))
    assert "enact: no shard knows an aspect 'coutn_of_later' yet" in told
    assert watch.wait(60) == 0


def test_watch_of_known_aspects_says_nothing_else(at):
    """Standard error is for what is not as it was asked."""
    told = at("watch", "online", "tray/**", "--aspect", "count", "--count", "1").err

    assert told.startswith("watched ")
    assert told.count("\n") == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_watch_ends_with_status_0_on_a_signal(spawn, until, at, cell_file, number):
    """Changes come as lines while a watch runs; a signal is its ordinary end."""
    watch = spawn("world", "watch", "online", "watched/**", "--json", "--cell", cell_file)
    entity = f"watched/{number.name}"
    # What is there already is shown, too, so the watch need not be up before the write.
    at("put", "online", f"{entity}/count", "1")
    change = json.loads(until(watch, entity)[-1])
    watch.send_signal(number)

    assert watch.wait(60) == 0
    assert (change["aspect"], change["version"], change["null"]) == ("count", 1, False)


@pytest.mark.parametrize(
    "verb", [("tree", "online"), ("watch", "online"), ("diff", "online", "training")]
)
def test_what_is_no_pattern_is_a_usage_error(at, verb, capsys):
    """A character that no name can have is refused where it is read."""
    with pytest.raises(SystemExit) as caught:
        at(*verb, "a??")
    assert caught.value.code == 2
    assert "'a??' is no pattern of entities" in capsys.readouterr().err
