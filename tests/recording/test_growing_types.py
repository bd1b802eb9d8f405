"""An aspect's type gains a field: a recording from before or across it can be replayed and read."""

import threading
from dataclasses import dataclass

import pytest
from slots import datum_of as seen
from slots import put

from enact_dist import Aspect, Entity, local
from enact_dist.errors import DatumTypeError
from enact_dist.recording import Recorder, Replay
from enact_dist.recording.reading import Recording

piece, bench = Entity("piece"), Entity("bench")


def spot(**fields):
    """Return the dataclass `Spot` with a field and, where given, others with defaults."""
    hints = {"x_mm": float} | {name: type(value) for name, value in fields.items()}
    return dataclass(frozen=True)(type("Spot", (), {"__annotations__": hints, **fields}))


Old, New = spot(), spot(name="spot")
OLD, NEW = Aspect("spot", Old), Aspect("spot", New)


@pytest.fixture
def recorded(cell, tmp_path):
    """Return what records a change of the cell into a file."""

    def run(change, name="run.mcap"):
        stop, begun = threading.Event(), threading.Event()
        recorder = Recorder(cell, tmp_path / name, worlds=["online"])
        told = {"tell": lambda _: begun.set()}
        thread = threading.Thread(target=recorder.run, args=(stop,), kwargs=told)
        thread.start()
        try:
            assert begun.wait(60)
            change()
        finally:
            stop.set()
            thread.join(60)
        return tmp_path / name

    return run


def test_recording_of_the_older_type_is_replayed_into_a_cell_of_the_newer(cell, online, recorded):
    """Its data are read with the default, as if they had stayed in the cell."""
    path = recorded(lambda: put(online, piece, OLD, Old(1.0)))
    put(online, bench, NEW, New(2.0, "edge"))
    Replay(cell, path, speed=0.0, worlds={"online": "again"}).run()

    assert seen(cell.world("again"), piece, NEW) == New(1.0, "spot")
    with pytest.raises(DatumTypeError, match="older"):
        put(cell.world("again"), piece, OLD, Old(3.0))


def test_recording_of_the_newer_type_brings_it_to_a_cell_of_the_older(online, recorded):
    """A replay writes, so the cell has the newer type from then on."""
    path = recorded(lambda: put(online, piece, NEW, New(1.0, "edge")))
    with local(worlds=["online"]) as other:
        put(other.world("online"), bench, OLD, Old(2.0))
        Replay(other, path, speed=0.0, worlds={"online": "again"}).run()
        assert seen(other.world("again"), piece, NEW).name == "edge"
        assert seen(other.world("again"), piece, OLD) == Old(1.0)
        with pytest.raises(DatumTypeError, match="older"):
            put(other.world("online"), bench, OLD, Old(3.0))


def test_recording_across_the_change_names_the_newer_type(online, recorded):
    """Data of both are in it; who replays them into an empty cell finds the newer type there."""

    def change():
        put(online, piece, OLD, Old(1.0))
        put(online, piece, NEW, New(2.0, "edge"))

    path = recorded(change)
    recording = Recording(path)
    assert recording.look_through() == {"online"}
    assert recording.aspects["spot"].fingerprint == "Spot{x_mm:float,name:str=}"

    with local(worlds=["online"]) as other:
        assert Replay(other, path, speed=0.0).run().versions == 2
        assert [one.type for one in other.aspects() if one.aspect == "spot"] == [
            "Spot{x_mm:float,name:str=}"
        ]
        found = other.world("online").history(piece, NEW)
        assert [version.datum() for version in found] == [New(1.0, "spot"), New(2.0, "edge")]
