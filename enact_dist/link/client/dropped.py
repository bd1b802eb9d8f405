"""Ends sessions that were dropped without being closed, and logs a warning.

The threads of a session hold its carrier, not the session itself.  The session is therefore
collected together with the last cell, world context, lock or watch that uses it.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import warnings
import weakref
from typing import TYPE_CHECKING, Any, Final

from enact_dist.core.protocol.messages import Goodbye
from enact_dist.errors import EnactError

if TYPE_CHECKING:
    from types import FrameType

    from enact_dist.link.client.locks import CellClient

GOODBYE_S: Final = 0.5
"""How long the shards of a dropped session may take to answer the goodbye."""
_PACKAGE: Final = "enact_dist."


def when_dropped(client: CellClient, name: str, host: Any) -> weakref.finalize[Any, Any]:
    """End a session, and the shard inside this process, once nothing refers to it any more.

    Returns:
        A finalizer whose `detach` cancels this.
    """
    left = client.carrier, client.core, client.pauses, host
    found = weakref.finalize(client, _dropped, os.getpid(), name, _made_at(), *left)
    found.atexit = False  # at exit, open cells are closed in order
    return found


def _made_at() -> str:
    """Return the line outside this package that is opening a cell."""
    frame: FrameType | None = sys._getframe(1)  # noqa: SLF001 - a traceback would cost a file read
    while frame is not None and str(frame.f_globals.get("__name__")).startswith(_PACKAGE):
        frame = frame.f_back
    return f"{frame.f_code.co_filename}:{frame.f_lineno}" if frame is not None else "unknown"


def _dropped(pid: int, name: str, made_at: str, carrier: Any, core: Any, *left: Any) -> None:
    if pid != os.getpid():  # in a forked child everything belongs to the parent
        return
    ending = threading.Thread(
        target=_end, args=(carrier, core, *left), name="enact-dropped", daemon=True
    )
    # Not here: the thread that drops the last reference may hold locks needed below.
    with contextlib.suppress(RuntimeError):  # the interpreter is exiting
        ending.start()
    warnings.warn(
        f"cell {name!r} was dropped without close() and is closed now; it was opened at {made_at};"
        " use `with connect(…) as cell:`, or close it",
        ResourceWarning,
        stacklevel=2,
    )


def _end(carrier: Any, core: Any, pauses: Any, host: Any) -> None:
    pauses.end()
    goodbyes = [(shard, Goodbye(core.session)) for shard in core.shards_in_use()]
    with contextlib.suppress(EnactError):
        carrier.request_all(goodbyes, timeout_s=GOODBYE_S)
    carrier.close()
    if host is not None:
        host.close()
