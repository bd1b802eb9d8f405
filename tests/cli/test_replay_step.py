"""`enact replay --step`: the statuses, what it prints, and that it leaves the cell as it was."""

import re
import sys

import pytest

from enact_dist import Aspect, Entity, Lock, Retention, View, Write, connect, testing
from enact_dist.errors import ShardUnreachableError
from enact_dist.world.cell import Cell

MODULE = """\
from enact_dist import Actor, Aspect, Entities, Retention, View, World, Write

PIECES = Entities("piece/*")


class Weigh(Actor):
    online, training = World("online"), World("training")
    length = View(online, PIECES, Aspect("length_mm", float, retention=Retention(versions=2)))
    density = View(training, PIECES, Aspect("density", float))
    weight = Write(online, PIECES, Aspect("weight", float))
    triggers = (length,)

    def __init__(self, factor: float = 1.0):
        self.factor = factor

    def update(self, lock):
        lock[self.weight] = self.factor * lock[self.length] * lock[self.density]


class Broken(Weigh):
    def update(self, lock):
        raise RuntimeError("scale is off")
"""
LENGTH = Aspect("length_mm", float, retention=Retention(versions=2))
DENSITY = Aspect("density", float)
WEIGHT = Aspect("weight", float)
PIECE = Entity("piece/1")


@pytest.fixture(scope="module")
def weighed(cell_file, tmp_path_factory):
    """A cell with a module beside it; four lengths were weighed, of which two are known."""
    folder = tmp_path_factory.mktemp("actors")
    (folder / "weighing.py").write_text(MODULE, encoding="utf-8")
    file = folder / "cell.toml"
    table = '[actors.scale]\nclass = "weighing:Weigh"\nargs = { factor = 2.0 }\n'
    text = cell_file.read_text("utf-8").replace('"data"', f'"{cell_file.parent / "data"}"')
    file.write_text(f"{text}\n{table}", "utf-8")
    sys.path.insert(0, str(folder))
    from weighing import Weigh

    with connect(file) as cell:
        density = Write(cell.world("training"), PIECE, DENSITY)
        with Lock(density) as lock:
            lock[density] = 3.0
        actor, length = Weigh(), Write(cell.world("online"), PIECE, LENGTH)
        for number in range(4):
            with Lock(length) as lock:
                lock[length] = float(number)
            testing.run_once(actor, cell)
    yield file
    sys.path.remove(str(folder))


@pytest.fixture
def replay(enact, weighed):
    """Run the step of the newest weight again, or of another version."""
    return lambda *words, step="piece/1/weight": enact(
        "replay", "--step", "online", step, *words, "--cell", weighed
    )


def test_same_code_ends_with_status_0(replay, enact, weighed):
    """Data of two world contexts on two shards; nothing of it stays."""
    before = enact("world", "ls", "--json", "--cell", weighed).json
    found = replay("--actor", "weighing:Weigh")

    assert found.status == 0
    assert found.out.splitlines()[0].startswith("online:piece/1/weight v4, made by ")
    assert "Weigh.update once more for piece/1, on 3 data" in found.out
    assert found.out.splitlines()[-1] == "1 equal"
    assert enact("world", "ls", "--json", "--cell", weighed).json == before


def test_other_code_ends_with_status_4_and_the_difference(replay, enact, weighed):
    """By an option, by the table of cell.toml, and kept on request."""
    by_option = replay("--actor", "weighing:Weigh", "--option", "factor=3.0")
    by_table = replay("--name", "scale", "--keep-as", "tried", "--json")
    both = replay("--name", "scale", "--option", "factor=1.0")
    loose = replay("--name", "scale", "--tolerance", "weight=10")

    assert by_option.status == 4
    assert "18 apart: 9.0 against 27.0" in by_option.out
    assert "online then" in by_option.out
    assert by_table.status == 4
    assert by_table.json["differs"]
    assert by_table.json["contexts"] == {"online": "tried-online", "training": "tried-training"}
    assert both.status == loose.status == 0
    kept = enact("world", "get", "tried-online", "piece/1/weight", "--cell", weighed)
    assert kept.out.strip() == "18.0"
    for name in by_table.json["contexts"].values():
        assert enact("world", "drop", name, "--cell", weighed).status == 0


def test_exception_of_update_is_shown_with_its_lines(replay):
    """Status 1: there is nothing to compare."""
    found = replay("--actor", "weighing:Broken")

    assert found.status == 1
    assert 'raise RuntimeError("scale is off")' in found.out
    assert "update raised RuntimeError at " in found.out
    assert replay("--actor", "weighing:Broken", "--json").json["error"].endswith("scale is off")


def test_interrupt_names_the_contexts_that_could_not_be_dropped(
    replay, enact, weighed, monkeypatch
):
    """With the command that drops them; the status is that of an interrupt."""

    def interrupt(self, lock):
        raise KeyboardInterrupt

    def away(self, name):
        raise ShardUnreachableError("shard local does not answer", shard="local")

    from weighing import Weigh

    before = set(enact("world", "ls", "--cell", weighed).out.split())
    with monkeypatch.context() as patch:
        patch.setattr(Weigh, "update", interrupt)
        patch.setattr(Cell, "drop_world", away)
        found = replay("--actor", "weighing:Weigh")
    assert found.status == 130
    names = re.findall(r"enact world drop (step-[\w-]+)", found.err)
    assert len(names) == 2
    for name in names:
        assert enact("world", "drop", name, "--cell", weighed).status == 0
    assert set(enact("world", "ls", "--cell", weighed).out.split()) == before


@pytest.mark.parametrize(
    ("step", "words", "status", "text"),
    [
        ("piece/1/weight@1", ("--name", "scale"), 1, "online:piece/1/length_mm v1, which its"),
        ("piece/1/weight@9", ("--name", "scale"), 1, "has no version 9"),
        ("piece/7/weight", ("--name", "scale"), 1, "never set"),
        ("piece/1", ("--name", "scale"), 1, "piece/1 is null"),
        ("piece", ("--name", "scale"), 2, "--step: 'piece' is not written ENTITY/ASPECT"),
        ("piece/1/weight", (), 2, "which actor is to run?"),
        ("piece/1/weight", ("--name", "scales"), 2, "has no actor 'scales'"),
        ("piece/1/weight", ("--actor", "weighing:Nothing"), 2, "no actor class"),
        ("piece/1/length_mm", ("--name", "scale"), 1, "Weigh does not write online:piece/1/length"),
        ("piece/1/weight", ("--name", "scale", "--tolerance", "x=1"), 2, "names the aspect 'x'"),
        ("piece/1/weight", ("--name", "scale", "--keep-as", "a/b"), 1, "world context"),
        ("piece/1/weight", ("--name", "scale", "run.mcap"), 2, "either a recording or --step"),
    ],
)
def test_what_cannot_be_run_again_is_refused(replay, step, words, status, text):
    """By name, and with what to do."""
    found = replay(*words, step=step)

    assert (found.status, text in found.err) == (status, True), found.err


def test_neither_a_recording_nor_a_step_is_wrong_usage(enact):
    """One of the two has to be named."""
    assert enact("replay").status == 2


@pytest.mark.parametrize(
    "words",
    ["--speed 0", "--entities x", "--aspect x", "--from 1", "--to 2", "--loop", "--overwrite"],
)
def test_option_of_a_recording_is_refused_with_a_step(replay, words):
    """It would change nothing."""
    found = replay("--name", "scale", *words.split())

    assert found.status == 2
    assert f"options of a recording, not of --step: {words.split()[0]}" in found.err


@pytest.mark.parametrize(
    "words",
    ["--actor m:C", "--name n", "--option a=1", "--entity e", "--tolerance 1", "--keep-as k"],
)
def test_option_of_a_step_is_refused_with_a_recording(enact, words):
    """Before the recording is opened."""
    found = enact("replay", "run.mcap", *words.split())

    assert found.status == 2
    assert f"options of --step, not of a recording: {words.split()[0]}" in found.err


def test_view_of_the_step_has_its_data_at_once(weighed):
    """A step that is kept is a world context like any other."""
    from weighing import Weigh

    from enact_dist.actor.running.step import Step

    with connect(weighed) as cell:
        names = Step(cell, "online", "piece/1", "weight").run(Weigh(5.0), keep_as="seen").contexts
        weight = View(cell.world(names["online"]), PIECE, WEIGHT)
        assert cell.world(names["online"]).view(weight)[weight] == 45.0
        for name in names.values():
            cell.drop_world(name)


def test_a_wrong_step_becomes_null_on_request(replay, enact, weighed):
    """What was made of it, too.  This test is the last of the file: the cell is another one then."""
    with connect(weighed) as cell:
        online = cell.world("online")
        write = Write(online, PIECE, Aspect("verdict", str))
        with Lock(write, View(online, PIECE, WEIGHT)) as lock:
            lock[write] = "heavy"
    found = replay("--name", "scale", "--option", "factor=1.0", "--invalidate", "bad", "--json")

    assert found.status == 0
    made = [(one["aspect"], one["version"]) for one in found.json["invalidated"]]
    assert made == [("weight", 4), ("verdict", 1)]
    refused = enact("world", "get", "online", "piece/1/weight", "--cell", weighed)
    assert "is null (deleted)" in refused.err
