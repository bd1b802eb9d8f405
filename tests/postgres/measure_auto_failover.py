"""Measures how long no update succeeds when the host of the primary is lost; not a test.

pg_auto_failover manages two servers, each on a host with a daemon of the shard; its monitor and two
clients that count have hosts of their own.  All of them are network namespaces.

PYTHONPATH=.:tests:tests/link python tests/postgres/measure_auto_failover.py --fault cut --runs 3
"""

import argparse
import os
import shutil
import signal
import subprocess
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import postgres_nodes
import psycopg
from cell_on_hosts import CLIENTS, CellOnHosts, await_updates
from polling import until

from enact_dist.link.log import READY, STANDS_BY

MONITOR = "monitor"
NODES = ("one", "two")
PORT = 6400
MOUNT = ("mount", "-t", "tmpfs", "-o", "mode=777", "run", "/run/postgresql")
SHORT = Path(__file__).parents[2] / "deploy" / "survive" / "auto_failover.conf"
SETTLED_S, OUT_S = 3.0, 300.0
STATES = "SELECT nodename, reportedstate FROM pgautofailover.node WHERE reportedstate = goalstate"


class ManagedSite(CellOnHosts):
    """Two servers, each on a host with a daemon, and their monitor on a host of its own."""

    def __init__(self, folder, *, short):
        super().__init__(folder, "managed", NODES, (MONITOR,))
        self._data, self._servers = postgres_nodes.make_folder(), []
        for host in (MONITOR, *NODES):
            self.hosts.execute(host, *MOUNT)
        self._manage(MONITOR, "create", "monitor")
        self._open_to_all(MONITOR)
        if short:
            with (self._data / MONITOR / "postgresql.conf").open("a") as file:
                file.write(SHORT.read_text())
        self._manage(MONITOR, "run")
        until(lambda: self.states() == {}, pause_s=0.2)
        place = f"{self.hosts.address(MONITOR)}:{PORT}"
        monitor = f"postgres://autoctl_node@{place}/pg_auto_failover?sslmode=prefer"
        for host, state in zip(NODES, ("single", "secondary"), strict=True):
            self._manage(host, "create", "postgres", "--name", host, "--dbname", "cell", "--monitor", monitor)  # fmt: skip
            self._open_to_all(host)
            self._manage(host, "run")
            until(lambda host=host, state=state: self.states().get(host) == state, pause_s=0.2)
        until(lambda: self.states().get(NODES[0]) == "primary", pause_s=0.2)
        self.store_at(NODES, PORT, "cell")

    def _manage(self, host, *words):
        """Run the manager on a host: `run` goes on, anything else ends."""
        where = ["--pgdata", str(self._data / host)]
        if words[0] == "create":
            where += ["--pgport", str(PORT), "--hostname", self.hosts.address(host)]
            where += ["--auth", "trust", "--no-ssl"]
        home = f"HOME={self._data}/home-{host}"
        user = ["setpriv", f"--reuid={postgres_nodes.USER}", f"--regid={postgres_nodes.USER}"]
        user += ["--init-groups", "env", "--chdir=/", home, home.replace("HOME", "XDG_RUNTIME_DIR")]
        user += ["LC_ALL=C.UTF-8", f"PATH={postgres_nodes.programs()}:/usr/bin:/bin"]
        postgres_nodes.as_user("/usr/bin/mkdir", "-p", self._data / f"home-{host}")
        with (self.folder / f"{host}.manager").open("ab") as log:
            command = [*self.hosts.before(host), *user, "pg_autoctl", *words, *where]
            made = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        if words[0] == "run":
            self._servers.append(made)
        elif made.wait(120):
            raise SystemExit((self.folder / f"{host}.manager").read_text())

    def _open_to_all(self, host):
        with (self._data / host / "pg_hba.conf").open("a") as file:
            file.write("host all all all trust\nhost replication all all trust\n")

    def states(self):
        """Return the settled state of each server, as the monitor knows it; None: it is not up."""
        folder = self.hosts.root(MONITOR) / "run/postgresql"
        try:
            with psycopg.connect(
                host=str(folder), port=PORT, user=postgres_nodes.USER, dbname="pg_auto_failover"
            ) as connection:
                return dict(connection.execute(STATES).fetchall())
        except psycopg.OperationalError:
            return None

    def kill(self, host):
        """Kill all processes of a host, but for those that keep it."""
        keeper = self.hosts.root(host).parent
        network = (keeper / "ns" / "net").readlink()
        kept = {keeper.name, (keeper / "stat").read_text().split()[3]}
        for found in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):  # it has ended, or is another user's
                if found.name not in kept and (found / "ns" / "net").readlink() == network:
                    os.kill(int(found.name), signal.SIGKILL)

    def cut(self, host):
        for other in (MONITOR, *NODES, CLIENTS):
            if other != host:
                self.hosts.cut(host, other)
                self.hosts.cut(other, host)

    def end_database(self):
        for host in (*NODES, MONITOR):
            self.kill(host)
        for server in self._servers:
            server.wait()
        shutil.rmtree(self._data)


def measure(site, options):
    """Lose the host of the primary; print for how long no update of a client succeeded."""
    primary, other = NODES
    active, standby = (primary, other) if options.daemon == "with" else (other, primary)
    site.daemon(active, READY)
    site.daemon(standby, STANDS_BY)
    clients = [site.client(number) for number in range(2)]
    await_updates(clients)
    time.sleep(SETTLED_S)
    load = os.getloadavg()[0]
    (site.kill if options.fault == "kill" else site.cut)(primary)
    await_updates(clients, OUT_S)
    for client in clients:
        client.tell("longest")
    longest = [client.expect("longest") for client in clients]
    for client in clients:
        client.tell("end")
    unknown = sum(int(client.expect("right").split()[1]) for client in clients)
    print(
        f"{options.fault} primary's host, daemon {options.daemon} it, {options.times} times: no"
        f" update for {', '.join(longest)}; counts right, {unknown} unknown;"
        f" load {load:.1f} to {os.getloadavg()[0]:.1f}",
        flush=True,
    )


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--fault", choices=("kill", "cut"), default="kill")
    parser.add_argument("--daemon", choices=("apart from", "with"), default="apart from")
    parser.add_argument("--times", choices=("short", "default"), default="short")
    parser.add_argument("--runs", type=int, default=1)
    options = parser.parse_args()
    for _ in range(options.runs):
        with tempfile.TemporaryDirectory() as own:
            site = ManagedSite(Path(own), short=options.times == "short")
            try:
                measure(site, options)
            finally:
                site.close()


if __name__ == "__main__":
    main()
