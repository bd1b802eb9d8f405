"""A bare Python echo over a Unix socket, as a floor: `python -m …echoes.socket_echo PATH`."""

from __future__ import annotations

import socket
import sys
from pathlib import Path
from typing import Final

SMALL_BYTES: Final = 64


class SocketEcho:
    """The near end.  A context manager."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.connect(str(path))

    def echo(self) -> None:
        """Send a little and wait until it is back."""
        self._socket.sendall(b"x" * SMALL_BYTES)
        left = SMALL_BYTES
        while left:
            got = len(self._socket.recv(left))
            if not got:
                raise ConnectionResetError("the echo has ended")
            left -= got

    def close(self) -> None:
        """Hang up; the echo ends with that."""
        self._socket.close()

    def __enter__(self) -> SocketEcho:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def serve(path: Path) -> None:
    """Echo what one client sends until it hangs up."""
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))
        listening.listen(1)
        print("ready:", flush=True)
        connection, _ = listening.accept()
        with connection:
            while some := connection.recv(4096):
                connection.sendall(some)


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
