"""Connections to the database of a shard, and which errors mean that one was lost.

Rules that a change must keep:

- Nothing may cancel a commit that waits for the standby: no `statement_timeout`, no cancel of ours.
  PostgreSQL reports a cancelled wait as success, with a warning; so **any** warning on such a
  connection is an error of the store.
- No pooler in transaction mode may stand in between: settings and prepared statements belong to the
  session.
"""

from __future__ import annotations

import logging
import os
import socket
import threading
import time
import weakref
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from typing import TYPE_CHECKING, Any, Final

import psycopg
from psycopg import errors
from psycopg.conninfo import conninfo_to_dict

from enact_dist.config.types import without_password
from enact_dist.errors import StoreError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from enact_dist.link.postgres.address import StoreAddress

CONNECT_S: Final = 2
"""How long one host may take to answer a connection."""
_KEYWORDS: Final[dict[str, Any]] = {
    "target_session_attrs": "read-write",
    "connect_timeout": CONNECT_S,
    "tcp_user_timeout": 3000,  # ms
    "keepalives_idle": 1,
    "keepalives_interval": 1,
    "keepalives_count": 3,
}
_OPTIONS: Final = (
    "-c statement_timeout=0 -c lock_timeout=5s -c idle_in_transaction_session_timeout=5s"
    " -c tcp_user_timeout=3000 -c client_connection_check_interval=1s"
    " -c plan_cache_mode=force_generic_plan -c client_min_messages=warning"
)
CONFIRMED: Final = "on"
"""`synchronous_commit` of what must be forced to the disks of both hosts."""
RECEIVED: Final = "remote_write"
"""Of what the system of the other host has got; less than that is lost with a failover."""
_LAST_WORDS: Final = frozenset({"FATAL", "PANIC"})
"""What an idle connection gets as a notice when the server ends it."""
_PASSES: Final = (errors.LockNotAvailable, errors.ReadOnlySqlTransaction, errors.DiskFull)
"""Errors after which the connection stands, and nothing was written."""
LOST: Final = (psycopg.OperationalError, psycopg.InterfaceError, errors.ReadOnlySqlTransaction)
"""Errors of a connection, of which `is_lost` picks those that a new one may mend."""


HUNG_S: Final = 3.0
"""How long an answer may be away before other hosts are asked whether they take writes."""
LOOK_S: Final = 0.5
"""How often that is looked at."""
_log = logging.getLogger("enact.store")


class Connector:
    """Connects to whichever host of a database takes writes, the last good one first."""

    def __init__(self, url: str, who: str) -> None:
        self.shown = without_password(url)
        found = conninfo_to_dict(url)
        hosts = str(found.pop("host", "") or "").split(",")
        ports = str(found.pop("port", "") or "").split(",")
        ports = ports if len(ports) == len(hosts) else ports[:1] * len(hosts)
        # Several threads connect: it is replaced as a whole, never changed.
        self._places = tuple(zip(hosts, ports, strict=True))
        options = f"{found.pop('options', '') or ''} {_OPTIONS}".strip()
        self._rest = {**found, **_KEYWORDS, "options": options, "application_name": who}
        self._lookout = Lookout(self) if len(hosts) > 1 else None

    def connect(self) -> DatabaseSession:
        """Connect.

        Raises:
            psycopg.OperationalError: No host takes writes now.
        """
        places = self._places
        connection = psycopg.connect(autocommit=True, **{**self._rest, **_keywords_of(places)})
        connection.prepare_threshold = 0
        here = connection.info.host, str(connection.info.port)
        if here in places:  # else a folder of sockets, or a host that is named otherwise
            self._places = (here, *(place for place in places if place != here))
        return DatabaseSession(connection)

    def waiting(self, session: DatabaseSession) -> AbstractContextManager[None]:
        """Return a context in which a session is left whose server hangs."""
        return self._lookout.over(session) if self._lookout is not None else nullcontext()

    @staticmethod
    def host_of(session: DatabaseSession) -> str:
        """Return the host and port of a session."""
        info = session.connection.info
        return f"{info.host}:{info.port}"

    def primary_beside(self, session: DatabaseSession) -> str:
        """Return another host that takes writes, "" if there is none."""
        for place in self._places:
            if ":".join(place) == self.host_of(session):
                continue
            keywords = {**self._rest, **_keywords_of((place,))}
            with suppress(psycopg.Error), psycopg.connect(**keywords) as other:
                # Two names may be those of one server.
                if _started(other) != session.started:
                    return ":".join(place)
        return ""


class DatabaseSession:
    """One connection, with its class of durability and the warnings that came over it."""

    def __init__(self, connection: psycopg.Connection[tuple[Any, ...]]) -> None:
        self.connection = connection
        self.started = _started(connection)
        self._class = ""
        self._warnings: list[str] = []
        connection.add_notice_handler(self._warned)

    def _warned(self, notice: errors.Diagnostic) -> None:
        if notice.severity_nonlocalized in _LAST_WORDS:
            return  # the connection is lost, and what became of its commit will be asked
        self._warnings.append(f"{notice.sqlstate} {notice.message_primary}")

    def commit_as(self, level: str) -> None:
        """Choose what the next commits survive: `CONFIRMED` or `RECEIVED`."""
        if level != self._class:
            self.connection.execute(f"SET synchronous_commit = {level}")
            self._class = level

    def row(self, statement: str, values: Sequence[object] = ()) -> tuple[Any, ...] | None:
        """Execute a statement; return its first row.

        Raises:
            StoreError: The database warned.
            psycopg.Error: As the database reports it.
        """
        cursor = self.connection.execute(statement.encode(), values)
        found = cursor.fetchone() if cursor.description else None
        self.check()
        return found

    def check(self) -> None:
        """Refuse what was committed while the database warned.

        Raises:
            StoreError: It did: a commit may stand on one host only.
        """
        if self._warnings:
            raise StoreError(
                f"the database warned ({'; '.join(self._warnings)}), so a commit that it reported"
                " may stand on one of its hosts only: look at the database's log, and start the"
                " shard again"
            )

    def break_off(self) -> None:
        """Let an act of another thread that waits for an answer fail.

        The server does not learn of it before it answers, so this cancels no wait for a standby.
        """
        with suppress(OSError, psycopg.Error):
            line = socket.socket(fileno=os.dup(self.connection.fileno()))
            with line:
                line.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close the connection; idempotent."""
        with suppress(psycopg.Error):
            self.connection.close()


class Lookout:
    """Leaves a server that hangs once another host takes writes.  It ends with its connector.

    A server whose processes stand still keeps its connections, and its kernel answers for it, so no
    time-out of the network ends the wait.  A wait for the standby looks the same, and nothing may
    cut that short: a connection is given up only when another host is the primary.
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


@contextmanager
def broken_off(
    session: Callable[[], DatabaseSession | None], stopped: threading.Event | None
) -> Iterator[None]:
    """Let what waits for answers of the present session fail once `stopped` is set."""
    over = threading.Event()

    def watch(stopped: threading.Event) -> None:
        while not over.wait(LOOK_S):
            if stopped.is_set() and (waiting := session()) is not None:
                waiting.break_off()

    if stopped is not None:
        threading.Thread(target=watch, args=(stopped,), name="enact-store-end", daemon=True).start()
    try:
        yield
    finally:
        over.set()


def _keywords_of(places: Sequence[tuple[str, str]]) -> dict[str, str]:
    """Return how libpq is given hosts and ports; what is not said is left to its defaults."""
    hosts, ports = (",".join(some) for some in zip(*places, strict=True))
    return {key: text for key, text in (("host", hosts), ("port", ports)) if text.strip(",")}


def _started(connection: psycopg.Connection[tuple[Any, ...]]) -> object:
    """Return when a server was started: no two of a database were in the same microsecond."""
    return connection.execute("SELECT pg_postmaster_start_time()").fetchone()


def connector_of(address: StoreAddress) -> Connector:
    """Return what connects to the database of a shard."""
    return Connector(address.url, f"enact {address.cell} {address.shard} on {myself()}")


def in_one_line(failure: Exception) -> str:
    """Return what an error says, without line breaks and a question at its end."""
    text = " ".join(str(failure).split()) or type(failure).__name__
    return text.replace(" Is the server running on that host and accepting TCP/IP connections?", "")


def is_lost(failure: Exception, session: DatabaseSession | None) -> bool:
    """Whether a later try may do: the connection was lost, the row was held, or a disk was full."""
    if isinstance(failure, _PASSES):
        return True
    connection = session.connection if session is not None else None
    return connection is None or connection.closed or connection.broken


def myself() -> str:
    """Return this process, as the holder of a shard and in the database's list of connections."""
    return f"{socket.gethostname()} {os.getpid()}"
