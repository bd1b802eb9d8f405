"""Claims about the demonstration around the cell: its configuration, its report, its run."""

import json
import re
import socket
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("open3d", exc_type=ImportError)

from actors.geometry.poses import looking_at
from actors.geometry.recognition.deviation import VERDICTS
from actors.geometry.shapes import VGA, Acquisition, DepthFrame, Surface
from actors.palletizing.demo.cell import watched_cell
from actors.palletizing.demo.packing import SEED, run_packing
from actors.palletizing.demo.pictures import model_picture, tray_picture
from actors.palletizing.demo.report import report_bytes, rows_of, score_of
from actors.palletizing.feedback import sentence
from actors.palletizing.simulation.packages import KINDS, package_sequence
from actors.palletizing.simulation.products import product_mesh
from actors.palletizing.vocabulary import Deviation, Notice
from actors.running_cell import DemoStore
from enact_dist.errors import ConfigError

sys.path.append(str(Path(__file__).parents[2] / "postgres"))
sys.path.append(str(Path(__file__).parent))

import list_cell
import postgres_nodes


def flag(verdict, product="milk_carton"):
    return Deviation("package/1", product, verdict, 12.3, 450.0, 1.5, 0.4, 7)


def test_ports_of_a_run_are_kept_while_it_runs(tmp_path, monkeypatch):
    """Nobody else gets them before its shards listen, or while one is started again."""
    started = []

    class Up:
        send_signal = wait = poll = staticmethod(lambda *_: None)

    monkeypatch.setattr(
        "actors.running_cell.subprocess",
        SimpleNamespace(
            Popen=lambda *_, **__: started.append(1) or Up(),
            STDOUT=subprocess.STDOUT,
            DEVNULL=subprocess.DEVNULL,
        ),
    )

    with list_cell.started(tmp_path, packages=1) as cell:
        shards = tomllib.loads(cell.config.read_text())["shards"].values()
        ports = [int(shard["listen"].rpartition(":")[2]) for shard in shards]
        for port in ports:
            with socket.socket() as other, pytest.raises(OSError, match="in use"):
                other.bind(("127.0.0.1", port))
    for port in ports:
        with socket.socket() as other:
            other.bind(("127.0.0.1", port))
    assert len(ports) == 2
    assert started == [1]


def test_shipped_cell_fits_together():
    """No two actors write one slot, every trigger is written, every option can be read."""
    from enact_dist.actor.check import check_cell
    from enact_dist.config.read import load_config

    assert [f.text for f in check_cell(load_config(list_cell.TEMPLATE)) if f.level == "error"] == []


def test_default_seed_shows_every_deviation():
    """The twelve packages of a plain run hold each kind of deviation and sound ones."""
    kinds = [package.truth.kind for package in package_sequence(12, seed=SEED)]

    assert set(kinds) == {"ok", *KINDS}


def test_report_counts_wrong_verdicts_and_false_alarms():
    """A sound package that was flagged is a false alarm; the score says so."""
    packages = package_sequence(3, seed=SEED)
    flags = {f"place/{stop}": flag("deformed") for stop in range(3)}
    notices = {place: Notice("text", 7, 100.0) for place in flags}

    rows = rows_of(packages, flags, notices)

    sound = sum(package.truth.kind == "ok" for package in packages)
    assert f"{sound} false alarms on {sound} sound packages" in score_of(rows)
    assert json.loads(report_bytes(rows, seed=SEED))["right"] == sum(row.correct for row in rows)


@pytest.mark.parametrize("verdict", VERDICTS)
def test_sentence_names_place_and_product(verdict):
    """Whatever was found, the user reads where and what."""
    text = sentence("place/3", flag(verdict))

    assert text.startswith("place/3: ")
    assert "milk_carton" in text


def test_model_picture_shows_faces_in_colours():
    """Two planar patches have two colours, free form a third."""
    vertices, triangles = product_mesh("milk_carton")
    patch = np.where(vertices[:, 2] > 0.069, 0, np.where(vertices[:, 1] < -0.047, 1, -1))
    surface = Surface(
        vertices.astype(np.float32), triangles, patch.astype(np.int32), np.zeros((2, 4))
    )

    picture = model_picture("milk_carton", surface)

    colourful = np.ptp(picture.astype(int), axis=2) > 40
    assert colourful.mean() > 0.02


def test_tray_picture_shows_the_whole_region_in_red(tray):
    """A deviating region is red, nothing else is, and the plate of its verdict hides none of it."""
    straight = Acquisition(VGA, looking_at(np.array([0.0, 0.0, 0.95]), np.zeros(3)))
    frame = DepthFrame(tray.capture_empty().depth_mm, straight)
    region = np.zeros(frame.depth_mm.shape, bool)
    region[180:290, 280:390] = True

    picture = tray_picture(frame, frame.depth_mm, [("place/0", flag("missing"), region)])

    red = (picture[..., 0] > 150) & (picture[..., 1] < 110)
    assert red.mean() > 0.01
    rows, columns = np.nonzero(red)
    height, width = np.ptp(rows) + 1, np.ptp(columns) + 1
    assert red.sum() > 0.9 * height * width, "something beside it is red, or part of it is hidden"


def test_deviation_is_the_same_in_the_table_and_in_the_line_for_the_user():
    """Rounded once: 5.746 mm is 5.7 mm everywhere, not 5.75 and then 5.8."""
    found = replace(flag("deformed"), deviation_mm=5.746)

    (row,) = rows_of(
        package_sequence(1, seed=SEED), {"place/0": found}, {"place/0": Notice("", 7, 1.0)}
    )

    assert sentence("place/0", found).startswith("place/0: milk_carton is deformed by 5.7 mm")
    assert f"{row.deviation_mm:.1f}" == "5.7"


def test_a_watched_cell_says_what_comes(tmp_path):
    """Packages and seed of a cell that others run are those of its own sensor."""
    file = tmp_path / "cell.toml"
    file.write_text(list_cell.shipped(5))

    watched = watched_cell(file)

    assert (watched.packages, watched.seed) == (5, SEED)


def test_a_cell_whose_truth_nobody_knows_is_not_scored(tmp_path):
    """A real sensor in the place of the simulated one is named."""
    file = tmp_path / "cell.toml"
    simulated = "actors.palletizing.simulation.sensors:tray_sensor?packages=12&seed=59"
    file.write_text(list_cell.shipped(12).replace(simulated, "plant.camera:overhead"))

    with pytest.raises(ConfigError, match=r"'plant\.camera:overhead', which names no packages"):
        watched_cell(file)


def test_demo_refuses_to_run_without_packages(tmp_path, capsys):
    """Nothing to judge is said so, before anything starts."""
    assert run_packing(out=tmp_path / "out", packages=0) == 1
    assert "--packages is 0" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.sampled(1, of="file")
def test_demo_runs_from_training_to_table(tmp_path, capsys):
    """Ten processes train two products and judge three packages; table, lineage and pictures."""
    status = list_cell.run(tmp_path, packages=3)

    printed = capsys.readouterr().out
    assert status == 0
    assert "3 of 3 verdicts right" in " ".join(printed.split())
    why, impact = printed.split("enact why online system/deviation")[1].split("enact impact")
    assert "online:place/2/observation v1" in why
    assert "training:view/milk_carton/0…13/surface v1  14 versions" in why
    assert "forgotten" not in why
    assert "training:product/milk_carton/surface v1" in impact
    assert "online:system/deviation v3" in impact
    report = json.loads((tmp_path / "report.json").read_text())
    assert [row["correct"] for row in report["packages"]] == [True] * 3
    for name in ("model_milk_carton.png", "model_meal_tray.png", "tray_1.png"):
        assert (tmp_path / name).stat().st_size > 20_000
    assert "Traceback" not in (tmp_path / "cell.log").read_text()


@pytest.mark.slow
@pytest.mark.timing
@pytest.mark.sampled(1, of="file")
def test_verdicts_are_right_through_a_takeover(tmp_path, capsys):
    """The daemons of both shards are killed in mid-run: their standbys serve, and nothing is lost."""
    pytest.importorskip("mujoco", exc_type=ImportError)
    if missing := postgres_nodes.why_missing():
        pytest.skip(missing)
    with postgres_nodes.two_nodes() as (node, _):
        store = DemoStore(node.url, fail_over_after=1)
        status = run_packing(out=tmp_path, packages=2, speed=1.5, store=store)
        left = node.execute("SELECT (SELECT count(*) FROM enact.shard), count(*) FROM enact.record")

    printed = " ".join(capsys.readouterr().out.split())
    assert status == 0
    assert re.search(r"(\d) of \1 verdicts right", printed), printed
    assert "killed after 1 packages: shards left" in printed
    log = (tmp_path / "cell.log").read_text()
    assert (
        re.findall(r"^(?:ready|standing by).* shard (\w+)", log, re.MULTILINE).count("left") == 2
    ), log
    assert "Traceback" not in log
    assert left == [(0, 0)], "rows of the run stay in the database"


@pytest.mark.slow
@pytest.mark.timing
@pytest.mark.sampled(1, of="file")
def test_robot_packs_from_training_to_table(tmp_path, capsys):
    """Sixteen actors train two products and pack two packages in physics; table, why, pictures."""
    pytest.importorskip("mujoco", exc_type=ImportError)
    status = run_packing(out=tmp_path, packages=2, seed=59, speed=1.5)

    printed = " ".join(capsys.readouterr().out.split())
    assert status == 0, printed
    right, placed = re.search(
        r"(\d) of \d verdicts right; (\d) of 2 packages placed as planned", printed
    ).groups()
    assert int(placed) >= 1, "one may slip, and none makes its neighbour fail"
    assert int(right) >= int(placed)
    assert "enact why online place/" in printed
    report = json.loads((tmp_path / "report.json").read_text())
    assert [row["place"] for row in report["packages"]] == [f"place/{n}" for n in range(2)]
    assert all(row["result"] for row in report["packages"])
    assert (tmp_path / "tray_1.png").stat().st_size > 20_000
    assert "system" in (tmp_path / "actors.svg").read_text()
    assert (tmp_path / "run.mcap").stat().st_size > 1_000_000
