"""A shard that is killed while its clients keep grants."""

import contextlib
import signal
import time

import pytest
from kept_processes import in_thread, keep

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.errors import LeaseLostError

pytestmark = [pytest.mark.slow, pytest.mark.kept_grants]

SESSIONS = 17
KEPT_EACH = 60
"""Of 64 at most: 1,020 in all."""


def test_shard_killed_with_many_kept_grants_shows_nothing_stale_when_it_is_back(
    process, endpoint, tmp_path, until, record_property
):
    """Nobody who missed the restart is believed, and all locks are free within one TTL."""
    durable, many = Aspect("count", int), [Entity(f"thing/{number}") for number in range(KEPT_EACH)]
    killed = process(endpoint, tmp_path / "data", durability="os")
    with contextlib.ExitStack() as opened:
        deaf = [opened.enter_context(connect(endpoint, actor=f"deaf{n}")) for n in range(SESSIONS)]
        kept = []
        for number, cell in enumerate(deaf):
            for entity in many:
                kept.append(Write(cell.world("online"), Entity(f"{entity.name}/{number}"), durable))
                keep(cell, kept[-1])
            cell._client.renew = lambda: None  # hears nothing of the restart
        used = kept[-1]
        with pytest.raises(LeaseLostError), Lock(used) as lock:
            lock[used] = 13
            killed.send_signal(signal.SIGKILL)
            killed.wait()
            process(endpoint, tmp_path / "data", durability="os")
            ready_s = time.monotonic()
            with connect(endpoint, actor="new") as new:
                online = new.world("online")
                mine = [
                    Write(online, Entity(f"{e.name}/{n}"), durable)
                    for e in many
                    for n in range(SESSIONS)
                ]
                in_thread(take_all, mine, ready_s, record_property)
        for request in kept:
            with Lock(request, wait_s=60.0) as lock:
                assert lock[request] == 7


def take_all(requests, ready_s, record_property):
    """Write to all at once, which nobody else may hold then."""
    with Lock(*requests, wait_s=60.0) as lock:
        record_property("free_s", time.monotonic() - ready_s)
        for request in requests:
            assert lock[request] == 0
            lock[request] = 7
