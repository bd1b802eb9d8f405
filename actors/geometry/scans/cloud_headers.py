"""Judge a PCD or PLY file by its header and length before anything decodes it.

Needed because Open3D 0.20 answers a file that was cut off with memory it never wrote: a PLY cut
in half came back with all its 200 points, half of them noise, and no error.

The length check is exact for PCD and for PLY files without lists; for meshes it is a lower bound
(triangles), so the decoder checks the indices as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.files import InputFileError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

HEADER_BYTES_MAX: Final = 65_536
"""PLY headers carry comments; none seen was longer than 2 kB."""

PLY_BYTES: Final = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64", "int64", "uint64"), 8),
}


@dataclass(frozen=True, slots=True)
class CloudHeader:
    """What a header promises.

    Attributes:
        points: Points or vertices.
        faces: Faces, 0 for a cloud.
        eye_m: Where the one camera stood that took the cloud, if the file says so: an organised
            PCD (rows and columns of an image) with its VIEWPOINT.
    """

    points: int
    faces: int = 0
    eye_m: tuple[float, float, float] | None = None


def checked_header(path: Path, *, asked: str) -> CloudHeader:
    """Read the header of a PCD or PLY file and check that the file is long enough for it.

    Args:
        path: File ending in `.pcd` or `.ply`.
        asked: What the file should be, for the message.

    Raises:
        InputFileError: No such header, or the file ends before its data do.
    """
    with path.open("rb") as file:
        start = file.read(HEADER_BYTES_MAX)
    pcd = path.suffix.lower() == ".pcd"
    try:
        header, need, have, unit = _pcd(path, start) if pcd else _ply(path, start)
    except (ValueError, KeyError, IndexError) as error:
        raise InputFileError(
            path,
            asked=asked,
            found=f"no sound header of a {path.suffix} file ({error})",
            remedy="the file is of another kind or damaged: export it again",
        ) from error
    if have < need:
        raise InputFileError(
            path,
            asked=asked,
            found=f"{have} {unit} of data where its header needs {need}",
            remedy="the file is cut off: copy or export it again",
        )
    return header


def _pcd(path: Path, start: bytes) -> tuple[CloudHeader, int, int, str]:
    """Return what a PCD promises, how much data it needs, and how much it has."""
    fields: dict[str, list[str]] = {}
    offset = 0
    while "DATA" not in fields:
        end = start.find(b"\n", offset)
        if end < 0:
            raise ValueError("it ends before the line DATA")
        words = start[offset:end].decode("ascii").split()
        offset = end + 1
        if words and not words[0].startswith("#"):
            fields[words[0]] = words[1:]
    if not {"x", "y", "z"} <= set(fields["FIELDS"]):
        raise ValueError(f"fields {' '.join(fields['FIELDS'])} without x, y, z")
    header = CloudHeader(int(fields["POINTS"][0]), eye_m=_eye(fields))
    counts = [int(count) for count in fields.get("COUNT", ["1"] * len(fields["SIZE"]))]
    sizes = [int(size) for size in fields["SIZE"]]
    point_bytes = sum(size * count for size, count in zip(sizes, counts, strict=True))
    have = path.stat().st_size - offset
    match fields["DATA"][0]:
        case "ascii":
            return header, header.points, _lines(path, offset), "lines"
        case "binary":
            need = header.points * point_bytes
        case "binary_compressed":
            packed, unpacked = np.frombuffer(start[offset : offset + 8].ljust(8, b"\0"), "<u4")
            if header.points and unpacked != header.points * point_bytes:
                raise ValueError(f"{unpacked} bytes announced for {header.points} points")
            need = int(packed) + 8
        case other:
            raise ValueError(f"data are {other!r}")
    return header, need, have, "bytes"


def _eye(fields: dict[str, list[str]]) -> tuple[float, float, float] | None:
    """Return the camera position of an organised PCD."""
    if int(fields.get("HEIGHT", ["1"])[0]) <= 1:
        return None
    x, y, z = (float(word) for word in fields.get("VIEWPOINT", ["0", "0", "0"])[:3])
    return x, y, z


def _ply(path: Path, start: bytes) -> tuple[CloudHeader, int, int, str]:
    """Return what a PLY promises, how much data it needs at least, and how much it has."""
    if not start.startswith(b"ply"):
        raise ValueError(f"it starts with {start[:8]!r}")
    end = start.find(b"end_header")
    offset = start.find(b"\n", end) + 1
    if end < 0 or offset == 0:
        raise ValueError("it ends before the line end_header")
    lines = [line.split() for line in start[:end].decode("ascii", "replace").splitlines()]
    elements: list[tuple[str, int, int]] = []
    for words in lines:
        if words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), 0))
        elif words[:1] == ["property"]:
            name, count, size = elements[-1]
            elements[-1] = (name, count, size + _property_bytes(words[1:], face=name == "face"))
    promised = {name: count for name, count, _ in elements}
    header = CloudHeader(promised["vertex"], promised.get("face", 0))
    if ["format", "ascii", "1.0"] in lines:
        return header, sum(promised.values()), _lines(path, offset), "lines"
    need = sum(count * size for _, count, size in elements)
    return header, need, path.stat().st_size - offset, "bytes"


def _property_bytes(words: Sequence[str], *, face: bool) -> int:
    """Return the smallest size of one PLY property; the list of a face has three entries."""
    if words[0] == "list":
        return PLY_BYTES[words[1]] + (3 * PLY_BYTES[words[2]] if face else 0)
    return PLY_BYTES[words[0]]


def _lines(path: Path, offset: int) -> int:
    """Return how many lines of data follow the header."""
    with path.open("rb") as file:
        file.seek(offset)
        content = file.read()
    return sum(1 for line in content.split(b"\n") if line.strip())
