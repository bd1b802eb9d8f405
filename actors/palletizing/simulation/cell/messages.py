"""How the physical cell's process and those who use it talk: requests and answers over a socket.

A message is four bytes of length, big-endian, then msgpack.  A request is a list: the name of a
method and its arguments.  An answer is a map: {"value": …} or {"error": text}.  Arrays and the
dataclasses below travel as maps with their name under "is"; nothing else does, and no code.
"""

from __future__ import annotations

import dataclasses
import socket
import struct
from typing import Any, Final

import msgpack
import numpy as np

from actors.palletizing.control.controller import ArmMeasured, ControllerError, GripperMeasured
from actors.palletizing.simulation.cell.truth import (
    CellTruth,
    GripEvent,
    PackageTruth,
    ShownCell,
    ShownPackage,
)
from actors.palletizing.simulation.physical_packages import Dent

BYTES_MAX: Final = 16 * 1024 * 1024
"""Greatest message: a picture has 2 MiB, all else far less."""
_KINDS: Final[dict[str, Any]] = {
    kind.__name__: kind
    for kind in (
        ArmMeasured,
        GripperMeasured,
        CellTruth,
        PackageTruth,
        GripEvent,
        Dent,
        ShownCell,
        ShownPackage,
    )
}
_DTYPES: Final = {"float64", "uint8", "int64", "bool"}


def send(connection: socket.socket, message: Any) -> None:
    """Send a message.

    Raises:
        OSError: The connection has ended.
    """
    body = msgpack.packb(message, default=_packed)
    connection.sendall(struct.pack(">I", len(body)) + body)


def receive(connection: socket.socket) -> Any:
    """Return the next message; waits for it.

    Raises:
        EOFError: The other end has closed the connection.
        ControllerError: It is no message.
        OSError: The connection has ended otherwise.
    """
    (length,) = struct.unpack(">I", _exactly(connection, 4))
    if length > BYTES_MAX:
        raise ControllerError(f"a message of {length} bytes came; at most {BYTES_MAX}")
    try:
        return msgpack.unpackb(
            _exactly(connection, length),
            object_hook=_unpacked,
            use_list=False,
            strict_map_key=False,
        )
    except (ValueError, TypeError, KeyError) as error:
        raise ControllerError(f"what came is no message: {error}") from error


def _exactly(connection: socket.socket, length: int) -> bytes:
    parts = bytearray()
    while len(parts) < length:
        part = connection.recv(length - len(parts))
        if not part:
            raise EOFError("the other end has closed the connection")
        parts += part
    return bytes(parts)


def _packed(value: Any) -> Any:
    if isinstance(value, np.ndarray) and value.dtype.name in _DTYPES:
        data = np.ascontiguousarray(value).tobytes()
        return {"is": "array", "type": value.dtype.name, "shape": value.shape, "data": data}
    if isinstance(value, np.generic):
        return value.item()
    name = type(value).__name__
    if _KINDS.get(name) is type(value):
        fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        return {"is": name, **fields}
    raise TypeError(f"{name} does not travel")


def _unpacked(found: dict[str, Any]) -> Any:
    name = found.pop("is", None)
    if name is None:
        return found
    if name != "array":
        return _KINDS[name](**found)
    if found["type"] not in _DTYPES:
        raise ValueError(f"arrays of {found['type']} do not travel")
    return np.frombuffer(found["data"], found["type"]).reshape(found["shape"])
