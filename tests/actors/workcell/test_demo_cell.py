"""The cell of the demo: its file, its processes and cameras fit together."""

import tomllib

import numpy as np
import pytest

pytest.importorskip("cv2", exc_type=ImportError)
pytest.importorskip("mcap", exc_type=ImportError)

from actors.running_cell import toml_of
from actors.workcell import vocabulary as words
from actors.workcell.demo.cell import TEMPLATE, configured
from actors.workcell.demo.options import Options
from actors.workcell.scenarios import scenario_of
from actors.workcell.scores.figures import figure4
from actors.workcell.setup import Setup, grid_of
from enact_dist import testing
from enact_dist.actor.check import check_cell, declarations_of
from enact_dist.config.read import load_config
from enact_dist.errors import ConfigError
from enact_dist.recording.drawing.drawables import drawables_of
from enact_dist.wire.payload import decode_untyped, encode_datum


def test_shipped_cell_fits_together():
    """No two actors write one slot, every trigger is written, every option can be read."""
    assert [f.text for f in check_cell(load_config(TEMPLATE)) if f.level == "error"] == []


def test_cell_of_a_run_differs_only_in_what_a_run_chooses(tmp_path):
    """Scenario, seed, length, grid and source are the run's; all else is the shipped cell."""
    shipped = tomllib.loads(TEMPLATE.read_text())
    options = Options(
        tmp_path, scenario="S3", seed=5, seconds=9.0, source="live", voxel_m=0.05, separate=True
    )

    run = configured(TEMPLATE.read_text(), options)

    assert run["actors"]["setup"].pop("args") == {
        "scenario": "S3",
        "seed": 5,
        "seconds": 9.0,
        "voxel_m": 0.05,
        "scale": 1.0,
    }
    shipped["actors"]["setup"].pop("args", None)
    assert run["aspects"]["hull"].pop("voxel_m") == 0.05  # what shows the hull draws it as large
    assert shipped["aspects"]["hull"].pop("voxel_m") == Options(tmp_path).voxel_m
    for number in range(words.CAMERA_COUNT):
        assert run["actors"][f"camera-{number}"].pop("args")["source"] == "live"
        shipped["actors"][f"camera-{number}"].pop("args")
    assert run == shipped


@pytest.mark.parametrize("separate", [False, True])
def test_both_layouts_of_the_cameras_fit_together(tmp_path, separate):
    """A smart camera stands in for three actors; what else there is, is the same."""
    from enact_dist.actor.check import check_cell
    from enact_dist.config.read import load_config

    config = configured(TEMPLATE.read_text(), Options(tmp_path, separate=separate))
    (tmp_path / "cell.toml").write_text(toml_of(config))

    assert len(config["actors"]) == 34 - (0 if separate else 2 * words.CAMERA_COUNT)
    found = check_cell(load_config(tmp_path / "cell.toml"))
    assert [one.text for one in found if one.level == "error"] == []


def test_where_a_person_will_be_is_drawn_on_the_floor():
    """As `enact view` and a recording read the shipped cell."""
    aspects = {aspect.name: aspect.shows for aspect in load_config(TEMPLATE).aspects}
    ahead_s = np.linspace(0.1, 1.0, 10)
    centre_m = np.stack((1.2 * ahead_s, 0.5 - ahead_s), axis=1)
    prediction = words.Prediction(ahead_s, centre_m, np.full(10, 0.4))
    value = decode_untyped(encode_datum(prediction, words.Prediction))

    shows = aspects[words.PREDICTION.name]
    path = drawables_of(value, shows)["trajectory"]

    assert np.array_equal(path.places_m, np.column_stack((centre_m, np.zeros(10))))
    assert shows.frame_of("human/1") == "cell"


def test_decisions_are_made_without_the_truth():
    """Only what simulates a camera or a body names the context of the truth."""
    tables = tomllib.loads(TEMPLATE.read_text())["actors"]
    naming = {name for name, table in tables.items() if "truth" in table["worlds"]}
    simulators = {name for name, table in tables.items() if ".simulation." in table["class"]}
    assert naming == simulators | {"setup"}


def test_faults_name_processes_of_the_cell():
    """What a scenario kills is an actor or a shard of the shipped cell."""
    config = tomllib.loads(TEMPLATE.read_text())
    for name in ("S7", "S8"):
        for fault in scenario_of(name, 1).faults:
            assert fault.target in {*config["actors"], *config["shards"]}


def test_set_up_writes_what_is_known_and_lets_nothing_play():
    """Eight calibrations, boxes, grid, arm, task; the scenario has not begun."""
    with testing.worlds("online", "truth") as cell:
        testing.run_once(Setup("S2", 3, 12.0), cell)
        online, truth = cell.world("online"), cell.world("truth")
        assert len(online.list_slots(words.CAMERAS, ("calibration",))) == words.CAMERA_COUNT
        assert online.history(words.WORKSPACE, words.EMPTY) == ()
        playing = truth.history(words.SCENARIO, words.PLAYING)[0].datum()
        assert (playing.scenario, playing.seed, playing.seconds) == ("S2", 3, 12.0)
        assert playing.start_ns > 1 << 61


def test_a_grid_holds_whole_blocks():
    """Each side is a multiple of four voxels and covers the volume."""
    grid = grid_of(0.03)
    assert all(size % 4 == 0 for size in grid.shape)
    assert (np.array(grid.shape) * 0.03 >= [4.0, 4.0, 2.2]).all()
    with pytest.raises(ValueError, match="longer than 0"):
        grid_of(0.0)


def test_faults_do_not_go_with_one_process(tmp_path):
    """A scenario that kills processes needs them."""
    with pytest.raises(ConfigError, match="--embedded has one"):
        Options(tmp_path, scenario="S7", embedded=True)


def test_figure_4_is_drawn_from_the_declarations():
    """Every entity of the cell, and every class of its actors, is in the picture."""
    picture = figure4(TEMPLATE).decode()
    actors = {one.class_path.rpartition(":")[2] for one in load_config(TEMPLATE).actors}
    assert picture.startswith("<svg")
    assert {name for name in actors if name not in picture} == set()


def test_the_cell_of_four_cameras_is_sound(tmp_path):
    """Tables of four cameras and the option of two actors make it; nothing waits for others."""
    config = tomllib.loads(TEMPLATE.read_text())
    actors = config["actors"]
    for name in list(actors):
        if name.rpartition("-")[2] in {"4", "5", "6", "7"}:
            del actors[name]
    for name in ("setup", "reconstruction"):
        actors[name].setdefault("args", {})["cameras"] = 4
    path = tmp_path / "cell.toml"
    path.write_text(toml_of(config))

    found = load_config(path)

    declared, wrong = declarations_of(found)
    assert wrong == []
    silhouettes = {
        str(request.entity)
        for actor in declared
        if actor.name == "reconstruction"
        for request in actor.actor_class.declaration.requests.values()
        if request.aspect.name == "silhouette"
    }
    assert silhouettes == {f"camera/{number}" for number in range(4)}
    assert [one for one in check_cell(found) if one.level == "error"] == []


def test_images_may_be_smaller_where_they_are_drawn_live(tmp_path):
    """Views that were drawn before have their size."""
    live = Options(tmp_path, source="live", scale=0.5)

    assert configured(TEMPLATE.read_text(), live)["actors"]["setup"]["args"]["scale"] == 0.5
    with pytest.raises(ConfigError, match="draw smaller ones with --live"):
        Options(tmp_path, scale=0.5)
    with pytest.raises(ConfigError, match=r"may be 0\.25 to 1"):
        Options(tmp_path, source="live", scale=2.0)
