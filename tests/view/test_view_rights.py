"""The view in a cell with rights: what it may not read is named, and takes nothing else with it."""

import pytest

pytest.importorskip("cryptography", reason="making keys needs the extra 'keys'")
pytest.importorskip("viser", reason="pages need the extra 'view'")

from polling import until
from rights_cells import guarded_cell

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.cli.main import main
from enact_dist.config.shows import GUESSED
from enact_dist.core.protocol.datum import Slot
from enact_dist.view.feed import Feed
from enact_dist.view.source import CellSource

pytestmark = pytest.mark.carrier("auto")

SLOTS = [Slot("online", name, "count") for name in ("open/x", "secret/x", "secret/y")]


@pytest.fixture
def file(tmp_path, request):
    cell = guarded_cell(tmp_path, carrier=getattr(request, "param", "zenoh"))
    with cell.running():
        yield cell.file


def put(cell, value):
    writes = [Write(cell.world("online"), Entity(s.entity), Aspect("count", int)) for s in SLOTS]
    with Lock(*writes) as lock:
        for write in writes:
            lock[write] = value


def test_what_is_not_readable_is_named_beside_the_rest(file, monkeypatch):
    """Live as in the past; what is readable goes on being shown."""
    with connect(file, actor="ada") as ada:
        put(ada, 1)
        monkeypatch.setenv("ENACT_IDENTITY", "reader")
        with connect(file, actor="view", observer=True) as cell:
            source = CellSource(cell)
            feed = Feed(source, lambda _: GUESSED, rate_hz=50.0, bytes_s=1e9)
            feed.start()
            try:
                feed.wish("page", SLOTS)
                until(lambda: SLOTS[0] in feed.shown(SLOTS))
                put(ada, 2)
                until(lambda: "reader may not read online:secret/x/count" in feed.problem)
                until(lambda: feed.shown(SLOTS)[SLOTS[0]].recorded.version == 2)
                assert set(feed.shown(SLOTS)) == {SLOTS[0]}
            finally:
                feed.stop()
            found = source.data_at(SLOTS, feed.catalogue.newest_ns)
            assert set(found.data) == {SLOTS[0]}
            assert sorted(slot for slot, _ in found.denied) == SLOTS[1:]


@pytest.mark.parametrize("file", ["zenoh", "socket"], indirect=True)
def test_history_of_what_is_not_readable_takes_no_other_with_it(file, monkeypatch):
    """Neither one slot alone, which its shard refuses, nor one among several."""
    with connect(file, actor="ada") as ada:
        put(ada, 1)
        monkeypatch.setenv("ENACT_IDENTITY", "reader")
        with connect(file, actor="view", observer=True) as cell:
            source = CellSource(cell)
            alone = Slot("online", "secret/x", "unknown")
            assert source.histories([SLOTS[1]]) == {}
            assert source.histories([*SLOTS, alone]).keys() == {SLOTS[0]}
            assert source.histories([SLOTS[0], alone]).keys() == {SLOTS[0]}


def test_without_the_right_to_observe_it_ends(file, capsys, monkeypatch):
    """With the reason, before a page is served."""
    monkeypatch.setenv("ENACT_IDENTITY", "blind")
    assert main(["view", str(file)]) == 1
    assert "blind may not observe the cell" in capsys.readouterr().err
