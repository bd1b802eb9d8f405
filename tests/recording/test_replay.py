"""A replay makes the recorded commits again: the same bytes, groups, order and pace."""

import threading

import numpy as np
import pytest
from recording_samples import BEGIN_NS, counting, datum, file, recorded

from enact_dist import Aspect, Entity, View
from enact_dist.core.protocol.datum import Slot
from enact_dist.errors import ConfigError, DatumTypeError, MisuseError
from enact_dist.recording import Replay
from enact_dist.recording.exporting import world_as_of
from enact_dist.recording.reading import Recording

VALUE = Aspect("value", int)
bench, piece = Entity("bench"), Entity("piece")


def replayed(cell, path, **options):
    run = {key: options.pop(key) for key in ("loop", "stop") if key in options}
    return Replay(cell, path, **({"speed": 0.0} | options)).run(**run)


@pytest.fixture
def run(tmp_path):
    """A recording of ten commits, one every millisecond, each of two slots."""
    path = tmp_path / "run.mcap"
    counting(path, 10).close({"missing": "0"})
    return path


def test_commits_come_again_in_their_groups(cell, online, run):
    """Each commit is one: no view ever sees one slot of it without the other."""
    seen = []
    with online.watch("**") as watch:
        summary = replayed(cell, run)
        seen += [watch.next(30.0) for _ in range(20)]
        assert watch.next(0) is None
    assert (summary.commits, summary.versions, summary.rounds) == (10, 20, 1)
    assert (summary.whole, summary.missing_bytes) == (True, 0)
    assert [change.entity for change in seen] == [bench, piece] * 10
    positions = [change.position for change in seen]
    assert positions[::2] == positions[1::2]
    assert len(set(positions)) == 10
    assert online.view(View(online, bench, VALUE))[View(online, bench, VALUE)] == 10


def test_data_are_the_same_bytes(cell, online, tmp_path):
    """Encoding, body and capture stamp; large ones, too."""
    cloud = np.arange(90_000, dtype=np.float32).reshape(-1, 3)
    path = tmp_path / "run.mcap"
    recording = file(path)
    held = datum(cloud, stamp_ns=42)
    recording.add_commit([recorded("piece", held)], BEGIN_NS)
    recording.close({})
    replayed(cell, path)
    (version,) = world_as_of(online)
    found = version.datum
    assert (found.encoding, bytes(found.body), found.stamp_ns) == (
        held.encoding,
        bytes(held.body),
        42,
    )


def test_null_is_replayed(cell, online, tmp_path):
    """A datum that was deleted is deleted again."""
    path = tmp_path / "run.mcap"
    recording = file(path)
    recording.add_commit([recorded("piece", 1)], BEGIN_NS + 1)
    recording.add_commit([recorded("piece", None, version=2, commit=2)], BEGIN_NS + 2)
    recording.close({})
    assert replayed(cell, path).versions == 2
    assert online.view(View(online, piece, VALUE)).get(View(online, piece, VALUE)) is None


def test_worlds_and_aspects_are_made(cell, run):
    """A recording goes into a context of another name, which need not be there."""
    replayed(cell, run, worlds={"online": "copy"})
    copy = cell.world("copy")
    assert copy.view(View(copy, piece, VALUE))[View(copy, piece, VALUE)] == 10
    assert not cell.world("online").list_slots()
    assert {one.aspect: one.type for one in cell.aspects()}["value"] == "int"


def test_world_that_the_recording_does_not_have_is_named(cell, run):
    """A typing error in OLD=NEW does not end as a replay into the wrong place."""
    with pytest.raises(ConfigError, match=r"onlin.*it has online"):
        Replay(cell, run, worlds={"onlin": "copy"})


def test_world_with_other_data_is_left_alone(cell, online, run):
    """Unless that is asked for, not even its first datum is touched."""
    online.init(piece, Aspect("name", str), "mine")
    with pytest.raises(MisuseError, match=r"piece/name.*--overwrite"):
        replayed(cell, run)
    assert len(online.list_slots()) == 1
    assert replayed(cell, run, overwrite=True).commits == 10


@pytest.mark.parametrize("ended", [True, False], ids=["whole", "cut off"])
def test_refused_replay_makes_no_world(cell, tmp_path, ended):
    """Not the one that stands first in the recording either, where a later one has data."""
    path = tmp_path / "run.mcap"
    recording = file(path, worlds="online training")
    for number, world in enumerate(("online", "training"), 1):
        slot = Slot(world, "piece", "value")
        recording.add_commit([recorded(slot, 1, commit=number)], BEGIN_NS + number)
        recording.end_chunk()
    if ended:
        recording.close({})
    else:
        recording.abandon()
    cell.world("training").init(piece, Aspect("name", str), "mine")

    with pytest.raises(MisuseError, match=r"'training' .* \(--world training=OTHER\)"):
        replayed(cell, path, worlds={"online": "rep9"})

    assert cell.worlds() == ("online", "training")


@pytest.mark.parametrize(("ended", "chunks"), [(True, 0), (False, 10)], ids=["whole", "cut off"])
def test_index_saves_reading_the_chunks(tmp_path, ended, chunks):
    """What a whole recording has versions of takes no time to find out, however long it is."""
    path = tmp_path / "run.mcap"
    counting(path, 10, worlds="online training").close({})
    if not ended:
        path.write_bytes(path.read_bytes()[:-1])

    recording = Recording(path)

    assert recording.look_through() == {"online"}
    assert (recording.chunks, set(recording.aspects)) == (chunks, {"value"})


def test_world_with_data_of_which_the_recording_has_none_is_no_obstacle(cell, tmp_path):
    """Recorded beside others, it had nothing that was chosen: nothing would be changed in it."""
    path = tmp_path / "run.mcap"
    recording = file(path, worlds="online training")
    recording.add_commit([recorded("piece", 1)], BEGIN_NS)
    recording.close({})
    cell.world("training").init(piece, Aspect("name", str), "mine")

    assert replayed(cell, path).commits == 1


def test_world_with_data_is_called_as_the_recording_calls_it(cell, run):
    """The remedy can be typed: --world OLD=NEW takes the recording's name."""
    cell.world("training").init(piece, Aspect("name", str), "mine")

    with pytest.raises(MisuseError, match=r"'training' .* \(--world online=OTHER\)"):
        replayed(cell, run, worlds={"online": "training"})


def test_refused_type_makes_no_world(cell, online, run):
    """Nobody could read the data, so there is no context of them."""
    cell.world("training").init(piece, Aspect("value", str), "a")

    with pytest.raises(DatumTypeError, match=r"aspect 'value' is int in .*run.mcap and str in"):
        replayed(cell, run, worlds={"online": "rep9"})

    assert cell.worlds() == ("online", "training")


def test_aspect_of_another_type_is_refused(cell, online, run):
    """What the cell's actors could not read does not get in."""
    cell.create_world("another").init(piece, Aspect("value", str), "a")
    with pytest.raises(DatumTypeError):
        replayed(cell, run)


def test_pace_is_that_of_the_recording(cell, tmp_path):
    """At half speed it takes twice as long, and a day of it no time at the highest."""
    seconds = []
    for step_ns, speed in ((10**8, 0.5), (86_400 * 10**9, 1e9)):
        path = tmp_path / f"{step_ns}.mcap"
        recording = file(path)
        for number in range(1, 4):
            one = recorded("piece", number, commit=number)
            recording.add_commit([one], BEGIN_NS + number * step_ns)
        recording.close({})
        seconds.append(replayed(cell, path, speed=speed, overwrite=True).seconds)
    slow_s, fast_s = seconds
    assert 0.4 <= slow_s < 30.0
    assert fast_s < 30.0


def test_what_comes_late_is_counted(cell, run, monkeypatch):
    """Nothing is left out to catch up."""
    monkeypatch.setattr("enact_dist.recording.replaying.LATE_S", -1.0)
    summary = replayed(cell, run, speed=1.0)
    assert (summary.late, summary.commits) == (10, 10)


def test_loop_goes_on_until_it_is_stopped(cell, run):
    """The second round writes over the first one's data."""
    stop = threading.Event()
    replay = Replay(cell, run, speed=0.0)
    summary = replay.run(stop, loop=True, tell=lambda s: stop.set() if s.commits == 25 else None)
    assert (summary.commits, summary.rounds) == (25, 2)


def test_replay_that_is_run_twice_writes_over_its_own_data(cell, run):
    """They are not somebody else's."""
    replay = Replay(cell, run, speed=0.0)

    assert [replay.run().commits, replay.run().commits] == [10, 20]


def test_part_begins_with_the_state_as_of_its_begin(cell, online, run):
    """What was set before is there, in one commit, and nothing after the end."""
    replay = Replay(cell, run, speed=0.0)
    replay.between(BEGIN_NS + 4_500_000, BEGIN_NS + 6_000_000)
    summary = replay.run()
    assert (summary.commits, summary.versions) == (2, 2 + 4)
    request = View(online, piece, VALUE)
    assert online.view(request)[request] == 6


def test_part_after_the_end_is_the_last_state(cell, online, run):
    """Beginning later than the last commit still gives all that was known."""
    replay = Replay(cell, run, speed=0.0)
    replay.between(BEGIN_NS + 10**12)
    assert replay.run().versions == 2
    request = View(online, piece, VALUE)
    assert online.view(request)[request] == 10


def test_cut_recording_is_replayed_up_to_its_last_whole_chunk(cell, run, tmp_path):
    """And says how much is missing."""
    path = tmp_path / "cut.mcap"
    path.write_bytes(run.read_bytes()[:3000])
    summary = replayed(cell, path)
    assert 0 < summary.commits < 10
    assert summary.missing_bytes > 0
    assert not summary.whole


def test_more_than_one_lock_may_write_comes_in_several(cell, online, tmp_path, monkeypatch):
    """Only the first state of a large context is ever so much."""
    monkeypatch.setattr("enact_dist.recording.replaying.ITEMS_MAX", 3)
    path = tmp_path / "run.mcap"
    recording = file(path)
    recording.add_commit([recorded(f"p/{n}", n, commit=0) for n in range(7)], BEGIN_NS)
    recording.close({})
    summary = replayed(cell, path)
    assert (summary.versions, summary.commits) == (7, 0)
    assert len(online.list_slots()) == 7


def test_speed_that_makes_no_sense_is_refused(cell, run):
    """Time does not run backwards."""
    with pytest.raises(ConfigError, match="-1"):
        Replay(cell, run, speed=-1.0)


def test_several_worlds_of_one_commit_stay_one_commit(cell, tmp_path):
    """A lock over two contexts is a lock over two contexts again."""
    path = tmp_path / "run.mcap"
    recording = file(path, worlds="online training")
    pair = [recorded(Slot(world, "piece", "value"), 1) for world in ("online", "training")]
    recording.add_commit(pair, BEGIN_NS)
    recording.close({})
    assert replayed(cell, path).commits == 1
    stamps = {cell.world(name).list_slots()[0].position for name in ("online", "training")}
    assert len(stamps) == 1


def test_who_begins_before_the_recording_does_not_wait_for_it(cell, run):
    """An hour before it nothing was recorded: its first commit comes at once."""
    replay = Replay(cell, run, speed=1.0)
    replay.between(BEGIN_NS - 3_600 * 10**9)
    stop = threading.Event()
    overdue = threading.Timer(30.0, stop.set)
    overdue.start()
    summary = replay.run(stop)
    overdue.cancel()
    assert (summary.commits, summary.rounds) == (10, 1)


def test_an_end_before_the_begin_is_refused(cell, run):
    """By how much; nothing is set."""
    with pytest.raises(ConfigError, match=r"the end lies 2 s before the begin"):
        Replay(cell, run).between(BEGIN_NS + 3 * 10**9, BEGIN_NS + 10**9)


def test_a_name_that_none_can_have_is_refused(cell, run):
    """Before anything is written."""
    with pytest.raises(ConfigError, match=r"'a b' cannot name a world context"):
        Replay(cell, run, worlds={"online": "a b"})


def test_two_contexts_are_not_written_into_one(cell, tmp_path):
    """Their slots would overwrite each other."""
    path = tmp_path / "run.mcap"
    file(path, worlds="online training").close({})
    with pytest.raises(ConfigError, match=r"online, training of .* into 'online'; name others"):
        Replay(cell, path, worlds={"training": "online"})
