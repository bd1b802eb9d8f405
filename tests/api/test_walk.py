"""How far a datum walks: the files that one update over a socket enters, on both sides."""

import itertools
import sys
import threading
from collections import Counter
from pathlib import Path

import pytest
from ports import free_endpoint

import enact_dist
from enact_dist import Aspect, Durability, Entity, Lock, Write, connect
from enact_dist.core.protocol.messages import PlacementMap, ShardEntry
from enact_dist.core.shard.state import ShardSettings
from enact_dist.link.daemon.daemon import start_shard
from enact_dist.link.daemon.settings import DaemonSettings

PACKAGE = str(Path(enact_dist.__file__).parent)
COUNT = Aspect("count", int, Durability.VOLATILE)
SIDES = ("caller", "enact-socket")
"""The threads that an update passes: the caller's, and that of its connection to the shard."""
FILES_MAX, CHANGES_MAX = 41, 101
"""What an update takes at present, rounded up; lower them whenever it takes less.  The aim is 24 files
and 110 changes of file.
"""
CALLS_MAX = 133
"""Functions of the package that it calls, 417 once; the aim is 150."""
UPDATES = 50


class Walk:
    """Notes the calls inside the package of all threads that start while it does.

    Attributes:
        calls: For each thread that is traced, the files of the functions it calls, in order; the
            thread that made the walk is `caller`, whatever a test before this one called it.
    """

    def __init__(self):
        self.calls = {}
        self.caller = threading.get_ident()
        self.noting = False

    def __enter__(self):
        threading.setprofile(self._note)
        sys.setprofile(self._note)
        return self

    def __exit__(self, *_):
        sys.setprofile(None)
        threading.setprofile(None)

    def _note(self, frame, event, _):
        if self.noting and event == "call" and frame.f_code.co_filename.startswith(PACKAGE):
            at_caller = threading.get_ident() == self.caller
            name = "caller" if at_caller else threading.current_thread().name
            self.calls.setdefault(name, []).append(frame.f_code.co_filename)


@pytest.fixture
def shard(carrier, tmp_path, monkeypatch):
    """The endpoint of a shard in this process, behind a socket."""
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path))
    endpoint = free_endpoint()
    placement = PlacementMap(1, (ShardEntry("local", (endpoint,)),), ())
    settings = ShardSettings("local", placement, worlds=("online",))
    running = start_shard(DaemonSettings("cell", settings, (endpoint,), carrier=carrier))
    yield endpoint
    running.stop(drain_s=0.0)


@pytest.mark.kept_grants
@pytest.mark.carrier("socket")
def test_update_enters_few_files(shard):
    """`lock[x] = 3` goes down through the layers and up again, without going back and forth."""
    with Walk() as walk, connect(shard) as cell:
        request = Write(cell.world("online"), Entity("cup"), COUNT)

        def update():
            for _ in range(UPDATES):
                with Lock(request) as lock:
                    lock[request] = 3

        update()  # once, for what only the first lock does
        walk.noting = True
        update()
        walk.noting = False

    assert set(SIDES) <= walk.calls.keys()
    walked = [walk.calls[side] for side in SIDES]
    files = Counter(file for each in walked for file in each)
    entered = [file for file, calls in files.items() if calls >= UPDATES // 2]
    changes = sum(a != b for each in walked for a, b in itertools.pairwise(each)) / UPDATES
    calls = sum(files.values()) / UPDATES
    print(f"an update: {len(entered)} files, {changes:.0f} changes of file, {calls:.0f} calls")
    assert len(entered) <= FILES_MAX
    assert round(changes) <= CHANGES_MAX  # a tick of the shard may come in between
    assert round(calls) <= CALLS_MAX
