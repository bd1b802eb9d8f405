"""Leaves a server that hangs once another host of the database takes writes.

A server whose processes stand still keeps its connections, and its kernel answers for it: neither
an error nor a time-out of the network ends the wait.  A wait for the standby looks the same, and
nothing may cut that short; so a connection is given up only when another host is the primary.
"""

from __future__ import annotations

import logging
import threading
import time
import weakref
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

    from enact_dist.link.postgres.connection import Connector, DatabaseSession

HUNG_S: Final = 3.0
"""How long an answer may be away before other hosts are asked whether they take writes."""
LOOK_S: Final = 0.5
_log = logging.getLogger("enact.store")


class Lookout:
    """Looks after the waits of one connector, on a thread that ends with the connector.

    Args:
        connector: Knows the hosts.
    """

    def __init__(self, connector: Connector) -> None:
        self._waits: dict[DatabaseSession, float] = {}
        self._thread = threading.Thread(
            target=_look_out,
            args=(weakref.ref(connector), self._waits),
            name="enact-lookout",
            daemon=True,
        )
        self._thread.start()

    @contextmanager
    def over(self, session: DatabaseSession) -> Iterator[None]:
        """Look out while the calling thread waits for answers of a session."""
        self._waits[session] = time.monotonic()
        try:
            yield
        finally:
            self._waits.pop(session, None)


def _look_out(of: weakref.ref[Connector], waits: dict[DatabaseSession, float]) -> None:
    while True:
        time.sleep(LOOK_S)
        connector = of()
        if connector is None:
            return
        now_s = time.monotonic()
        for session, since_s in list(waits.items()):
            if now_s - since_s < HUNG_S:
                continue
            found = connector.primary_beside(session)
            if found and waits.get(session) == since_s:
                _log.warning(
                    "%s has not answered for %.1f s, and %s takes writes: going there",
                    connector.host_of(session), now_s - since_s, found,
                )  # fmt: skip
                session.break_off()
        del connector
