"""One cell on hosts of its own, joined by a switch that can be told to cut, delay and lose."""

import json
import os
import signal
import time
from itertools import permutations
from pathlib import Path

from enact_dist.verify.chaos.cell import END_S, TestedCell
from enact_dist.verify.chaos.evidence import FAULTS, SETTINGS, load
from enact_dist.verify.chaos.figures import judge
from enact_dist.verify.chaos.journal import SUFFIX, Journal
from enact_dist.verify.chaos.network.hosts import open_hosts
from enact_dist.verify.daemons import LineProcess

HERE = Path(__file__).parent
SHARDS = ("s0", "s1")
CLIENTS = {"a0": "near", "a1": "far"}
TTL_S = 2.0
LONG_S = 180.0


class Site:
    """Shards `s0` and `s1`, clients on the hosts `near` and `far`, a watcher on `watch`.

    Two clients lock at random all the time; two more do what a test tells them.
    """

    def __init__(self, folder):
        self.folder = folder
        self.hosts = open_hosts((*SHARDS, "near", "far", "watch"), seed=1, required=True)
        self._log = Journal(folder / FAULTS)
        settings = {"seed": 1, "ttl_s": TTL_S, "missing": (), "groups": CLIENTS}
        (folder / SETTINGS).write_text(json.dumps(settings))
        self.cell = TestedCell(folder, self.hosts, SHARDS, self._log, ttl_s=TTL_S, seed=1)
        self._all = []
        self.commits = 0

    def start(self):
        self.cell.start(SHARDS, CLIENTS, watcher_host="watch")
        self.near, self.far = self._told("near"), self._told("far")
        for client in (self.near, self.far):
            client.expect("started")
        return self

    def run(self, host, module, *words):
        """Start a program of this folder on a host."""
        path = os.pathsep.join([str(HERE), *filter(None, [os.environ.get("PYTHONPATH")])])
        before = (*self.hosts.before(host), "env", f"PYTHONPATH={path}")
        log = self.folder / f"{host}.{len(self._all)}.output"
        self._all.append(LineProcess(module, words, log, before=before))
        return self._all[-1]

    def _told(self, host):
        words = (str(self.cell.file), str(self.folder / f"{host}{SUFFIX}"), host)
        return self.run(
            host, "told_client", *words, str(TTL_S), str(self.hosts.clock_ahead_ns[host])
        )

    # ---------------------------------------------------------------- network

    def between(self, one, others):
        """Return both directions between a host and others."""
        return [pair for other in others for pair in ((one, other), (other, one))]

    def cut(self, *ways):
        for source, target in ways:
            self.hosts.cut(source, target)

    def heal(self, *ways):
        """End cuts; return the shared time in nanoseconds just before."""
        healed_ns = time.monotonic_ns()
        for source, target in ways:
            self.hosts.heal(source, target)
        return healed_ns

    def lay(self, cable):
        """Let all cables between hosts of the cell be like this."""
        for source, target in permutations((*SHARDS, "near", "far"), 2):
            self.hosts.lay(source, target, cable)

    def reached_ms(self, client, shard, since_ns):
        """Return how long after `since_ns` a view of a shard first succeeded."""
        client.tell(f"reached {shard} {since_ns}")
        return float(client.expect("reached", timeout_s=LONG_S))

    def freeze(self, host):
        """Stop all clients of a host, and its network; return how to wake them, and what is cut."""
        processes = [
            getattr(self, host),
            *(c.process for c in self.cell.clients.values() if c.host == host),
        ]
        for process in processes:
            process.signal(signal.SIGSTOP)
        ways = self.between(host, [*SHARDS, "near"])
        self.cut(*ways)

        def wake():
            for process in processes:
                process.signal(signal.SIGCONT)

        return wake, ways

    # ---------------------------------------------------------------- evidence

    def note(self, what, ms):
        """Say how long something took to be reached again; shown with `pytest -rP`."""
        print(f"{what}: reached again after {ms:.0f} ms")

    def check(self):
        """Let the clients come to rest, look at every slot, and judge all that has happened."""
        clients = list(self.cell.clients.values())
        for client in clients:
            client.process.tell("stop")
        for client in clients:
            client.process.expect("done", timeout_s=END_S)
            self.cell.end(client.process)
        self.cell.watcher.tell("final")
        assert self.cell.watcher.expect("final", timeout_s=END_S) == "committed"
        verdict = judge(load(self.folder))
        for name, host in CLIENTS.items():
            self.cell.start_client(name, host, incarnation=clients[0].incarnation + 1)
        assert verdict.anomalies == []
        assert verdict.commits > self.commits, "nobody has committed anything"
        self.commits = verdict.commits
        self.cell.check()
        return verdict

    def close(self):
        for process in reversed(self._all):
            process.end()
        self.cell.close()
        self.hosts.close()
        self._log.close()
