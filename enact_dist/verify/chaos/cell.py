"""The processes of a cell under test: shards, clients, watcher; started, hurt and started again."""

from __future__ import annotations

import signal
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from enact_dist.errors import LinkError
from enact_dist.verify.chaos import daemon
from enact_dist.verify.chaos.journal import SUFFIX, Journal
from enact_dist.verify.chaos.workload import WORLDS
from enact_dist.verify.daemons import LineProcess, Processes, write_cell

if TYPE_CHECKING:
    from pathlib import Path

    from enact_dist.verify.chaos.network.hosts import Hosts

WATCHER: Final = "watcher"
CLIENT: Final = "enact_dist.verify.chaos.client"
WATCHER_MODULE: Final = "enact_dist.verify.chaos.watcher"
END_S: Final = 120.0
"""How long a client may take to end: what it waits for, and what it sends again, is bounded."""


@dataclass(slots=True)
class ShardProcess:
    """A shard's daemon.

    Attributes:
        ready: Set once it serves.
        failure: Why it does not come up.
    """

    name: str
    process: LineProcess
    ready: threading.Event
    down_ns: int = 0
    failure: LinkError | None = None


@dataclass(slots=True)
class StartedClient:
    """A client process; `incarnation` counts its starts."""

    name: str
    host: str
    process: LineProcess
    incarnation: int = 1


class TestedCell(Processes):
    """All processes of one run.

    Args:
        folder: Existing; gets everything.
        hosts: Where they run.
        shards: Names of the shards, and of their hosts.
        log: Gets the restarts.
        ttl_s: Session TTL.
        seed: What the clients do is drawn from.
        daemon_module: Runs a shard, with a wall clock's offset in seconds as first argument.
    """

    __test__ = False

    def __init__(
        self,
        folder: Path,
        hosts: Hosts,
        shards: tuple[str, ...],
        log: Journal,
        *,
        ttl_s: float,
        seed: int,
        daemon_module: str = daemon.MODULE,
    ) -> None:
        super().__init__()
        self._folder, self._hosts, self._log = folder, hosts, log
        self._ttl_s, self._seed, self._module = ttl_s, seed, daemon_module
        self.file = folder / "cell.toml"
        self.shards: dict[str, ShardProcess] = {}
        self.clients: dict[str, StartedClient] = {}
        self.watcher: LineProcess
        self._write_file(shards)

    def _write_file(self, shards: tuple[str, ...]) -> None:
        write_cell(
            self.file,
            "chaos",
            worlds=WORLDS,
            listen={name: self._hosts.endpoint(name) for name in shards},
            pins={f"thing/{name}/*": name for name in shards},
            session_ttl_s=self._ttl_s,
        )

    # ---------------------------------------------------------------- starts

    def start(self, shards: tuple[str, ...], clients: dict[str, str], *, watcher_host: str) -> None:
        """Start everything, `clients` with the host of each; return once all serve."""
        for name in shards:
            self.start_shard(name)
        self.wait_ready()
        words = (str(self.file), str(self._folder), str(self._ttl_s))
        ahead_ns = str(self._hosts.clock_ahead_ns[watcher_host])
        self.watcher = self._run(WATCHER_MODULE, (*words, ahead_ns), WATCHER, watcher_host)
        for name, host in clients.items():
            self.start_client(name, host)
        self.watcher.expect("started")
        for client in self.clients.values():
            client.process.expect("started")

    def start_shard(self, name: str, *, offset_s: float = 0.0, down_ns: int = 0) -> None:
        """Start a shard's daemon; its `ready` is set once it serves.

        Args:
            name: The shard.
            offset_s: By how much its wall clock is wrong.
            down_ns: When its predecessor ended.
        """
        words = (str(offset_s), "shard", "run", name, "--cell", str(self.file))
        process = self._run(self._module, words, name, name)
        shard = self.shards[name] = ShardProcess(name, process, threading.Event(), down_ns)
        threading.Thread(target=self._wait_shard, args=(shard,), daemon=True).start()

    def _wait_shard(self, shard: ShardProcess) -> None:
        """Note when a shard serves, and as which epoch."""
        try:
            said = shard.process.expect("ready:")
        except LinkError as failure:
            if shard.process.status != -signal.SIGKILL:
                shard.failure = failure
            return
        finally:
            if shard.failure is not None:
                shard.ready.set()
        epoch = int(said.partition(", epoch ")[2].partition(",")[0])
        started_ns = int(shard.process.started_s * 1e9)
        self._log.write(
            "restart", shard.name, epoch, shard.down_ns, started_ns, time.monotonic_ns()
        )
        shard.ready.set()

    def wait_ready(self) -> None:
        """Wait until every shard serves.

        Raises:
            LinkError: One does not come up.
        """
        for shard in self.shards.values():
            shard.ready.wait(END_S)
        self.check()

    def start_client(self, name: str, host: str, *, incarnation: int = 1) -> None:
        """Start a client process."""
        full = f"{name}.{incarnation}"
        index = list(self.clients).index(name) if name in self.clients else len(self.clients)
        words = (
            str(self.file),
            str(self._journal(full)),
            full,
            str(hash((self._seed, index, incarnation))),
            str(self._ttl_s),
            str(self._hosts.clock_ahead_ns[host]),
            str(2 + index % 2),
        )
        process = self._run(CLIENT, words, name, host)
        self.clients[name] = StartedClient(name, host, process, incarnation)

    def journal_of(self, client: StartedClient) -> Path:
        """Return the journal of a client process; it exists once the process has started."""
        return self._journal(f"{client.name}.{client.incarnation}")

    def _journal(self, name: str) -> Path:
        return self._folder / f"{name}{SUFFIX}"

    def _run(self, module: str, words: tuple[str, ...], name: str, host: str) -> LineProcess:
        log = self._folder / f"{name}.output"
        return self.run(module, words, log, before=self._hosts.before(host))

    # ---------------------------------------------------------------- ends

    def end_shards(self) -> None:
        """End all daemons in good order, and take note of those that do not."""
        for shard in self.shards.values():
            shard.ready.clear()
            shard.process.signal(signal.SIGTERM)
        for name, shard in self.shards.items():
            status = shard.process.wait_status(END_S)
            if status != 0:
                self._log.write("failure", "a shard does not end well", f"{name}: {status}")

    def check(self) -> None:
        """Raise if a process ended by itself.

        Raises:
            LinkError: One did; the message has the end of its output.
        """
        for shard in self.shards.values():
            if shard.failure is not None:
                raise shard.failure
            if shard.ready.is_set() and shard.process.status is not None:
                shard.process.expect("never said")
        for client in self.clients.values():
            if client.process.status is not None:
                client.process.expect("never said")
        if self.watcher_ended():
            self.watcher.expect("never said")

    def watcher_ended(self) -> bool:
        """Whether the watcher has ended."""
        return hasattr(self, "watcher") and self.watcher.status is not None
