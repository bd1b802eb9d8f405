"""Literals of the command line, read by the type of their aspect."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from enact_dist.cli.text import literals
from enact_dist.core.protocol.messages import AspectEntry
from enact_dist.errors import ConfigError, DatumTypeError, MisuseError
from enact_dist.wire.fingerprint import fingerprint
from enact_dist.wire.payload import encode_datum

TYPES = [
    int, float, bool, str, bytes, list, dict, np.ndarray, list[int], dict[str, float],
    dict[int, list[str]], list[Any], tuple[int, float], tuple[float, ...], NDArray[np.float32],
    list[tuple[str, dict[str, int]]],
]  # fmt: skip


@pytest.mark.parametrize("datum_type", TYPES, ids=str)
def test_type_of_a_fingerprint_is_the_type_that_has_it(datum_type):
    """Every fingerprint of plain data leads back to a type with the same fingerprint."""
    assert fingerprint(literals.type_of("a", fingerprint(datum_type))) == fingerprint(datum_type)


@pytest.mark.parametrize("text", ["Surface{vertices_m:ndarray}", "<pose>", "list[Pose{x:float}]"])
def test_type_of_a_record_is_refused(text):
    """A record cannot be written here, and the error says how it can."""
    with pytest.raises(MisuseError, match="write it from Python"):
        literals.type_of("surface", text)


@pytest.mark.parametrize(
    ("text", "datum_type", "value"),
    [
        ("3", int, 3),
        ("3", float, 3.0),
        ("true", bool, True),
        ('"a b"', str, "a b"),
        ("[1, 2]", list, [1, 2]),
        ("[1, 2.5]", list[float], [1.0, 2.5]),
        ('{"1": 2}', dict[int, int], {1: 2}),
        ("[1, 2]", tuple[int, float], (1, 2.0)),
        ("[1, 2]", tuple[float, ...], (1.0, 2.0)),
    ],
)
def test_literal_becomes_the_nearest_value_of_the_type(text, datum_type, value):
    """JSON has one kind of number, no tuples and only text keys; the type says what is meant."""
    found = literals.read(text, datum_type)

    assert found == value
    assert type(found) is type(value)


def test_literal_of_an_array_has_the_dtype_of_the_aspect():
    """A list becomes an array, of the aspect's dtype where it names one."""
    found = literals.read("[[1, 2], [3, 4]]", NDArray[np.float32])

    assert (found.dtype, found.shape) == (np.float32, (2, 2))


def test_whole_number_that_no_float_holds_is_refused_like_any_value():
    """It stays what it is, and the check of the datum names it."""
    with pytest.raises(DatumTypeError, match="asked float, found int 1000"):
        encode_datum(literals.read("1" + "0" * 400, float), float)


def test_null_means_nothing():
    """The literal null is the order to delete."""
    assert literals.read("null", int) is literals.NOTHING


@pytest.mark.parametrize(
    ("text", "datum_type", "error", "reason"),
    [
        ("abc", str, ConfigError, "is no JSON literal.*a text needs quotes"),
        ("[1", list, ConfigError, "is no JSON literal"),
        ('{"a": 1}', dict[int, int], DatumTypeError, "key 'a': asked int, found str"),
        ('["a"]', NDArray[np.float64], DatumTypeError, "asked an array"),
        ("[[1], [1, 2]]", np.ndarray, DatumTypeError, "asked an array"),
        ("[1, 300]", NDArray[np.uint8], DatumTypeError, "array of uint8.*: 300 is no uint8"),
        ("[1.5]", NDArray[np.int32], DatumTypeError, "1.5 is no int32"),
        ("[1e300]", NDArray[np.float32], DatumTypeError, r"1e\+300 is no float32"),
        ("[true]", NDArray[np.float64], DatumTypeError, "True is no float64"),
        ('["1"]', NDArray[np.int64], DatumTypeError, "'1' is no int64"),
        ("[null]", NDArray[np.float64], DatumTypeError, r"found \[None\]"),
        ('{"a": 1}', NDArray[np.float64], DatumTypeError, "found {'a': 1}"),
        ("1" * 5000, int, ConfigError, "1{60}… is no JSON literal"),
        ("[" * 100_000, list, ConfigError, r"\[{60}… is no JSON literal"),
        ("@/nowhere.npy", np.ndarray, ConfigError, "cannot read /nowhere.npy"),
    ],
)
def test_literal_is_refused_with_its_text(text, datum_type, error, reason):
    """What cannot be read is named."""
    with pytest.raises(error, match=reason):
        literals.read(text, datum_type)


def test_files_are_read_by_their_ending(tmp_path):
    """.npy gives the array, .json the literal, anything else text or bytes by the type."""
    np.save(tmp_path / "a.npy", np.eye(2))
    (tmp_path / "b.json").write_text("[1]", encoding="utf-8")
    (tmp_path / "c").write_bytes(b"hello")

    assert (literals.read(f"@{tmp_path}/a.npy", np.ndarray) == np.eye(2)).all()
    assert literals.read(f"@{tmp_path}/b.json", list) == [1]
    assert literals.read(f"@{tmp_path}/c", str) == "hello"
    assert literals.read(f"@{tmp_path}/c", bytes) == b"hello"


def test_file_that_is_no_array_is_named(tmp_path):
    """An empty .npy, as a full disk leaves it, and an archive under that name are refused."""
    (tmp_path / "empty.npy").touch()
    with (tmp_path / "more.npy").open("wb") as file:
        np.savez(file, a=np.eye(2))

    for name, reason in (("empty", "No data left in file"), ("more", "is an archive")):
        with pytest.raises(ConfigError, match=f"cannot read .*{name}.npy: .*{reason}"):
            literals.read(f"@{tmp_path}/{name}.npy", np.ndarray)


def test_pickled_array_is_refused(tmp_path):
    """An .npy of objects would be a pickle: it is never loaded."""
    np.save(tmp_path / "a.npy", np.array([{}], dtype=object), allow_pickle=True)

    with pytest.raises(ConfigError, match="cannot read"):
        literals.read(f"@{tmp_path}/a.npy", np.ndarray)


def test_new_aspect_takes_the_type_of_the_value():
    """--new registers an unknown aspect by its first value, which null does not have."""
    known = {"b": AspectEntry("b", "int", "os"), "c": AspectEntry("c", "", "os")}
    assert literals.type_to_put("a", {}, "3", new=True) is int
    with pytest.raises(MisuseError, match=r"no aspect 'a' is registered \(known: b\)"):
        literals.type_to_put("a", known, "3", new=False)
    with pytest.raises(MisuseError, match="null does not tell"):
        literals.type_to_put("a", {}, "null", new=True)
