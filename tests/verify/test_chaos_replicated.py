"""What a chaos run in a database makes of late answers, of daemons that end, and of several cuts."""

import json
import signal
from contextlib import closing
from types import SimpleNamespace

import pytest

from enact_dist.errors import ConfigError, LinkError
from enact_dist.verify.chaos import evidence, figures, runner, watcher
from enact_dist.verify.chaos.journal import Journal
from enact_dist.verify.chaos.network.hosts import Loopback
from enact_dist.verify.chaos.replicated.answers import AnswerTimes, read_answers
from enact_dist.verify.chaos.replicated.cell import AS_ORDERED, UNEXPECTED_END, ReplicatedCell
from enact_dist.verify.chaos.replicated.cuts import SharedCuts, ways_between
from enact_dist.verify.chaos.replicated.stage import _forget

S = 10**9


@pytest.fixture
def folder(tmp_path):
    """A run in which shard s0 was taken over at 5 s, and served from 6 s on."""
    told = {"missing": [], "ttl_s": 1.0, "seed": 1, "groups": {}, "store": "nodes"}
    (tmp_path / evidence.SETTINGS).write_text(json.dumps(told))
    Journal(tmp_path / watcher.LOG).close()
    with closing(Journal(tmp_path / evidence.FAULTS)) as log:
        # A later takeover may be noted first: its daemon's lines are read by another thread.
        log.write("restart", "s0", 8, 5 * S, 5 * S, 6 * S, 6 * S)
        log.write("restart", "s0", 7, 1 * S, 1 * S, 2 * S, 2 * S)
    return tmp_path


def answered(folder, epoch, *times_ns):
    times = AnswerTimes(folder / f"s0@h0.{epoch}.answers")
    times.serves(epoch)
    for at_ns in times_ns:
        times.add(at_ns)


def test_answers_before_the_next_epoch_are_no_anomaly(folder):
    """All four answers count, none of them as late."""
    answered(folder, 7, 2 * S, 5 * S)
    answered(folder, 8, 6 * S, 60 * S)

    verdict = figures.judge(evidence.load(folder))

    assert verdict.anomalies == []
    assert (verdict.answers, verdict.late_answers, verdict.takeovers) == (4, 0, 1)
    assert verdict.writes == dict.fromkeys(verdict.writes, 0)


def test_answer_of_an_old_daemon_is_named(folder):
    """One that it let out after the database had been asked for the next epoch."""
    answered(folder, 7, 4 * S, 5 * S + S // 4)
    answered(folder, 8, 6 * S)

    verdict = figures.judge(evidence.load(folder))

    (anomaly,) = verdict.anomalies
    assert anomaly.rule == "an old daemon answered after its lease"
    assert anomaly.facts == ("s0, epoch 7: 0.250 s too late",)
    assert verdict.late_answers == 1


def test_ring_keeps_the_newest_answers(tmp_path):
    """Of more than it holds, the oldest make room, and all are counted."""
    path = tmp_path / "a.answers"
    times = AnswerTimes(path)
    times.serves(3)
    for at_ns in range(1, 20_001):
        times.add(at_ns)

    found = read_answers(path)

    assert (found.epoch, found.answers) == (3, 20_000)
    assert max(found.last_ns) == 20_000
    assert len(found.last_ns) == 1 << 14


@pytest.mark.parametrize(
    ("ordered", "status", "said", "why"),
    [
        (False, 1, "s0 has another holder since epoch 4", "another daemon has the shard"),
        (False, 1, "the database warned (01000 canceling …)", "the database warned"),
        (False, 1, "could not extend file (SQLSTATE 53100)", "the database's disk is full"),
        (False, 1, "KeyError: 'x'", ""),
        (False, 1, "now CRITICAL the database warned\nit ends", "the database warned"),
        (False, -signal.SIGSEGV, "s0 has another holder since epoch 4", ""),
        (False, 0, "", ""),
        (True, -signal.SIGKILL, "", AS_ORDERED),
        (True, 0, "", AS_ORDERED),
        (True, 1, "the shard ends: what it has not acknowledged may be lost", ""),
        (True, 1, "no answer, and the shard ends: what it has not acknowledged", AS_ORDERED),
        (False, 1, "no answer, and the shard ends: what it has not acknowledged", ""),
        (True, 1, "KeyError: 'x'", ""),
    ],
)
def test_end_of_a_daemon_is_an_anomaly_unless_it_may_end_so(tmp_path, ordered, status, said, why):
    """Its status, the words of this start alone and whether it was ordered decide."""
    hosts = Loopback(("h0", "h1"), why="none is wanted")
    with closing(hosts), closing(Journal(tmp_path / evidence.FAULTS)) as log:
        cell = ReplicatedCell(
            tmp_path, hosts, ("s0",), log, ttl_s=1.0, seed=0, store="postgresql://db/cell",
            cell="chaos", places=("h0", "h1"), lease_s=1.0,
        )  # fmt: skip
        place = cell.places["s0@h0"]
        place.ordered = ordered
        (tmp_path / "s0@h0.output").write_text(f"KeyError: of one before\n{said}\n")
        place.logged = len("KeyError: of one before\n")
        cell._note_end(place, SimpleNamespace(status=status))
    lines = [json.loads(line) for line in (tmp_path / evidence.FAULTS).read_text().splitlines()]
    noted = [line[3] for line in lines if line[0] == "end"]
    rules = [line[1] for line in lines if line[0] == "failure"]

    assert noted == [why or said]
    assert rules == ([] if why else [UNEXPECTED_END])


def test_way_opens_with_the_last_of_its_cuts():
    """Two cuts of one way are made once and healed once."""
    done = []
    hosts = SimpleNamespace(
        cut=lambda *way: done.append(("cut", *way)), heal=lambda *way: done.append(("heal", *way))
    )
    cuts = SharedCuts(hosts)
    one_way, both = ways_between("a", ["b"], hears=False), ways_between("a", ["b"])

    cuts.cut(both)
    cuts.cut(one_way)
    cuts.heal(both)
    assert done == [("cut", "a", "b"), ("cut", "b", "a"), ("heal", "b", "a")]
    cuts.heal(one_way)
    assert done[-1] == ("heal", "a", "b")


def test_store_that_cannot_be_used_is_named_without_its_password():
    """The error shows user, host and database."""
    pytest.importorskip("psycopg")
    with pytest.raises(LinkError, match=r"postgresql://me@127\.0\.0\.1:9/x ") as found:
        _forget("postgresql://me:secret@127.0.0.1:9/x", "chaos")
    assert "secret" not in str(found.value)


def test_namespaces_cannot_be_required_for_a_database_of_others(tmp_path):
    """The refusal names the option that has a database of its own."""
    settings = runner.ChaosSettings(
        1.0, 1, namespaces_required=True, store="postgresql://me@127.0.0.1:9/x"
    )
    with pytest.raises(ConfigError, match="say --store nodes"):
        runner.run(settings, tmp_path, progress=lambda *_: None)
