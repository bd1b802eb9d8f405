"""PostgreSQL servers of a test: on free ports of the loopback, in a folder that goes with them."""

import os
import shutil
import signal
import socket
import subprocess
import tempfile
from contextlib import contextmanager
from pathlib import Path

from polling import until

USER = "postgres"
SETTINGS = """
listen_addresses = '127.0.0.1'
unix_socket_directories = ''
wal_level = replica
hot_standby = on
fsync = off
wal_sender_timeout = 3s
wal_receiver_timeout = 3s
autovacuum_naptime = 1s
"""
"""Nothing here cuts the power, so nothing has to be forced to a disk."""


def programs():
    """Return the folder of the server's programs, None where it is not installed."""
    found = sorted(
        Path("/usr/lib/postgresql").glob("*/bin/initdb"), key=lambda path: path.parts[-3]
    )
    if found:
        return found[-1].parent
    there = shutil.which("initdb")
    return Path(there).parent if there else None


def why_missing():
    """Return what is missing here for a test with PostgreSQL, "" where nothing is."""
    try:
        import psycopg  # noqa: F401
    except ImportError as error:
        return f"psycopg cannot be imported ({error}): pip install -e '.[postgres]'"
    if programs() is None:
        return "no PostgreSQL server is installed: apt-get install postgresql"
    if os.geteuid() == 0 and shutil.which("runuser") is None:
        return "initdb refuses root, and there is no runuser"
    return ""


class Node:
    """One server.

    Args:
        before: A command that ends by running its programs, such as `nsenter`.

    Attributes:
        port: Where it listens.
    """

    def __init__(self, folder, name, *, before=()):
        self.name = name
        self._before = before
        self.data = Path(folder) / name
        self._kept = socket.socket()  # the port stays this server's while it is down
        self._kept.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._kept.bind(("127.0.0.1", 0))
        self.port = self._kept.getsockname()[1]
        self.url = f"postgresql://{USER}@127.0.0.1:{self.port}/postgres"

    def init(self, *words):
        """Make an empty database."""
        self._run("initdb", "-D", self.data, "-U", USER, "-A", "trust", "-E", "UTF8", "--no-sync", "--locale=C.UTF-8", *words)  # fmt: skip
        with (self.data / "postgresql.conf").open("a") as file:
            file.write(SETTINGS)

    def copy(self, other):
        """Begin as a standby of another node."""
        self._run("pg_basebackup", "-h", "127.0.0.1", "-p", other.port, "-U", USER, "-D", self.data, "-R", "-X", "stream", "-C", "-S", self.name, "--no-sync", "-c", "fast")  # fmt: skip
        file = self.data / "postgresql.auto.conf"
        text = file.read_text()
        found = text.replace(
            "primary_conninfo = '", f"primary_conninfo = 'application_name={self.name} "
        )
        file.write_text(found)

    def start(self):
        self._run("pg_ctl", "-D", self.data, "-o", f"-p {self.port}", "-l", self.data / "log", "-w", "start")  # fmt: skip

    def stop(self, how="immediate"):
        self._run("pg_ctl", "-D", self.data, "-m", how, "-w", "stop", check=False)

    def restart(self):
        self.stop("fast")
        self.start()

    def promote(self):
        self._run("pg_ctl", "-D", self.data, "-w", "promote")

    def pids(self):
        """Return the processes of this server, its postmaster first."""
        postmaster = int((self.data / "postmaster.pid").read_text().split()[0])
        children = Path(f"/proc/{postmaster}/task/{postmaster}/children").read_text().split()
        return [postmaster, *map(int, children)]

    def pause(self):
        """Stop the processes of the server; what it was asked stays unanswered."""
        for pid in self.pids():
            os.kill(pid, signal.SIGSTOP)

    def go_on(self):
        for pid in self.pids():
            os.kill(pid, signal.SIGCONT)

    def log(self):
        """Return what the server has said."""
        return (self.data / "log").read_text()

    def execute(self, statement, values=()):
        """Execute a statement on a connection of its own; return the rows."""
        import psycopg

        with psycopg.connect(self.url, autocommit=True) as connection:
            cursor = connection.execute(statement, values)
            return cursor.fetchall() if cursor.description else []

    def _run(self, program, *words, check=True):
        as_user(program, *words, check=check, before=self._before)

    def close(self):
        if (self.data / "postmaster.pid").exists():
            self.stop()
        self._kept.close()


def as_user(program, *words, check=True, before=()):
    """Run a program of the server, which refuses root, as its own user."""
    command = [str(programs() / program), *map(str, words)]
    if os.geteuid() == 0:
        command = [*before, "runuser", "-u", USER, "--", *command]
    done = subprocess.run(
        command, check=False, text=True, cwd="/", stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, timeout=60,
    )  # fmt: skip
    assert not check or done.returncode == 0, f"{command}: {done.stderr}"


def make_folder():
    """Return a new folder that belongs to the server's user."""
    folder = tempfile.mkdtemp(prefix="enact-postgres-")
    if os.geteuid() == 0:
        shutil.chown(folder, USER, USER)
    return Path(folder)


def replicate(first, second):
    """Make `second` the synchronous standby of `first`; return once it is."""
    second.copy(first)
    second.start()
    first.execute(f"ALTER SYSTEM SET synchronous_standby_names = '{second.name}'")
    first.execute("SELECT pg_reload_conf()")
    await_sync(first)


def await_sync(node):
    """Wait until a standby confirms commits."""
    asked = "SELECT 1 FROM pg_stat_replication WHERE sync_state = 'sync'"
    until(lambda: node.execute(asked) == [(1,)])


@contextmanager
def two_nodes():
    """Give a server and its synchronous standby."""
    folder = make_folder()
    nodes = [Node(folder, name) for name in ("first", "second")]
    try:
        nodes[0].init()
        nodes[0].start()
        replicate(*nodes)
        yield nodes
    finally:
        for node in reversed(nodes):
            node.close()
        shutil.rmtree(folder)
