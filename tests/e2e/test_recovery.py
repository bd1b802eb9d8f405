"""How soon locks are there again after something died, with real daemons and clients."""

import pytest

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.link.client.pauses import Pauses
from enact_dist.verify.recovery import measure

pytestmark = pytest.mark.slow
COUNT = Aspect("count", int)
counter = Entity("counter")
BUSY_S = 25.0
"""What a machine that does other things may add; what nobody frees stays for a minute."""


def test_idle_clients_with_a_long_ttl_let_a_restarted_shard_grant_at_once(make_cell, monkeypatch):
    """Clients learn of the restart by themselves; here no keep-alive is due in the next hour."""
    rest = Pauses.rest
    monkeypatch.setattr(
        Pauses,
        "rest",
        lambda pauses, pause_s, returns=None: rest(
            pauses, 3600.0 if pause_s > 5.0 else pause_s, returns
        ),
    )
    cell = make_cell(ttl_s=60.0).start_all()
    with connect(cell.file, actor="idle") as idle, connect(cell.file, actor="asking") as asking:
        idle.world("online").init(counter, COUNT, 1)
        request = Write(asking.world("online"), counter, COUNT)
        cell.kill()
        cell.start()
        with Lock(request, wait_s=45.0) as lock:  # below the lease that it would outwait
            assert lock[request] == 1


def test_client_goes_on_when_a_shard_gets_a_folder_or_loses_it(make_cell):
    """Locks and a watch, in a session that was open all the time."""
    cell = make_cell(ttl_s=1.0)
    kept = cell.file.read_text()
    unkept = "\n".join(line for line in kept.splitlines() if not line.startswith("data_folder"))
    cell.file.write_text(unkept)
    cell.start_all()
    with connect(cell.file) as joined:
        online = joined.world("online")
        request = Write(online, counter, COUNT)
        with online.watch(counter, COUNT) as watch:
            for number, text in enumerate((unkept, kept, unkept)):
                if number:
                    cell.kill()
                    cell.file.write_text(text)
                    cell.start()
                with Lock(request, wait_s=30.0) as lock:
                    lock[request] = number
                while (change := watch.next(timeout_s=30.0)) is not None and change.null:
                    pass
                assert change is not None
                assert change.position == lock.position


@pytest.mark.timing
def test_recovery_keeps_its_goals():
    """Restart, dead client, dead holder and doubt: each figure twice, soon after its goal at most."""
    figures = measure(2, ttl_s=1.0)

    assert [figure.name for figure in figures] == [
        "shard restarted, all clients alive",
        "shard restarted, one client dead",
        "holder killed, seen over a network",
        "holder killed on the shard's host",
        "client killed in doubt",
    ]
    for figure in figures:
        assert len(figure.times_s) == 2
        assert 0.0 < figure.times_s[-1] <= figure.goal_s + BUSY_S, figure
