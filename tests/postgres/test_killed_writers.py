"""kill -9 of a process that writes to a database, at any byte of what it says: whole or absent."""

import os
import random
import signal
import subprocess
import sys

import store_writer
from shard_stores import address_of, take
from store_writer import group_versions
from tcp_proxy import TcpProxy
from test_postgres_fence import through
from test_store_crash import killed_writer

KILLS = 12
BYTES = 300_000
"""What a writer says in some three batches."""


def test_acknowledged_batches_survive_kill_9_at_any_byte(server, shard_name):
    """Before, within and after the commit: all that was acknowledged is there, nothing half."""
    rng = random.Random(7)
    acknowledged, in_all = [0] * store_writer.GROUPS, 0
    address = address_of(server.url, shard_name, lease_s=store_writer.KILLED_LEASE_S)
    with TcpProxy(server.port) as proxy:

        def ready(pid):
            proxy.cut_after(rng.randrange(BYTES), lambda: os.kill(pid, signal.SIGKILL))

        place = through(proxy, server.url, server.port)
        command = [sys.executable, store_writer.__file__, place, shard_name]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as writers:
            for number in range(KILLS):
                for group, version in killed_writer(writers, number, run_s=60.0, ready=ready):
                    assert version > acknowledged[group]
                    acknowledged[group] = version
                    in_all += 1
                store, recovered, medium = take(address, patient=True)
                found = group_versions(recovered)
                pairs = list(zip(acknowledged, found, strict=True))
                assert all(a <= b <= a + store_writer.IN_FLIGHT for a, b in pairs), pairs
                bodies = server.execute(
                    "SELECT count(DISTINCT name) FROM enact.body WHERE shard = %s",
                    (medium._tenure.shard,),
                )
                assert bodies == [(sum(version > 0 for version in found),)]
                store.close()
                acknowledged = found
            writers.stdin.close()
    assert in_all, "no writer came to an acknowledged batch"
