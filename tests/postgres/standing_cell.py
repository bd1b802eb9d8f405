"""A cell of several shards in a database, with a standby daemon beside each that serves."""

import os
import sys
from pathlib import Path

from ports import free_endpoint

from enact_dist.config.environment import without_overrides
from enact_dist.link.log import READY, STANDS_BY
from enact_dist.verify.daemons import LineProcess

TRAPPED = Path(__file__).parents[1] / "e2e"
"""Where `dying_shard` is, a daemon that stops itself at a step of a commit."""


class StandingCell:
    """Two daemons for each shard, at endpoints of their own.

    Attributes:
        file: Its cell.toml.
        daemons: The process that serves each shard.
        standbys: The one that stands by for it.
    """

    def __init__(self, folder, node, *, name, shards, pins, ttl_s, lease_s=2.0):
        self.folder, self.node, self.name = folder, node, name
        self.file = folder / "cell.toml"
        self.ports = {shard: [free_endpoint(), free_endpoint()] for shard in shards}
        self.daemons, self.standbys, self._all = {}, {}, []
        lines = [f'name = "{name}"', 'worlds = ["online"]', f'store = "{node.url}"']
        lines += [f"lease_s = {lease_s}", f"session_ttl_s = {ttl_s}"]
        for shard, places in self.ports.items():
            both = ", ".join(f'"{place}"' for place in places)
            lines += [f"[shards.{shard}]", f'listen = "{places[0]}"', f"advertise = [{both}]"]
        self.file.write_text("\n".join(lines) + f"\n{pins}\n")

    def serves(self, shard):
        """Return whether the shard is still that of its daemon."""
        found = self.node.execute(
            "SELECT holder FROM enact.shard WHERE cell = %s AND name = %s", (self.name, shard)
        )
        return found[0][0].split()[1] == str(self.daemons[shard].pid)

    def start(self, shard):
        """Start both daemons of a shard; return once one serves and the other stands by."""
        self.daemons[shard] = self._run(shard, READY)
        self.standbys[shard] = self._run(shard, STANDS_BY)

    def kill(self, shard):
        """Kill the daemon that serves; its standby takes over by itself."""
        self.daemons[shard].kill()

    def back(self, shard):
        """Return once the standby of a daemon that ended serves, and another one stands by."""
        self.daemons[shard] = self.standbys[shard]
        self.daemons[shard].expect(READY)
        self.standbys[shard] = self._run(shard, STANDS_BY)

    def story(self, shard):
        """Return what the daemons of a shard said last."""
        texts = [file.read_text()[-3000:] for file in sorted(self.folder.glob(f"{shard}.*.log"))]
        return "\n".join(texts)

    def end(self):
        for process in self._all:
            process.end()

    def _run(self, shard, says):
        place = self.ports[shard].pop(0)
        self.ports[shard].append(place)
        words = ["shard", "run", shard, "--cell", str(self.file), "--listen", place, "--standby"]
        log = self.folder / f"{shard}.{place.rpartition(':')[2]}.log"
        found = os.pathsep.join([str(TRAPPED), *sys.path])
        environment = {**without_overrides(os.environ), "PYTHONPATH": found}
        process = LineProcess("dying_shard", words, log, environment=environment)
        self._all.append(process)
        process.expect(says)
        return process
