"""Two servers of PostgreSQL on hosts of their own: one takes writes, the other confirms them.

Each has a small disk for its data and one for its log, which are memory and go with the host.  What
a manager such as Patroni does on real hosts, `DatabasePair` does here: it promotes a server, goes
on with one copy, and makes the second one again.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from enact_dist.errors import LinkError

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.verify.chaos.network.hosts import Namespaces

USER: Final = "postgres"
DISK_MB: Final = 192
WAIT_S: Final = 60.0
AWAY_S: Final = 12.0
"""A standby that is not synchronous after so long is copied anew."""
POLL_S: Final = 0.05
_SETTINGS: Final = """
listen_addresses = '*'
unix_socket_directories = '/mnt/data'
wal_level = replica
hot_standby = on
wal_sender_timeout = 3s
wal_receiver_timeout = 3s
wal_retrieve_retry_interval = 500ms
wal_keep_size = 48MB
max_wal_size = 24MB
min_wal_size = 2MB
shared_buffers = 32MB
"""
_ACCESS: Final = """
local all all trust
host all all 198.18.77.0/24 trust
host replication all 198.18.77.0/24 trust
"""
_STANDBYS: Final = "ALTER SYSTEM SET synchronous_standby_names = '{}'"
_RELOAD: Final = "SELECT pg_reload_conf()"
_SYNC: Final = "SELECT 1 FROM pg_stat_replication WHERE state = 'streaming' AND sync_state = 'sync'"
_WAITING: Final = "SELECT pid FROM pg_stat_activity WHERE wait_event = 'SyncRep'"


def programs() -> Path:
    """Return the folder of the server's programs.

    Raises:
        LinkError: It is not installed, or the driver is missing.
    """
    try:
        import psycopg  # noqa: F401 - only whether it is there
    except ImportError as error:
        raise LinkError(f"the driver of PostgreSQL cannot be loaded: {error}") from error
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"), key=lambda p: p.parts[-3])
    there = str(found[-1]) if found else shutil.which("initdb")
    if there is None:
        raise LinkError("no PostgreSQL server is installed: apt-get install postgresql")
    if os.geteuid() != 0:
        raise LinkError("only root can run the servers: they refuse the root of a user namespace")
    return Path(there).parent


class DatabaseNode:
    """One server.

    Args:
        hosts: Has a host of its name.
        name: Of the server and its host.
        folder: Gets its output.

    Attributes:
        ended: Whether it is never to start again.
    """

    def __init__(self, hosts: Namespaces, name: str, folder: Path) -> None:
        self.name = name
        self._hosts, self._output = hosts, folder / f"{name}.output"
        self._programs = programs()
        self._process: subprocess.Popen[bytes] | None = None
        self.ended = False
        disk = f"size={DISK_MB}m"
        hosts.execute(name, "mount", "-t", "tmpfs", "-o", disk, "tmpfs", "/mnt")
        hosts.execute(name, "mkdir", "/mnt/data", "/mnt/log")
        for part in ("data", "log"):
            hosts.execute(name, "mount", "-t", "tmpfs", "-o", disk, "tmpfs", f"/mnt/{part}")
            hosts.execute(name, "chown", USER, f"/mnt/{part}")

    def _as_user(self, *command: str) -> list[str]:
        # It dies with the thread that starts it, and so with this process.
        user = ["setpriv", f"--reuid={USER}", f"--regid={USER}", "--init-groups"]
        user += ["--pdeathsig", "KILL", "env", "--chdir=/", "LC_ALL=C.UTF-8"]
        program = [str(self._programs / command[0]), *command[1:]]
        return [*self._hosts.before(self.name), *user, *program]

    def _make(self, *command: str) -> None:
        done = subprocess.run(
            self._as_user(*command),
            capture_output=True,
            text=True,
            stdin=subprocess.DEVNULL,
            timeout=WAIT_S,
            check=False,
        )
        if done.returncode:
            raise LinkError(f"{command[0]} of {self.name} failed: {done.stderr.strip()}")

    # ---------------------------------------------------------------- life

    def init(self) -> None:
        """Make an empty database."""
        options = ("-U", USER, "-A", "trust", "-E", "UTF8", "--locale=C.UTF-8", "--no-sync")
        where = ("-D", "/mnt/data/db", "-X", "/mnt/log/wal", "--wal-segsize=1")
        self._make("initdb", *where, *options)
        data = self._hosts.root(self.name) / "mnt/data/db"
        with (data / "postgresql.conf").open("a") as file:
            file.write(_SETTINGS)
        (data / "pg_hba.conf").write_text(_ACCESS)

    def copy(self, other: DatabaseNode) -> None:
        """Become a standby of another one, with nothing of one's own."""
        self._hosts.execute(self.name, "sh", "-c", "rm -rf /mnt/data/* /mnt/log/*")
        address = self._hosts.address(other.name)
        source = f"host={address} user={USER} application_name={self.name} connect_timeout=2"
        where = ("-D", "/mnt/data/db", "--waldir=/mnt/log/wal")
        self._make("pg_basebackup", "-d", source, *where, "-R", "-c", "fast", "--no-sync")

    def start(self, timeout_s: float = WAIT_S) -> None:
        """Start it; return once it answers.

        Raises:
            LinkError: It does not.
        """
        end_s = time.monotonic() + timeout_s
        while not self.ended:
            if self._process is None or self._process.poll() is not None:
                # After a kill, its children keep the folder for a moment.
                with self._output.open("ab") as output:
                    self._process = subprocess.Popen(
                        self._as_user("postgres", "-D", "/mnt/data/db"),
                        stdin=subprocess.DEVNULL,
                        stdout=output,
                        stderr=output,
                    )
            with suppress(LinkError):
                self.ask("SELECT 1")
                return
            if time.monotonic() > end_s:
                raise LinkError(f"the database server {self.name} does not start")
            time.sleep(POLL_S)
        raise LinkError(f"the database server {self.name} is not to start any more")

    def kill(self) -> None:
        """SIGKILL its first process, whose children then end by themselves."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def end(self) -> None:
        """Kill it for good; idempotent."""
        self.ended = True
        self.kill()

    def _pids(self) -> list[int]:
        assert self._process is not None
        first = self._process.pid
        found = [first]
        with suppress(OSError):
            children = Path(f"/proc/{first}/task/{first}/children").read_text().split()
            found += map(int, children)
        return found

    def signal(self, number: int) -> None:
        """Send a signal to all its processes, the first one before its children."""
        for pid in self._pids():
            with suppress(ProcessLookupError):
                os.kill(pid, number)

    def pause(self) -> None:
        """Let all its processes stand still."""
        os.kill(self._pids()[0], signal.SIGSTOP)  # it starts no others from now on
        self.signal(signal.SIGSTOP)

    def go_on(self) -> None:
        """End a pause."""
        self.signal(signal.SIGCONT)

    def fill(self, part: str) -> Callable[[], None]:
        """Fill its disk of `data` or `log`; return what frees it."""
        disk = self._hosts.root(self.name) / "mnt" / part
        ballast = disk / "ballast"
        with ballast.open("wb") as file:
            while free := shutil.disk_usage(disk).free:
                with suppress(OSError):  # it is less by now
                    os.posix_fallocate(file.fileno(), file.seek(0, os.SEEK_END), free)
        return lambda: ballast.unlink(missing_ok=True)

    # ---------------------------------------------------------------- questions

    def ask(self, *statements: str) -> list[tuple[Any, ...]]:
        """Execute statements; return the rows of the last.

        Raises:
            LinkError: The server cannot, or does not answer.
        """
        import psycopg

        folder = self._hosts.root(self.name) / "mnt/data"
        options = "-c statement_timeout=5s -c synchronous_commit=local"
        rows: list[tuple[Any, ...]] = []
        try:
            with psycopg.connect(
                host=str(folder), user=USER, connect_timeout=3, autocommit=True, options=options
            ) as connection:
                for statement in statements:
                    cursor = connection.execute(statement.encode())
                    rows = cursor.fetchall() if cursor.description else []
        except psycopg.Error as failure:
            raise LinkError(f"the database server {self.name}: {failure}") from failure
        return rows


class DatabasePair:
    """A primary and its synchronous standby.

    Attributes:
        primary: Takes writes.
        standby: Confirms them.
    """

    def __init__(self, primary: DatabaseNode, standby: DatabaseNode) -> None:
        self.primary, self.standby = primary, standby
        self._copies_anew = True

    def start(self) -> None:
        """Make both; return once each commit is confirmed by the standby."""
        self.primary.init()
        self.make_whole()

    def one_copy(self) -> None:
        """Let the primary go on alone."""
        self.primary.ask(_STANDBYS.format(""), _RELOAD)

    def swap(self) -> None:
        """Promote the standby, which goes on alone; the old primary has to be copied anew."""
        self.standby.ask("SELECT pg_promote(true, 4)")
        self.primary, self.standby = self.standby, self.primary
        self._copies_anew = True
        self.one_copy()

    def make_whole(self) -> None:
        """Let both run, and the standby confirm each commit again.

        Raises:
            LinkError: They do not.
        """
        self.primary.start()
        end_s = time.monotonic() + WAIT_S
        while time.monotonic() < end_s and not self.standby.ended:
            with suppress(LinkError):  # a cut between the two, for example
                if self._copies_anew:
                    self.standby.copy(self.primary)
                self._copies_anew = False
                self.standby.start(AWAY_S)
                if self._is_whole():
                    return
            self.standby.kill()
            self._copies_anew = True
        raise LinkError("the database's standby confirms no commits")

    def _is_whole(self) -> bool:
        end_s = time.monotonic() + AWAY_S
        named = False
        while time.monotonic() < end_s:
            with suppress(LinkError):  # the primary recovers from a crash
                if not named:
                    self.primary.ask(_STANDBYS.format(self.standby.name), _RELOAD)
                    named = True
                if self.primary.ask(_SYNC):
                    return True
            time.sleep(POLL_S)
        return False

    def waiting(self, timeout_s: float) -> list[int]:
        """Return the processes of the primary that wait for the standby, once there are some."""
        end_s = time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            if found := self.primary.ask(_WAITING):
                return [pid for (pid,) in found]
            time.sleep(POLL_S)
        return []

    def end(self) -> None:
        """Kill both for good; idempotent."""
        for node in (self.primary, self.standby):
            node.end()
