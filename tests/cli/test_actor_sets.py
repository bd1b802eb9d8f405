"""`enact actor ls` names the sets that an actor never got."""

import signal
import time

import pytest

from enact_dist import Aspect, Entities, Entity, Lock, Write, connect

MODULE = """\
from enact_dist import Actor, Aspect, Entity, Together, View, World, Write

DEPTH = Aspect("set_depth", int, retention=4)
online = World("online")


class Sum(Actor):
    depths = Together([View(online, Entity(f"set/{side}"), DEPTH) for side in ("l", "r")])
    total = Write(online, Entity("set"), Aspect("set_total", int))
    triggers = (depths,)

    def update(self, lock):
        lock[self.total] = sum(lock[self.depths])
"""
DEPTH, TOTAL = Aspect("set_depth", int), Aspect("set_total", int)
PATIENCE_S = 30.0


@pytest.fixture
def summing(tmp_path, spawn, until, cell_file):
    """The actor in a process of its own."""
    (tmp_path / "set_actors.py").write_text(MODULE, encoding="utf-8")
    process = spawn("actor", "run", "set_actors:Sum", "--cell", cell_file, "--name", "sum")
    until(process, "ready: actor sum in cell clitest")
    yield process
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 0


def test_ls_counts_incomplete_sets_and_names_what_was_missing(summing, cell_file, enact):
    """One line per actor that has some, and the counters in its JSON."""
    with connect(cell_file) as cell:
        online = cell.world("online")

        def put(side, stamp_ns):
            request = Write(online, Entity(f"set/{side}"), DEPTH)
            with Lock(request) as lock:
                lock.put(request, stamp_ns, stamp_ns=stamp_ns)

        # What was incomplete before it started is not its business: it has run once, so it has.
        with online.watch(Entities("set"), TOTAL) as watch:
            put("l", 1)
            put("r", 1)
            assert watch.next(timeout_s=PATIENCE_S) is not None
        for side, stamp_ns in (("l", 2), ("l", 3), ("r", 3), ("l", 0)):
            put(side, stamp_ns)

    end_s = time.monotonic() + PATIENCE_S
    report = {}
    while report.get("unstamped") != 1 and time.monotonic() < end_s:
        infos = enact("actor", "ls", "--json", "--cell", cell_file).json
        sums = [info["report"] for info in infos if info["actor"] == "sum"]
        report = next((actor for told in sums for actor in told.get("actors", ())), {})
    table = enact("actor", "ls", "--cell", cell_file).out

    assert (report["incomplete"], report["late"], report["unstamped"]) == (1, 0, 1)
    assert report["last_incomplete"] == "set of stamp 2: without online:set/r/set_depth"
    assert (
        "sum: 1 incomplete sets, the newest a set of stamp 2: without online:set/r/set_depth\n"
        "sum: 1 data without a capture stamp, from online:set/l/set_depth: this actor waits for data"
        " with equal stamps; set them with lock.put(…, stamp_ns=…)\n"
    ) in table
