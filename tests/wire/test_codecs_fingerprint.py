"""Codecs and fingerprints: which types may be data, under which name, and when two are the same."""

from __future__ import annotations

import enum
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path as Folder
from typing import Any, ClassVar, Optional

import numpy as np
import pytest
from numpy.typing import NDArray

from enact_dist import Aspect
from enact_dist.errors import DatumTypeError, MisuseError, ProtocolError
from enact_dist.wire.codecs import register_codec
from enact_dist.wire.fingerprint import UNCUT_CHARACTERS_MAX, fingerprint
from enact_dist.wire.payload import decode_datum, encode_datum


@dataclass(frozen=True)
class Point:
    xyz_m: NDArray[np.float64]
    label: Optional[str] = None  # noqa: UP045  # both spellings mean the same
    origin: ClassVar[int] = 0


@dataclass(frozen=True)
class Path:
    points: list[Point]
    by_name: dict[str, tuple[int, ...]]
    box: tuple[float, bool]
    extra: dict


class Marker(enum.Enum):
    LEFT = "left"


@dataclass(frozen=True)
class Marked:
    marker: Marker


@dataclass(frozen=True)
class Chain:
    next: Chain | None


@dataclass
class Thawed:
    x: int


@dataclass(frozen=True)
class Unresolved:
    x: Nowhere  # noqa: F821  # that is the point


# ---------------------------------------------------------------- fingerprints


@pytest.mark.parametrize(
    ("datum_type", "text"),
    [
        (int, "int"),
        (list, "list"),
        (object, "any"),
        (np.ndarray, "ndarray"),
        (NDArray[np.float32], "ndarray[float32]"),
        (NDArray[Any], "ndarray"),
        (list[int], "list[int]"),
        (Point, "Point{xyz_m:ndarray[float64],label:str?=}"),
        (Path, ("Path{points:list[Point{xyz_m:ndarray[float64],label:str?=}],"
                "by_name:dict[str,tuple[int,...]],box:tuple[float,bool],extra:dict}")),
    ],
)  # fmt: skip
def test_fingerprint_is_the_structure(datum_type, text):
    """Catalogues store these texts: they stay as they are; "=" marks a default."""
    assert fingerprint(datum_type) == text


def test_fingerprint_is_the_same_in_another_process():
    """Nothing of hashing or import order is in it."""
    folder = Folder(__file__).resolve().parent
    script = (
        f"import sys; sys.path[:0] = {[str(folder), str(folder.parents[1])]}\n"
        "from enact_dist.wire.fingerprint import fingerprint\n"
        "from test_codecs_fingerprint import Path\n"
        "print(fingerprint(Path))"
    )

    out = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=30
    )

    assert out.stdout.strip() == fingerprint(Path)


def test_fingerprint_of_a_large_type_is_bounded_and_still_tells_apart():
    """Long structures end in a digest of the whole."""
    names = [f"field_{index}" for index in range(300)]
    one, other = (
        dataclass(frozen=True)(
            type("Wide", (), {"__annotations__": dict.fromkeys(names, int) | last})
        )
        for last in ({"last": int}, {"last": str})
    )

    assert len(fingerprint(one)) < UNCUT_CHARACTERS_MAX + 100
    assert fingerprint(one) != fingerprint(other)


@pytest.mark.parametrize(
    ("datum_type", "message"),
    [
        (Thawed, "Thawed is not frozen; .*@dataclass"),
        (Chain, "Chain contains itself; refer to others by entity name"),
        (Unresolved, "Unresolved.*'Nowhere'"),
        (Marked, r"Marked\.marker: Marker cannot be part of a datum.*register_codec\(\)"),
        (set, "set cannot be a datum"),
        (tuple, "tuple cannot be a datum"),
        (type(None), "cannot be a datum"),
        (frozenset, "frozenset cannot be a datum"),
        (dict[float, int], "keys of a dict are str or int, not float"),
        (int | str, "cannot be a datum"),
        (int | None, "cannot be a datum"),
        ([int], "is no type"),
        (5, "cannot be a datum"),
    ],
)
def test_type_that_cannot_be_a_datum_is_refused(datum_type, message):
    """The message names the part and the way out."""
    with pytest.raises(DatumTypeError, match=message):
        fingerprint(datum_type)


# ---------------------------------------------------------------- codecs


def test_codec_changes_how_a_type_is_read_from_then_on():
    """A dataclass that was refused is a datum after its field's type has a codec."""

    class Tag(enum.Enum):
        A = "a"

    @dataclass(frozen=True)
    class Tagged:
        tag: Tag

    Tagged.__annotations__["tag"] = Tag
    with pytest.raises(DatumTypeError):
        fingerprint(Tagged)
    register_codec(Tag, "tag", encode=lambda tag: tag.value, decode=Tag)

    assert fingerprint(Tagged) == "Tagged{tag:<tag>}"
    assert decode_datum(encode_datum(Tagged(Tag.A), Tagged), Tagged) == Tagged(Tag.A)


def test_codec_can_be_registered_again_under_its_name():
    """A module that is loaded twice does no harm; the newest functions count."""

    class Grid:
        def __init__(self, size):
            self.size = size

    register_codec(Grid, "grid", encode=lambda _: 0, decode=Grid)
    assert decode_datum(encode_datum([Grid(5)], list[Grid]), list[Grid])[0].size == 0
    register_codec(Grid, "grid", encode=lambda grid: grid.size, decode=Grid)

    assert decode_datum(encode_datum(Grid(5), Grid), Grid).size == 5
    assert decode_datum(encode_datum([Grid(5)], list[Grid]), list[Grid])[0].size == 5


def test_codec_name_belongs_to_one_type():
    """Two types under one name could not be told apart; one type has one name."""

    class One: ...

    class Other: ...

    register_codec(One, "one", encode=str, decode=lambda _: One())

    with pytest.raises(MisuseError, match=r"'one' belongs to .*One; asked for .*Other"):
        register_codec(Other, "one", encode=str, decode=lambda _: Other())
    with pytest.raises(MisuseError, match="has the codec 'one' already"):
        register_codec(One, "two", encode=str, decode=lambda _: One())


@pytest.mark.parametrize("datum_type", [int, list, dict, object, type(None), "int", list[int]])
def test_codec_is_refused_for_plain_types(datum_type):
    """Plain types have one meaning everywhere."""
    with pytest.raises(MisuseError, match="needs no codec"):
        register_codec(datum_type, "plain", encode=str, decode=str)


@pytest.mark.parametrize("name", ["", "a b", "a/b", "x" * 101, "<a>", "-a"])
def test_codec_name_is_refused_when_it_cannot_stand_in_a_fingerprint(name):
    """Names are short and free of the signs of fingerprints."""
    with pytest.raises(MisuseError, match="cannot name a codec"):
        register_codec(Marker, name, encode=str, decode=Marker)


def test_codec_that_makes_no_plain_data_is_refused_by_name():
    """The part that is not plain is named, with the codec."""

    class Odd: ...

    register_codec(Odd, "odd", encode=lambda _: {"a": {1, 2}}, decode=lambda _: Odd())

    with pytest.raises(DatumTypeError, match=r"as codec odd encodes it.*\['a'\]: asked a plain"):
        encode_datum(Odd(), Odd)


def test_codec_that_refuses_what_came_is_a_protocol_error():
    """Plain data that the codec cannot decode were not made by it."""

    class Even:
        def __init__(self, number):
            if number % 2:
                raise ValueError("odd")
            self.number = number

    register_codec(Even, "even", encode=lambda even: even.number + 1, decode=Even)

    with pytest.raises(ProtocolError, match="codec even cannot decode: ValueError"):
        decode_datum(encode_datum(Even(2), Even), Even)


# ---------------------------------------------------------------- aspects


@dataclass(frozen=True)
class Holder:
    parts: list[dict[str, tuple[Thawed | None, ...]]]


@pytest.mark.parametrize(
    ("datum_type", "message"),
    [
        (Thawed, r"aspect 'pose': dataclass Thawed is not frozen, .*@dataclass\(frozen=True\)"),
        (list[Thawed], "dataclass Thawed is not frozen"),
        (Holder, r"aspect 'pose': Holder\.parts: dataclass Thawed is not frozen"),
    ],
)
def test_aspect_of_a_dataclass_that_is_not_frozen_is_refused(datum_type, message):
    """Where the aspect is made, and not in the first lock of a program that runs."""
    for _ in range(2):
        with pytest.raises(DatumTypeError, match=message):
            Aspect("pose", datum_type)


def test_aspect_takes_a_type_whose_annotations_cannot_be_read_yet():
    """What it contains is looked at in its first use, when all classes are there."""
    assert Aspect("pose", Unresolved).datum_type is Unresolved
    assert Aspect("pose", Path).datum_type is Path


def test_aspect_takes_a_dataclass_that_has_a_codec_though_it_is_not_frozen():
    """The codec makes plain data of it, nested or not."""

    @dataclass
    class Loose:
        x: int

    with pytest.raises(DatumTypeError, match=r"first call register_codec\(.*Loose, …\)"):
        Aspect("pose", Loose)
    register_codec(Loose, "loose", encode=lambda loose: loose.x, decode=Loose)

    assert Aspect("pose", list[Loose]).datum_type == list[Loose]
