"""Data shown and saved by the command line."""

import json
import math

import numpy as np
import pytest

from enact_dist.cli.text import showing
from enact_dist.errors import ConfigError, StoreError

DATUM = {
    "__type__": "Surface",
    "vertices_m": np.linspace(0.0, 1.0, 30).reshape(10, 3),
    "triangles": np.zeros((0, 3), np.int32),
    "normal": np.array([0.0, 0.0, 1.0]),
    "name": "milk",
    "blob": bytes(20),
    "parts": [{"x": 1}, {"x": 2}],
    "tags": ["a", "b"],
}


def test_lines_summarise_arrays_and_nest_fields():
    """People see type, fields, shapes and ranges, not thousands of numbers."""
    assert list(showing.lines(DATUM)) == [
        "Surface",
        "  vertices_m: array 10 x 3 float64, 0.0 to 1.0",
        "  triangles: array 0 x 3 int32, empty",
        "  normal: array 3 float64 [0.0, 0.0, 1.0]",
        "  name: milk",
        "  blob: 20 bytes 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 …",
        "  parts: 2 elements",
        "    [0]:",
        "      x: 1",
        "    [1]:",
        "      x: 2",
        "  tags: ['a', 'b']",
    ]


def test_summary_counts_what_is_not_finite_and_shortens_text():
    """Not-a-numbers do not spoil the range, and a long text is cut and counted."""
    array = np.arange(20.0)
    array[3] = np.nan

    assert showing.summary(array) == "array 20 float64, 0.0 to 19.0, 1 not finite"
    assert showing.summary(np.full(20, np.nan)) == "array 20 float64, none finite, 20 not finite"
    assert showing.summary("x" * 500).endswith("… (100 more characters)")
    assert showing.summary(np.array(7)) == "array scalar int64 7"


def test_plain_can_be_dumped_as_json():
    """Every datum has a JSON form, arrays by dtype, shape and range."""
    found = json.loads(json.dumps(showing.plain(DATUM)))

    assert found["vertices_m"] == {
        "dtype": "float64", "shape": [10, 3], "min": 0.0, "max": 1.0, "finite": 30
    }  # fmt: skip
    assert found["normal"]["values"] == [0.0, 0.0, 1.0]


def test_save_writes_arrays_as_npz_and_the_rest_as_json(tmp_path):
    """An .npz holds every array under its path; a .json holds everything."""
    assert "vertices_m (10, 3)" in showing.save(DATUM, str(tmp_path / "a.npz"))
    showing.save(DATUM, str(tmp_path / "a.json"))

    saved = np.load(tmp_path / "a.npz")
    assert sorted(saved) == ["normal", "triangles", "vertices_m"]
    assert (saved["vertices_m"] == DATUM["vertices_m"]).all()
    assert (
        json.loads((tmp_path / "a.json").read_text())["vertices_m"] == DATUM["vertices_m"].tolist()
    )


@pytest.mark.parametrize(
    ("value", "text"),
    [(1 + 2j, "(1+2j)"), (np.datetime64("2026-11-29"), "2026-11-29"), (np.longdouble(1.5), "1.5")],
)
def test_save_writes_what_json_does_not_have_as_text(value, text, tmp_path):
    """Complex numbers, dates and numbers of more than 64 bits, as `--json` prints them."""
    showing.save(np.array([value]), str(tmp_path / "a.json"))
    assert json.loads((tmp_path / "a.json").read_text()) == [text]


@pytest.mark.parametrize(
    ("datum", "name", "reason"),
    [
        (3, "a.npz", "holds no array"),
        (3, "a.npy", "is no array"),
        (3, "a.txt", "the ending says how"),
    ],
)
def test_save_is_refused_when_the_format_cannot_hold_it(datum, name, reason, tmp_path):
    """Nothing is written where the ending does not fit."""
    with pytest.raises(ConfigError, match=reason):
        showing.save(datum, str(tmp_path / name))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", [".npy", ".npz", ".json"])
def test_a_disk_that_refuses_is_told_with_the_file(ending, tmp_path):
    """What numpy says of a full disk is two numbers."""
    path = tmp_path / "away" / f"a{ending}"
    with pytest.raises(StoreError, match=f"cannot write {path}: No such file"):
        showing.save(np.zeros(3), str(path))


@pytest.mark.parametrize("hostile", ["\x1b[2J", "\x9b1m", "\r", "\u202e", "\x07"])
def test_a_text_steers_no_terminal(hostile):
    """Neither as a datum nor as a key, however deep; its lines and letters stay what they are."""
    datum = {hostile: [f"a{hostile}\tb\nü"], "__type__": hostile}
    for shown in (*showing.lines(datum), showing.one_line(datum), *showing.lines(hostile)):
        assert hostile not in shown
    assert showing.visible(f"a{hostile}") == "a" + ascii(hostile)[1:-1]
    assert showing.visible("ü\ttab\nline") == "ü\ttab\nline"


def test_plain_data_are_json_though_numbers_are_not_finite():
    """`NaN` without quotes is no JSON: most programs refuse the whole line."""
    datum = {"a": math.nan, "b": [math.inf, -math.inf, 1.5], "c": np.array([1.0, math.nan])}

    plain = json.loads(json.dumps(showing.plain(datum), allow_nan=False))

    assert (plain["a"], plain["b"]) == ("NaN", ["Infinity", "-Infinity", 1.5])
    assert plain["c"]["values"] == [1.0, "NaN"]
