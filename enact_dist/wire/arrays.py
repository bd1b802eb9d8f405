"""numpy arrays ↔ a description in the tree and raw bytes in the body.

A dtype is described by numpy's text where that is whole (``<f8``, ``>i4``, ``|S5``, ``<M8[ns]``),
else by a map: ``{"itemsize": n, "fields": [[name, dtype, offset], …]}`` for a structure (with a
fourth part where a field has a title) and ``{"shape": […], "item": dtype}`` for a fixed array
inside one.

Rules to keep: a described dtype reads back equal, or it is refused; no array of Python objects
ever; what a peer describes is compared with the bytes that came before anything is allocated.
"""

from __future__ import annotations

import math
import re
import reprlib
from functools import lru_cache
from typing import Any, Final

import numpy as np

from enact_dist.wire.limits import DEPTH_MAX, DIMENSIONS_MAX, FIELDS_MAX

_SIMPLE = re.compile(r"[<>|=]?[biufcmMSUV][0-9]{0,9}(?:\[[0-9]{0,9}[A-Za-z]{1,2}\])?\Z")
_ITEM_BYTES_MAX: Final = 1 << 30


class DtypeError(ValueError):
    """A dtype that cannot travel, or a description of none; its text is for people."""


@lru_cache(maxsize=256)
def describe(dtype: np.dtype[Any]) -> object:
    """Return the description of a dtype in the tree.

    Raises:
        DtypeError: It holds Python objects, or what numpy's text does not carry.
    """
    if dtype.hasobject:
        raise DtypeError(f"dtype {dtype} holds Python objects, which never travel")
    node = _describe(dtype)
    if read_dtype(node) != dtype:
        raise DtypeError(f"dtype {dtype} would come back as {read_dtype(node)}")
    return node


def _describe(dtype: np.dtype[Any]) -> object:
    if dtype.subdtype is not None:
        item, shape = dtype.subdtype
        return {"shape": shape, "item": _describe(item)}
    if dtype.fields is None:
        return dtype.str
    fields = []
    for name in dtype.names or ():
        inner, offset, *title = dtype.fields[name]
        if title and type(title[0]) is not str:
            raise DtypeError(f"field {name!r} has a title that is no text: {title[0]!r:.60}")
        fields.append([name, _describe(inner), offset, *title])
    return {"itemsize": dtype.itemsize, "fields": fields}


def read_dtype(node: object) -> np.dtype[Any]:
    """Return the dtype of a description.

    Raises:
        DtypeError: It describes none.
    """
    if type(node) is str:
        return _read_simple(node)
    try:
        return _read(node, 0, [FIELDS_MAX])
    except DtypeError:
        raise
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise DtypeError(f"no dtype: {error}") from error


@lru_cache(maxsize=256)
def _read_simple(text: str) -> np.dtype[Any]:
    # numpy reads far more than this ("i4,f8", "O", names of types); none of it was written here.
    if not _SIMPLE.match(text):
        raise DtypeError(f"{text[:40]!r} describes no dtype")
    try:
        dtype = np.dtype(text)
    except (ValueError, TypeError, OverflowError) as error:
        raise DtypeError(f"{text[:40]!r} describes no dtype: {error}") from error
    return _checked(dtype)


def _read(node: object, depth: int, fields_left: list[int]) -> np.dtype[Any]:
    if type(node) is str:
        return _read_simple(node)
    if type(node) is not dict or depth > DEPTH_MAX:
        raise DtypeError(f"{type(node).__name__} at depth {depth} describes no dtype")
    if node.keys() == {"shape", "item"}:
        shape = checked_shape(node["shape"])
        item = _read(node["item"], depth + 1, fields_left)
        if math.prod(shape) * max(1, item.itemsize) > _ITEM_BYTES_MAX:
            raise DtypeError(f"an inner array of shape {shape} is too large")
        return _checked(np.dtype((item, shape)))
    if node.keys() != {"itemsize", "fields"} or type(node["fields"]) not in {tuple, list}:
        raise DtypeError(f"{reprlib.repr(node)} describes no dtype")
    fields_left[0] -= len(node["fields"])
    if fields_left[0] < 0:
        raise DtypeError(f"a structured dtype has over {FIELDS_MAX} fields")
    names, formats, offsets, titles = [], [], [], []
    for name, inner, offset, *title in node["fields"]:
        if type(name) is not str or type(offset) is not int or not _are_titles(title):
            raise DtypeError("a field is [name, dtype, offset] or [name, dtype, offset, title]")
        names.append(name)
        titles.append(title[0] if title else None)
        formats.append(_read(inner, depth + 1, fields_left))
        offsets.append(offset)
    if type(node["itemsize"]) is not int or not 0 <= node["itemsize"] <= _ITEM_BYTES_MAX:
        raise DtypeError(f"{reprlib.repr(node['itemsize'])} is no size of an item")
    return _checked(
        np.dtype(
            {
                "names": names,
                "formats": formats,
                "offsets": offsets,
                "titles": titles,
                "itemsize": node["itemsize"],
            }
        )
    )


def _checked(dtype: np.dtype[Any]) -> np.dtype[Any]:
    if dtype.hasobject or dtype.itemsize > _ITEM_BYTES_MAX:
        raise DtypeError(f"dtype {dtype} cannot travel")
    return dtype


def _are_titles(title: list[object]) -> bool:
    return not title or (len(title) == 1 and type(title[0]) is str and title[0] != "")


def checked_shape(node: object) -> tuple[int, ...]:
    """Return a shape that was read.

    Raises:
        DtypeError: It is invalid, or has more than `DIMENSIONS_MAX` dimensions.
    """
    if not isinstance(node, tuple | list) or len(node) > DIMENSIONS_MAX:
        raise DtypeError(
            f"{type(node).__name__} is no shape of at most {DIMENSIONS_MAX} dimensions"
        )
    for extent in node:
        if type(extent) is not int or not 0 <= extent < 1 << 62:
            raise DtypeError(f"{reprlib.repr(extent)} is no extent of an array")
    return tuple(node)


def raw_bytes(array: np.ndarray[Any, Any]) -> tuple[str, np.ndarray[Any, Any] | bytes]:
    """Return the order of an array in its body ("C" or "F") and its bytes in that order.

    The bytes are a view where the array is contiguous in either order, else a copy.
    """
    fortran = array.flags.f_contiguous and not array.flags.c_contiguous
    if not array.nbytes:
        return ("F" if fortran else "C"), b""
    whole = np.ascontiguousarray(array.T if fortran else array)
    return ("F" if fortran else "C"), whole.reshape(-1).view(np.uint8, np.ndarray)


def array_over(
    raw: memoryview, description: object, shape: object, order: object
) -> np.ndarray[Any, Any]:
    """Return a read-only array over `raw`, without a copy.

    Raises:
        DtypeError: dtype, shape and the number of bytes do not fit together.
    """
    dtype, extents = read_dtype(description), checked_shape(shape)
    count = math.prod(extents)
    if order not in ("C", "F") or count * dtype.itemsize != len(raw):
        raise DtypeError(
            f"{len(raw)} bytes in order {reprlib.repr(order)} are no array of dtype {dtype} and"
            f" shape {extents}"
        )
    if count and not dtype.itemsize:
        raise DtypeError(f"{count} items of dtype {dtype}, which has no size")
    try:
        if count:
            array = np.frombuffer(raw, dtype, count).reshape(extents, order=order)
        else:
            array = np.empty(extents, dtype, order)
    except (ValueError, TypeError, OverflowError) as error:
        raise DtypeError(f"no array of dtype {dtype}, shape {extents}: {error}") from error
    array.flags.writeable = False
    result: np.ndarray[Any, Any] = array
    return result
