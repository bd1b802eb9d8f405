"""Probes of both daemons of a shard: who is ready, who is alive, and what a standby's page shows."""

import os
import time
import urllib.error
import urllib.request

import pytest
from ports import free_port
from replicated_cell import SHARD, ReplicatedCell
from tcp_proxy import TcpProxy

from enact_dist.config.environment import variable_of
from enact_dist.link.daemon.metrics import SEES_S
from enact_dist.link.log import READY, STANDS_BY

DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))
UNAVAILABLE = 503


class ProbedCell(ReplicatedCell):
    """A cell whose daemons serve probes."""

    def __init__(self, folder, url, name):
        super().__init__(folder, url, os.environ, name=name)
        self.ports = (free_port(), free_port())

    def start(self, place, **options):
        self._environment[variable_of(SHARD, "METRICS")] = str(self.ports[place])
        return super().start(place, **options)

    def ask(self, place, path):
        """Return status and text of a probe."""
        try:
            where = f"http://127.0.0.1:{self.ports[place]}{path}"
            with DIRECT.open(where, timeout=30) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode()

    def becomes(self, place, path, status):
        """Wait until a probe answers with a status."""
        end_s = time.monotonic() + SEES_S + 20.0
        while self.ask(place, path)[0] != status:
            assert time.monotonic() < end_s, (place, path, self.ask(place, path))
            time.sleep(0.05)


@pytest.fixture
def cell(server, tmp_path, shard_name):
    cell = ProbedCell(tmp_path, server.url, f"probed{shard_name}")
    yield cell
    cell.end()


def test_a_standby_is_ready_while_it_sees_its_database_and_alive_without(cell, server):
    """A supervisor restarts neither daemon because the database is away."""
    with TcpProxy(server.port) as proxy:
        port = proxy.endpoint.rpartition(":")[2]
        active = cell.start(0)
        cell.becomes(0, "/ready", 200)
        cell.start(1, says=STANDS_BY, store=server.url.replace(str(server.port), port))
        cell.becomes(1, "/ready", 200)
        _, page = cell.ask(1, "/metrics")
        (sample,) = [line for line in page.splitlines() if not line.startswith("#")]
        assert sample.startswith("enact_standby{")
        assert sample.endswith(f'shard="{SHARD}"}} 1')

        proxy.refuse()
        cell.becomes(1, "/ready", UNAVAILABLE)
        assert cell.ask(1, "/alive") == (200, "yes\n")
        proxy.accept_again()
        cell.becomes(1, "/ready", 200)

        active.kill()
        cell.daemons[1].expect(READY)
        cell.becomes(1, "/ready", 200)
        _, page = cell.ask(1, "/metrics")
        assert f'shard="{SHARD}"}} 1\n' in page.partition("enact_ready{")[2]
        assert f'shard="{SHARD}"}} 0\n' in page.partition("enact_standby{")[2]
