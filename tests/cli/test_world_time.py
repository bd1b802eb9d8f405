"""`enact world history|at|fork|drop|pin|pinned|unpin` against two real shards."""

import json
from datetime import datetime
from types import SimpleNamespace

import pytest

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.access.arguments import stamp_of
from enact_dist.cli.text.times import moment

COUNT = Aspect("time_count", int)
ARM, LEG = Entity("arm"), Entity("system/leg")


@pytest.fixture
def at(enact, cell_file):
    """Call `enact world VERB … --cell FILE`."""
    return lambda *words: enact("world", *words, "--cell", cell_file)


@pytest.fixture
def made(cell_file, request):
    """A world context of the test's own: three versions of one datum, then another datum."""
    name = request.node.originalname
    with connect(cell_file, actor="writer") as cell:
        world = cell.create_world(name)
        arm, leg = Write(world, ARM, COUNT), Write(world, LEG, COUNT)
        positions = [put(arm, number) for number in (10, 20, 30)]
        put(leg, 7)
        yield SimpleNamespace(name=name, positions=positions, world=world, cell=cell)
        if name in cell.worlds():
            cell.drop_world(name)


def put(request, value):
    with Lock(request) as lock:
        lock[request] = value
    return lock.position


def shown(position):
    return f"{position.stamp_ns}@{position.shard}"


def test_history_is_a_table_of_versions(at, made):
    """Version, time, age, who, and where it stands, so that it can be asked for."""
    head, *rows = at("history", made.name, "arm/time_count").out.splitlines()

    assert head.split() == ["version", "time", "age", "size", "actor", "position"]
    assert [row.split()[0] for row in rows] == ["v1", "v2", "v3"]
    assert [row.split()[-1] for row in rows] == [shown(p) for p in made.positions]
    assert all("writer@" in row for row in rows)


def test_history_as_json_names_every_fact(at, made):
    """For programs: stamps, sizes, causes."""
    rows = at("history", made.name, "arm/time_count", "--count", 2, "--json").json

    assert [row["version"] for row in rows] == [2, 3]
    assert [row["stamp_ns"] for row in rows] == [p.stamp_ns for p in made.positions[1:]]
    assert rows[0]["until_ns"] == rows[1]["stamp_ns"]
    assert rows[1]["cause"]["actor"] == "writer"
    assert rows[1]["null_reason"] == ""


def test_history_since_a_moment_has_what_was_current_after_it(at, made):
    """A position as the table prints it."""
    since = shown(made.positions[1])

    rows = at("history", made.name, "arm/time_count", "--since", since, "--json").json

    assert [row["version"] for row in rows] == [2, 3]


def test_history_of_nothing_is_told(at, made):
    """An unknown datum is refused as `get` refuses it, with what it may have been meant to be."""
    told = at("history", made.name, "amr/time_count")
    as_json = at("history", made.name, "amr/time_count", "--json")

    assert (told.status, told.out, as_json.out, as_json.status) == (1, "", "", 1)
    assert told.err == as_json.err
    assert told.err == (
        f"enact: {made.name}:amr/time_count is null (never set); enact world tree {made.name} shows"
        " what there is; did you mean 'arm/time_count'?\n"
    )
    unknown = at("history", "nowhere", "arm/time_count")
    assert unknown.status == 1
    assert "no world context 'nowhere'" in unknown.err


def test_past_is_shown_as_a_tree_or_a_datum(at, made):
    """As of a position that the history has printed."""
    then = shown(made.positions[1])

    tree = at("at", made.name, then).out.splitlines()
    assert tree[0].startswith(f"{made.name} at ")
    assert tree[0].endswith("(1 data)")
    assert [line.split()[:2] for line in tree[1:]] == [["arm/"], ["time_count", "v2"]]
    assert tree[2].endswith(" old")
    assert at("at", made.name, then, "get", "arm/time_count").out == "20\n"
    assert at("at", made.name, then, "get", "arm/time_count", "--json").json == 20
    assert at("at", made.name, then, "tree", "system/**", "--json").json == []
    assert at("get", made.name, "arm/time_count").out == "30\n"


def test_past_before_anything_was_set_is_empty(at, made):
    """An hour ago nothing of it was there; -1h is no option."""
    result = at("at", made.name, "-1h")

    assert result.status == 0
    assert result.out.splitlines()[0].endswith("(0 data)")


@pytest.mark.parametrize(
    ("words", "status", "told"),
    [
        (("@get",), 2, "which datum? world at WORLD TIME get ENTITY/ASPECT"),
        (("@get", "arm"), 2, "which datum?"),
        (("@get", "nobody/time_count"), 1, "was null (not set by then); enact world history"),
        (("4000000000",), 1, "in the future"),
    ],
)
def test_past_that_cannot_be_shown_is_refused(at, made, words, status, told):
    """With what was asked and what to do."""
    moment = [shown(made.positions[0])] if words[0].startswith("@") else []

    result = at("at", made.name, *moment, *(word.removeprefix("@") for word in words))

    assert result.status == status
    assert told in result.err


def test_fork_is_made_listed_with_its_source_and_dropped(at, made):
    """As of a moment; the listing names what it is a fork of."""
    then, name = made.positions[0], f"{made.name}_fork"

    told = at("fork", made.name, name, "--at", shown(then))

    assert told.out.startswith(f"{name} is a fork of {made.name} as of ")
    assert at("get", name, "arm/time_count").out == "10\n"
    (row,) = [row for row in at("ls", "--json").json if row["world"] == name]
    assert row["forked_from"] == {"world": made.name, "at_ns": then.stamp_ns}
    (line,) = [line for line in at("ls").out.splitlines() if line.startswith(f"{name} ")]
    assert f"{made.name} as of 20" in line
    assert at("drop", name).out == f"{name} is dropped, with 1 slots\n"
    assert at("drop", name).status == 1


def test_fork_over_an_existing_context_is_refused(at, made):
    """Nothing is lost by a name."""
    result = at("fork", made.name, "training")

    assert result.status == 1
    assert "there is a world context 'training'" in result.err


def test_context_of_the_cell_file_is_not_dropped(at):
    """It would be there again after the next start."""
    result = at("drop", "online")

    assert result.status == 1
    assert "stands in cell.toml" in result.err


def test_versions_are_pinned_listed_and_released(at, made):
    """A version of each datum, the newest unless one is named."""
    label = "drop-17"

    kept = at("pin", label, made.name, "arm/time_count@2", "system/leg/time_count")

    assert kept.out.splitlines() == [
        f"{made.name}:arm/time_count v2 is pinned as {label}",
        f"{made.name}:system/leg/time_count v1 is pinned as {label}",
    ]
    listed = json.loads(at("pinned", "--json").out)
    assert [(row["entity"], row["version"]) for row in listed[label]] == [
        ("arm", 2),
        ("system/leg", 1),
    ]
    head, *rows = at("pinned").out.splitlines()
    assert head.split() == ["label", "datum", "version", "time", "age", "size"]
    assert [row.split()[:3] for row in rows] == [
        [label, f"{made.name}:arm/time_count", "v2"],
        [label, f"{made.name}:system/leg/time_count", "v1"],
    ]
    assert "pinned as drop-17" in at("history", made.name, "arm/time_count").out
    assert at("unpin", label).out == f"{label}: 2 versions released\n"
    assert at("pinned").out == "no version is pinned\n"
    again = at("unpin", label)
    assert (again.status, again.out) == (1, f"nothing is pinned as {label}; labels: none\n")


def test_version_that_is_not_known_is_not_pinned(at, made):
    """The known ones are named."""
    result = at("pin", "label", made.name, "arm/time_count@9")

    assert result.status == 1
    assert "has no version 9 that is known; known: v1, v2, v3" in result.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("at", "W", "-1ms", "get", "a b/time_count"), "'a b' cannot name an entity"),
        (("at", "W", "-1ms", "get"), "which datum?"),
        (("at", "W", "-1ms", "tree", "a**"), "'a**' is no pattern of entities"),
        (("at", "W", "-1ms", "--out", "x.npz"), "world export --at TIME saves a whole context"),
    ],
)
def test_names_of_the_past_that_cannot_be_are_usage_errors(at, made, words, said):
    """Said by name, never as a traceback."""
    done = at(*(made.name if word == "W" else word for word in words))

    assert done.status == 2
    assert said in done.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("history", "w", "arm/*/time_count"), "'arm/*' cannot name an entity"),
        (("history", "w", "arm/time_count@2"), "'time_count@2' cannot name an aspect"),
        (("history", "w", "arm/time_count", "--count", "0"), "'0' is no whole number above zero"),
        (("history", "w", "arm/time_count", "--timeout", "x"), "'x' is no number of seconds"),
        (("pin", "label", "w", "arm//time_count"), "'arm/' cannot name an entity"),
    ],
)
def test_names_that_cannot_be_are_usage_errors(at, capsys, words, said):
    """Before the cell is asked."""
    with pytest.raises(SystemExit) as end:
        at(*words)

    assert end.value.code == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("time", ["1e300", "99999999999999999999999@left", "2100-01-01"])
def test_the_future_is_refused_however_far(at, made, time):
    """As what it is, not as a number that does not fit."""
    done = at("at", made.name, time)

    assert done.status == 1
    assert "in the future, which is unknown" in done.err
    assert "datetime.datetime" not in done.err


def test_to_pin_what_never_was_names_no_version(at, made):
    """Version 0 is the command line's word for the newest, nobody's."""
    done = at("pin", "label", made.name, "nobody/time_count")

    assert done.status == 1
    assert "nobody/time_count has no version that is known" in done.err


def test_printed_time_says_its_zone_and_is_read_back(at, made):
    """What a table shows can be asked for, on a host of another zone, too."""
    row = at("history", made.name, "arm/time_count").out.splitlines()[-1].split()
    printed = f"{row[1]} {row[2]}"

    read = stamp_of(moment(printed))

    assert datetime.fromisoformat(printed).utcoffset() is not None
    assert 0 <= made.positions[-1].stamp_ns - read < 1_000_000
