"""A replay of chosen worlds, entities and aspects, and who else writes what it writes."""

import threading

import pytest
from recording_samples import BEGIN_NS, counting, file, recorded

from enact_dist import Actor, Aspect, Entities, Entity, Lock, World, Write
from enact_dist.actor.report import ActorStatistics, encode_reports
from enact_dist.core.protocol.datum import Slot
from enact_dist.errors import ConfigError, MisuseError
from enact_dist.recording import Replay

VALUE = Aspect("value", int)
piece = Entity("piece")


class Weighing(Actor):
    """Writes the replayed datum of each piece that comes."""

    count = Write(World("online"), Entity("piece"), VALUE)

    def update(self, lock: Lock) -> None:
        lock[self.count] = 1


@pytest.fixture
def run(tmp_path):
    """A recording of two worlds, two entities and two aspects; one commit each."""
    path = tmp_path / "run.mcap"
    recording = file(path, worlds="online training")
    number = 0
    for world in ("online", "training"):
        for entity in ("camera/1", "robot"):
            for aspect in ("value", "weight"):
                number += 1
                one = recorded(Slot(world, entity, aspect), number, commit=number)
                recording.add_commit([one], BEGIN_NS + number)
    recording.close({"missing": "0"})
    return path


def replayed_slots(cell, run, **options):
    summary = Replay(cell, run, speed=0.0, **options).run()
    found = [
        f"{world}:{info.entity}/{info.aspect}"
        for world in cell.worlds()
        for info in cell.world(world).list_slots()
    ]
    assert summary.versions == len(found)
    return found


@pytest.mark.parametrize(
    ("options", "slots"),
    [
        (
            {"only_worlds": ["training"], "entities": "camera/*"},
            ["training:camera/1/value", "training:camera/1/weight"],
        ),
        (
            {"aspects": ["weight"], "entities": Entities("robot")},
            ["online:robot/weight", "training:robot/weight"],
        ),
        (
            {"only_worlds": ["online"], "worlds": {"online": "copy"}, "aspects": ["value"]},
            ["copy:camera/1/value", "copy:robot/value"],
        ),
        ({"entities": "nobody"}, []),
    ],
)
def test_only_what_is_chosen_is_replayed(cell, run, options, slots):
    """Worlds, entities and aspects, as a recording chooses them."""
    assert replayed_slots(cell, run, **options) == slots


def test_a_world_that_was_not_chosen_may_have_data_and_types_of_its_own(cell, run):
    """Nothing is changed there."""
    cell.world("training").init(piece, Aspect("weight", str), "mine")

    summary = Replay(cell, run, speed=0.0, only_worlds=["online"], aspects=["value"]).run()

    assert summary.versions == 2


def test_part_begins_with_the_chosen_state(cell, run):
    """What was set before the begin, and was chosen."""
    replay = Replay(cell, run, speed=0.0, only_worlds=["online"], aspects=["weight"])
    replay.between(BEGIN_NS + 100)

    assert replay.run().versions == 2


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"only_worlds": ["onlin"]}, r"no world context 'onlin'; it has online, training"),
        ({"aspects": ["wieght"]}, r"no aspect 'wieght'.*weight.*it has value, weight"),
    ],
)
def test_what_the_recording_does_not_have_is_named(cell, run, options, said):
    """A misspelt name is no replay of nothing."""
    with pytest.raises(ConfigError, match=said):
        Replay(cell, run, speed=0.0, **options).run()


def test_two_worlds_into_one_is_allowed_where_one_was_chosen(cell, run):
    """The other one is not written anywhere."""
    options = {"only_worlds": ["training"], "worlds": {"training": "online"}}

    assert len(replayed_slots(cell, run, **options)) == 4


# ---------------------------------------------------------------- other writers


@pytest.fixture
def pieces(tmp_path):
    path = tmp_path / "pieces.mcap"
    counting(path, 3).close({"missing": "0"})
    return path


def test_an_actor_that_declares_to_write_the_same_is_named_before(cell, pieces):
    """Though it has written nothing so far: it waits for what is replayed."""
    row = ActorStatistics("weighing", "running", writes=("online:piece/value", "online:piece/name"))
    cell._client.set_report(encode_reports([row]))
    told = []
    seen = []

    summary = Replay(cell, pieces, speed=0.0).run(
        warn=told.append, tell=lambda _: seen.append(len(told))
    )

    assert seen[0] == len(told) == 1
    assert told[0].startswith("actor weighing (process ")
    assert "also writes online:piece/value" in told[0]
    assert "stop it, exclude these data (--entities, --aspect)" in told[0]
    assert list(summary.other_writers) == ["online:piece/value"]


@pytest.mark.parametrize(
    "options", [{"entities": "bench"}, {"worlds": {"online": "copy"}}, {"state": "stopped"}]
)
def test_an_actor_that_writes_something_else_is_not_named(cell, pieces, options):
    """Other entities, another world context, or it has ended."""
    state = options.pop("state", "running")
    row = ActorStatistics("weighing", state, writes=("online:piece/value",))
    cell._client.set_report(encode_reports([row]))
    told = []

    Replay(cell, pieces, speed=0.0, **options).run(warn=told.append)

    assert told == []


def test_running_actors_say_what_they_write(cell):
    """With their roles bound, as narrow as the one entity that they work on."""
    from enact_dist.actor.running.runner import ActorRun

    run = ActorRun(Weighing(), cell, {"online": "training"}, stop=threading.Event())

    assert run.statistics().writes == ("training:piece/value",)


def test_whoever_writes_during_the_replay_is_named_once(cell, online, pieces):
    """As soon as the slot is replayed again; how is seen by its versions, declared or not."""
    told = []
    request = Write(online, piece, VALUE)

    def interfere(summary):
        if summary.commits in (1, 2):
            with Lock(request) as lock:
                lock[request] = -1

    summary = Replay(cell, pieces, speed=0.0).run(warn=told.append, tell=interfere)

    (text,) = told
    assert "has written online:piece/value (v2) during the replay" in text
    assert "(process " in text
    assert list(summary.other_writers) == ["online:piece/value"]


def test_shard_that_refuses_to_say_who_wrote_ends_no_replay(cell, online, pieces, monkeypatch):
    """The warning comes without a name."""

    def refuses(*_):
        raise MisuseError("too many versions are asked about")

    monkeypatch.setattr("enact_dist.recording.other_writers.explained", refuses)
    told = []
    request = Write(online, piece, VALUE)

    def interfere(summary):
        if summary.commits == 1:
            with Lock(request) as lock:
                lock[request] = -1

    Replay(cell, pieces, speed=0.0).run(warn=told.append, tell=interfere)

    (text,) = told
    assert text.startswith("another process has written online:piece/value")


def test_a_replay_alone_warns_of_nobody(cell, pieces):
    """Its own commits are not somebody else's, in a second round neither."""
    told = []
    replay = Replay(cell, pieces, speed=0.0)

    assert replay.run(warn=told.append).other_writers == {}
    assert replay.run(warn=told.append).other_writers == {}
    assert told == []
