"""`enact why` and `enact impact` against two real shards."""

import pytest

from enact_dist import Aspect, Entities, Entity, Lock, Read, ViewEach, Write, connect

COUNT = Aspect("count", int)
SUM = Aspect("sum", int)


@pytest.fixture(scope="module")
def cell(cell_file):
    """Views 0 to 4 make a model in another world context, and that two verdicts."""
    with connect(cell_file, actor="tester") as opened:
        training, online = opened.world("training"), opened.world("online")
        for number in range(5):
            view = Write(training, Entity(f"view/{number}"), COUNT)
            with Lock(view) as lock:
                lock.put(view, number, stamp_ns=1)
        views = ViewEach(training, Entities("view/*"), COUNT)
        model = Write(training, Entity("product/milk"), SUM)
        with Lock(views, model) as lock:
            lock[model] = sum(lock[views].values())
        read, verdict = Read(training, model.entity, SUM), Write(online, Entity("system"), SUM)
        for _ in range(2):
            with Lock(read, verdict) as lock:
                lock[verdict] = lock[read] + lock.get(verdict, 0)
        yield opened


@pytest.fixture
def ask(enact, cell, cell_file):
    """Call `enact … --cell FILE`."""
    return lambda *words: enact(*words, "--cell", cell_file)


def test_why_draws_the_causes_with_their_ages(ask):
    """Each line says what, how old and by whom; versions that are alike share one."""
    lines = ask("why", "online", "system/sum").out.splitlines()

    assert lines[0].startswith("online:system/sum v2  ")
    assert " ago  tester@" in lines[0]
    assert lines[1].startswith("  training:product/milk/sum v1  ")
    assert lines[2].startswith("    training:view/0…4/count v1  5 versions  ")
    assert lines[3].startswith("  online:system/sum v1  ")
    assert lines[4] == "    and, shown elsewhere: training:product/milk/sum v1"
    assert len(lines) == 5


def test_why_shows_all_on_request(ask):
    """`--all` gives each version its line, with when it was captured."""
    lines = ask("why", "online", "system/sum", "--all").out.splitlines()

    views = [line for line in lines if "training:view/" in line]
    assert [line.split()[0] for line in views] == [f"training:view/{n}/count" for n in range(5)]
    assert all("captured" in line for line in views)


def test_depth_is_said_where_the_tree_ends(ask):
    """Whoever wants to know more is told how much there is and by which option."""
    lines = ask("why", "online", "system/sum@1", "--depth", 1).out.splitlines()

    assert lines[-1] == "    … 5 more steps, with a larger --depth"


def test_why_as_json_is_the_whole_tree(ask, cell):
    """A program gets every version with its commit."""
    tree = ask("why", "online", "system/sum@1", "--json").json

    (model,) = tree["children"]
    assert (tree["version"], model["entity"], model["kind"]) == (1, "product/milk", "commit")
    assert [one["entity"] for one in model["children"]] == [f"view/{n}" for n in range(5)]
    assert {one["captured_ns"] for one in model["children"]} == {1}
    assert model["actor"] == "tester"
    assert model["age_s"] >= tree["age_s"]


def test_impact_names_what_came_of_a_datum(ask):
    """From one view over the model to every verdict that rests on it."""
    lines = ask("impact", "training", "view/3/count").out.splitlines()

    assert [line.split("  held")[0].split()[0] for line in lines] == [
        "training:view/3/count",
        "training:product/milk/sum",
        "online:system/sum",
        "and,",
        "online:system/sum",
    ]


def test_pinned_tree_is_listed_under_its_label(ask, cell):
    """`--pin` takes every version of the tree; `enact world pinned` shows them."""
    assert ask("why", "online", "system/sum@1", "--pin", "incident").status == 0

    kept = cell.pinned()["incident"]
    cell.unpin("incident")

    assert {str(version.slot) for version in kept} == {
        "online:system/sum",
        "training:product/milk/sum",
        *(f"training:view/{number}/count" for number in range(5)),
    }


@pytest.mark.parametrize(
    ("words", "status", "text"),
    [
        (("why", "online", "system/none"), 1, "online:system/none is null (never set)"),
        (("why", "nowhere", "system/sum"), 1, "no world context 'nowhere'"),
        (("impact", "online", "system/sum@9"), 1, "no version 9; the newest is 2"),
    ],
)
def test_what_is_not_there_is_refused(ask, words, status, text):
    """The error names what was asked and what there is."""
    done = ask(*words)

    assert (done.status, text in done.err) == (status, True), done.err


@pytest.mark.parametrize("slot", ["system", "system/sum@x", "system/sum@0", "system/sum@"])
def test_version_that_cannot_be_read_is_wrong_usage(ask, slot):
    """Status 2, as for every command line that cannot be read."""
    with pytest.raises(SystemExit) as left:
        ask("why", "online", slot)
    assert left.value.code == 2


def test_invalidate_shows_first_and_then_writes_null_where_the_wrong_is_shown(ask, cell, enact):
    """Over two shards; `why` names the label, and the label what was pinned."""
    online = cell.world("online")
    source, wrong = Read(online, Entity("lens/0"), SUM), Write(online, Entity("lens/0"), SUM)
    made = Write(online, Entity("lens/made"), SUM)
    with Lock(wrong) as lock:
        lock[wrong] = 7
    with Lock(source, made) as lock:
        lock[made] = 8
    words = ("invalidate", "online", "lens/0/sum", "--label", "bad-lens")

    shown = ask(*words, "--dry-run").out
    done = ask(*words)

    assert [line.split()[0] for line in shown.splitlines()] == [
        "online:lens/0/sum",
        "online:lens/made/sum",
    ]
    assert sorted(done.out.splitlines()) == [
        "online:lens/0/sum v1 is null now",
        "online:lens/made/sum v1 is null now",
        "pinned under bad-lens: online:lens/0/sum v1 and what was made of it",
    ]
    assert ask("why", "online", "lens/made/sum", "--json").json["actor"] == "invalidate/bad-lens"
    refused = ask("world", "get", "online", "lens/made/sum")
    assert (refused.status, "enact why online lens/made/sum" in refused.err) == (1, True)
    assert len(cell.pinned()["bad-lens"]) == 2
    assert ask(*words, "--json").status == 1  # the newest is the null: nothing of it was used
