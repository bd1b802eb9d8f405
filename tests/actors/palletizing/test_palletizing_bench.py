"""What `enact bench palletizing` makes of scores: rows, goals, and what has no case."""

import types

import pytest

from actors.palletizing.trials import packing_scores, perception_scores
from actors.palletizing.trials.packing_records import Judgement, Packed
from actors.palletizing.trials.perception_scores import Scored
from enact_dist.bench.cases.palletizing import run_palletizing
from enact_dist.bench.run import PackingOptions
from enact_dist.errors import MisuseError

pytest.importorskip("mujoco", exc_type=ImportError)


def rows_of(asked):
    """Return the rows of a bench by what they are of."""
    rows = []
    run = types.SimpleNamespace(packing=asked, told=lambda _: None, add_row=rows.append)
    run_palletizing(run)
    return {row.variant: row for row in rows}


def test_packing_gives_a_row_per_score_and_per_cell_of_the_table(monkeypatch, tmp_path):
    """A score without a case has no value, and one without a goal has none to meet."""
    asked = PackingOptions(60, 7, 1, provoke=("moved",), out=tmp_path / "scores")
    played = []

    def play(trays, **options):
        played.append((trays, options["out"]))
        moved = Judgement(0, "ok", "moved", 12.0, 0.0, 0.1, 0.0, 9.0)
        return {trays[3]: [Packed(0, "milk_carton", 0.2, judgements=[moved], knock="moved")]}

    monkeypatch.setattr(packing_scores, "played", play)
    rows = rows_of(asked)

    [(trays, out)] = played
    assert [tray.provoked for tray in trays] == [(), (), (), ("moved",), ()]
    assert out.is_dir()
    assert rows["truth moved, judged ok"].value == 1
    recall = rows["moved: recall, share"]
    assert (recall.value, recall.goal, recall.met) == (0.0, "≥ 0.99", False)
    nothing = rows["sound packages that were flagged, share"]
    assert (nothing.value, nothing.met, nothing.note) == (None, None, "no case")
    assert rows["moved: cases"].goal is None


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        (PackingOptions(36, provoke=("moved",)), "with 36 packages; .* needs 37 packages or more"),
        (PackingOptions(perception=True, provoke=("moved",)), "about packing"),
    ],
)
def test_options_that_would_do_nothing_are_refused(asked, why):
    """Provoking needs enough packages, and packing rather than perception alone."""
    with pytest.raises(MisuseError, match=why):
        rows_of(asked)


def test_perception_is_scored_on_faces_noise_light_and_contact():
    """A thousand packages come with 200 dents each of 3 and 4 mm, and each series has its seed."""
    series = perception_scores.series_of(1000, 7001)
    by_name = {each.name: each for each in series}

    assert by_name["mixed"].packages == 1000
    assert by_name["dent 3 mm"].packages == by_name["dent 4 mm"].packages == 200
    assert {each.light.noise for each in series} >= {0.5, 1.0, 2.0}
    assert max(each.light.dropout_share for each in series) == 0.20
    assert by_name["touching"].touching
    assert len({each.seed for each in series}) == len(series)


def test_perception_alone_gives_rows_for_each_series(monkeypatch):
    """Right verdicts, false alarms, poses and pairs of truth and verdict, under its name."""
    (series,) = (s for s in perception_scores.series_of(8, 7001) if s.name == "mixed")
    sound = [Scored("milk_carton", "ok", 0.0, "ok", mm / 10, 0.1) for mm in range(8)]
    missed = Scored("milk_carton", "missing", 0.0, "ok", 0.0, 0.1)
    monkeypatch.setattr(
        perception_scores, "played", lambda *_, **__: iter([(series, [*sound, missed])])
    )
    rows = rows_of(PackingOptions(8, 1, perception=True))
    name = f"{series.name}, seed {series.seed}"
    assert rows[f"{name}: right"].value == pytest.approx(800 / 9)
    assert rows[f"{name}: right"].met is False
    assert rows[f"{name}: false alarms"].met is True
    assert rows[f"{name}: pose, p95"].value == pytest.approx(0.665)
    assert rows[f"{series.name}: truth missing, judged ok"].value == 1
