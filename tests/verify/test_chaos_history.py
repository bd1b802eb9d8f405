"""From journals to a verdict: what a run of real processes recorded is told as a history."""

import json
from contextlib import closing

import pytest

from enact_dist.errors import ConfigError, LinkError
from enact_dist.terms import Access
from enact_dist.verify.chaos import chains, evidence, figures, watcher
from enact_dist.verify.chaos.journal import SUFFIX, UNSEEN, Journal, read_lines
from enact_dist.verify.chaos.network import hosts
from enact_dist.verify.checker import LockOutcome

KEPT, OTHER, FRAME = (
    "online:thing/s0/0/kept",
    "online:thing/s1/0/kept",
    "online:thing/s0/0/frame",
)
EPOCHS = {"s0": 7, "s1": 9}


class Recorded:
    """Writes the folder of a run by hand; locks come one after the other unless told otherwise."""

    def __init__(self, folder):
        self.folder = folder
        self.now = 0
        self.ttl_ns = 10**9
        settings = {"missing": [], "ttl_s": 1.0, "seed": 1, "groups": {"a": "g0", "b": "g0"}}
        (folder / evidence.SETTINGS).write_text(json.dumps(settings))
        self.faults = Journal(folder / evidence.FAULTS)
        self.watcher = Journal(folder / watcher.LOG)
        self.journals = {}
        self.restart("s0", 7)
        self.restart("s1", 9)

    def restart(self, shard, epoch, *, down_ns=0):
        EPOCHS[shard] = epoch
        self.now += 10
        self.faults.write("restart", shard, epoch, down_ns, self.now - 5, self.now)

    def lock(
        self, name, *, reads=(), views=(), writes=(), items=(), end="committed", why="", **more
    ):
        """Add a lock `client.number`; readings are (slot, version, writer)."""
        client = name.partition(".")[0]
        journal = self.journals.get(client) or self.journals.setdefault(
            client, Journal(self.folder / f"{client}.1{SUFFIX}")
        )
        at = more.get("at") or (self.now + 1, self.now + 9)
        self.now = max(self.now, at[1] or 0)
        epochs = more.get("epochs") or EPOCHS
        journal.write("begin", name, at[0], more.get("kind", "hand made"), items)
        journal.write(
            "granted", name, more.get("granted", at[0]), [[s, e, 1] for s, e in epochs.items()]
        )
        seen = [[*reading, True] for reading in reads] + [[*view, False] for view in views]
        journal.write("seen", name, seen)
        if end != "before":
            journal.write("write", name, writes, more.get("expected", []))
        if end and end != "before":
            journal.write("end", name, at[1], end, why)
        return self

    def loaded(self):
        return evidence.load(self.folder)

    def rules(self):
        return [anomaly.rule for anomaly in figures.judge(self.loaded()).anomalies]


@pytest.fixture
def recorded(tmp_path):
    EPOCHS.update(s0=7, s1=9)
    return Recorded(tmp_path)


def test_sound_run_passes_and_is_counted(recorded):
    """Commits over shards, a reader, a refused zombie; the figures say how many of each."""
    recorded.lock(
        "a.1", reads=[(KEPT, 0, ""), (OTHER, 0, "")], writes=[(KEPT, 1, "a.1"), (OTHER, 1, "a.1")]
    )
    recorded.lock("b.1", reads=[(KEPT, 1, "a.1")], writes=[(KEPT, 2, "b.1")])
    recorded.lock(
        "a.2",
        reads=[(KEPT, 1, "a.1")],
        writes=[(KEPT, 2, "a.2")],
        end="not committed",
        why="LeaseLostError",
    )
    recorded.lock("b.2", reads=[(KEPT, 2, "b.1")], views=[(OTHER, 1, "a.1"), (KEPT, 2, "b.1")])
    recorded.watcher.write("counters", "s0", 7, {"fenced": 1})
    recorded.watcher.write("counters", "s1", 9, {"fenced": 2})

    verdict = figures.judge(recorded.loaded())

    assert verdict.anomalies == []
    assert (verdict.locks, verdict.commits, verdict.reads, verdict.fenced) == (4, 2, 1, 1)
    assert verdict.counters["fenced"] == 3
    assert verdict.outcomes == {"LeaseLostError": 1, "committed": 3}
    assert verdict.views_checked == 1


def test_version_that_nobody_saw_belongs_to_who_was_told_so(recorded):
    """A blind write follows another: both are in the chain."""
    recorded.lock("a.1", writes=[(KEPT, 1, "a.1")])
    recorded.lock("b.1", reads=[(KEPT, 1, UNSEEN)], writes=[(KEPT, 2, "b.1")])
    recorded.lock("b.2", reads=[(KEPT, 2, "b.1")])

    history = chains.CheckedHistory(recorded.loaded())

    assert [state.writer for state in history.chains[KEPT]] == ["a.1", "b.1"]
    assert history.anomalies() == []


@pytest.mark.parametrize("told", ["", "unknown"])
def test_lock_whose_end_is_unknown_counts_once_it_was_seen(recorded, told):
    """A dead client's commit stands if anybody saw it, or if a later version needs it."""
    recorded.lock("a.1", writes=[(KEPT, 1, "a.1"), (OTHER, 1, "a.1")], end=told)
    recorded.lock("b.1", reads=[(KEPT, 1, "a.1"), (OTHER, 0, "")])

    assert recorded.rules() == ["half a commit"]


def test_gap_is_filled_by_the_only_one_who_may_have(recorded):
    """Version 1 was overwritten unseen; one dead client may have written it."""
    recorded.lock("a.1", writes=[(KEPT, 1, "a.1")], end="")
    recorded.lock("b.1", reads=[(KEPT, 1, UNSEEN)], writes=[(KEPT, 2, "b.1")])
    recorded.lock("b.2", reads=[(KEPT, 2, "b.1")])
    assert recorded.rules() == []
    assert figures.judge(recorded.loaded()).guessed == 0

    recorded.lock("c.1", writes=[(KEPT, 1, "c.1")], end="", at=(1, None))
    assert recorded.rules() == []
    assert figures.judge(recorded.loaded()).guessed == 1


def test_gap_that_nobody_can_have_written_is_named(recorded):
    """Version 2 stands and version 1 was never written."""
    recorded.lock("b.1", writes=[(KEPT, 2, "b.1")]).lock("b.2", reads=[(KEPT, 2, "b.1")])

    assert recorded.rules() == ["versions have a gap"]


def test_lost_commit_is_named(recorded):
    """Told committed, and the last reader finds the state before."""
    recorded.lock("a.1", writes=[(KEPT, 1, "a.1")]).lock("final.1", reads=[(KEPT, 0, "")])

    assert recorded.rules() == ["told committed, but lost"]


def test_version_of_two_writers_is_named(recorded):
    """Two locks, one version: seen by one reader as this, by another as that."""
    for name in ("a", "b"):
        recorded.lock(f"{name}.1", reads=[(KEPT, 0, "")], writes=[(KEPT, 1, f"{name}.1")])
    recorded.lock("a.2", reads=[(KEPT, 1, "a.1")]).lock("b.2", reads=[(KEPT, 1, "b.1")])

    assert "one version was written twice" in recorded.rules()


def test_told_not_but_visible_is_named(recorded):
    """The zombie's write is there."""
    recorded.lock("a.1", writes=[(KEPT, 1, "a.1")], end="not committed", why="LeaseLostError")
    recorded.lock("b.1", reads=[(KEPT, 1, "a.1")])

    assert recorded.rules() == ["told not committed, but visible"]


def test_datum_under_another_version_is_named(recorded):
    """A datum says which version it was written as."""
    recorded.lock("a.1", writes=[(KEPT, 1, "a.1")]).lock("b.1", reads=[(KEPT, 2, "a.1")])

    assert "a datum under another version" in recorded.rules()


def test_deleted_datum_is_a_state_of_its_deleter(recorded):
    """Null under a version above 0 was written by who deleted."""
    recorded.lock("a.1", writes=[(KEPT, 1, "a.1")])
    recorded.lock("b.1", reads=[(KEPT, 1, "a.1")], writes=[(KEPT, 2, "")])
    recorded.lock("a.2", reads=[(KEPT, 2, "")], writes=[(KEPT, 3, "a.2")])
    recorded.lock("b.2", reads=[(KEPT, 3, "a.2")])
    assert recorded.rules() == []

    recorded.lock("b.3", reads=[(KEPT, 4, "")])
    assert "written by no lock" in recorded.rules()


def test_volatile_slot_starts_anew_with_its_shard(recorded):
    """A restart empties it; what was promised before may be applied after it, as another version."""
    recorded.lock("a.1", writes=[(FRAME, 1, "a.1")])
    recorded.lock("a.2", reads=[(FRAME, 1, "a.1")], writes=[(FRAME, 2, "a.2"), (OTHER, 1, "a.2")])
    recorded.restart("s0", 8, down_ns=recorded.now + 1)
    recorded.lock("b.1", reads=[(FRAME, 1, "a.2")], writes=[(FRAME, 2, "b.1")])
    recorded.lock("b.2", views=[(FRAME, 2, "b.1")], reads=[(OTHER, 1, "a.2")])

    history = chains.CheckedHistory(recorded.loaded())

    writers = [state.writer for state in history.chains[FRAME]]
    assert writers == ["a.1", "restart 8 of s0 under a.2", "a.2", "b.1"]
    assert history.anomalies() == []


def test_promise_may_be_applied_after_two_restarts(recorded):
    """Told committed before both, which each empty the slot before it: no time order is broken."""
    recorded.lock("a.1", writes=[(FRAME, 1, "a.1"), (OTHER, 1, "a.1")])
    recorded.restart("s0", 8, down_ns=recorded.now + 1)
    recorded.restart("s0", 9, down_ns=recorded.now + 1)
    recorded.lock("b.1", reads=[(FRAME, 1, "a.1"), (OTHER, 1, "a.1")])

    history = chains.CheckedHistory(recorded.loaded())

    names = [f"restart {epoch} of s0 under a.1" for epoch in (8, 9)]
    assert [state.writer for state in history.chains[FRAME]] == [*names, "a.1"]
    assert history.anomalies() == []


def viewed_after_restart(recorded, writes, *, seen_before=False, followed=False):
    """Tell of a commit, a restart of s0, and one expected view of the commit in the new epoch."""
    recorded.lock("a.1", writes=writes)
    if seen_before:
        recorded.lock("b.1", views=[(FRAME, 1, "a.1")])
    if followed:
        recorded.lock("b.1", reads=[(FRAME, 1, UNSEEN)], writes=[(FRAME, 2, "b.1")])
    recorded.restart("s0", 8, down_ns=recorded.now + 1)
    view = {"views": [(FRAME, 1, "a.1")], "expected": [FRAME], "epochs": {"s1": 9}}
    version = len(writes)
    recorded.lock("b.2", writes=[(OTHER, version, "b.2")], **view)
    recorded.lock("final.1", reads=[(OTHER, version, "b.2")], epochs={"s1": 9})
    return recorded.rules()


OVER_SHARDS = [(FRAME, 1, "a.1"), (OTHER, 1, "a.1")]


def test_promise_over_a_restart_may_be_known_from_a_view_alone(recorded):
    """Promised as version 1, applied as version 1 of the next epoch, and only a view shows it."""
    assert viewed_after_restart(recorded, OVER_SHARDS) == []

    history = chains.CheckedHistory(recorded.loaded())
    writers = [state.writer for state in history.chains[FRAME]]
    assert writers == ["restart 8 of s0 under a.1", "a.1"]


def test_view_of_what_the_restart_emptied_is_named(recorded):
    """A commit on one shard is not promised: after a restart of its shard nothing is left of it."""
    assert viewed_after_restart(recorded, OVER_SHARDS[:1]) == ["stale read"]


@pytest.mark.parametrize("witness", ["seen_before", "followed"])
def test_view_of_what_was_applied_before_the_restart_is_named(recorded, witness):
    """A commit over shards that somebody found before the restart was not applied after it."""
    assert "stale read" in viewed_after_restart(recorded, OVER_SHARDS, **{witness: True})


def test_view_while_its_shard_ends_is_of_the_epoch_that_ends(recorded):
    """The shard answers on while it stops, and the next one has a version 1 of its own."""
    recorded.lock("a.1", writes=OVER_SHARDS)
    down_ns = recorded.now + 1
    recorded.lock("b.1", views=[(FRAME, 1, "a.1")], epochs={}, at=(down_ns + 1, down_ns + 2))
    recorded.restart("s0", 8, down_ns=down_ns)
    recorded.lock("b.2", reads=[(FRAME, 0, "")], writes=[(FRAME, 1, "b.2")])
    recorded.lock("final.1", reads=[(FRAME, 1, "b.2"), (OTHER, 1, "a.1")])

    assert recorded.rules() == []


def test_read_of_what_the_restart_emptied_is_named(recorded):
    """Also where its writer was told nothing, and nobody else saw it."""
    recorded.lock("a.1", writes=[(FRAME, 1, "a.1")], end="")
    recorded.restart("s0", 8, down_ns=recorded.now + 1)
    recorded.lock("b.1", reads=[(FRAME, 1, "a.1")])

    assert "a volatile datum outlived its shard" in recorded.rules()


def test_volatile_datum_that_outlives_its_shard_is_named(recorded):
    """Seen before the restart and after it: it was written once."""
    recorded.lock("a.1", writes=[(FRAME, 1, "a.1")]).lock("b.1", reads=[(FRAME, 1, "a.1")])
    recorded.restart("s0", 8, down_ns=recorded.now + 1)
    recorded.lock("b.2", reads=[(FRAME, 1, "a.1")])

    assert "one write stands twice" in recorded.rules()


def test_pattern_reads_what_it_does_not_show(recorded):
    """Two locks that each looked, found nothing and created: a phantom, told as write skew."""
    each = [[int(Access.WRITE_EACH), "online", "made/3/*", "made"]]
    for name in ("a", "b"):
        slot = f"online:made/3/{name}/made"
        recorded.lock(f"{name}.1", items=each, writes=[(slot, 1, f"{name}.1")], at=(50, 60))
    every = [[int(Access.READ_EACH), "online", "made/**", "made"]]
    seen = [(f"online:made/3/{name}/made", 1, f"{name}.1") for name in ("a", "b")]
    recorded.lock("final.1", items=every, reads=seen)

    assert recorded.rules() == ["write skew"]


def test_expected_view_counts_as_read(recorded):
    """A view that the commit expected, and that was old by then."""
    recorded.lock("a.1", writes=[(OTHER, 1, "a.1")])
    recorded.lock("b.1", views=[(OTHER, 0, "")], writes=[(KEPT, 1, "b.1")], expected=[OTHER])
    recorded.lock("final.1", reads=[(KEPT, 1, "b.1"), (OTHER, 1, "a.1")])

    assert recorded.rules() == ["stale read"]


def test_unexpected_error_is_an_anomaly(recorded):
    """Faults explain some errors; others are findings."""
    recorded.lock("a.1", end="unknown", why="unexpected: ProtocolError: too short")

    assert recorded.rules() == ["1 times unexpected: ProtocolError: too short"]


def test_recovery_counts_from_the_start_and_the_death(recorded):
    """Restart to grant, death to next grant, doubt to end."""
    s = 10**9
    recorded.lock(
        "a.1", items=[[2, "online", "thing/s1/0", "kept"]], end="before", at=(2 * s, None)
    )
    recorded.faults.write("fault", "kill client", ["a.1"], 3 * s, 3 * s + 1)
    recorded.lock(
        "b.1",
        items=[[2, "online", "thing/s1/0", "kept"]],
        at=(int(2.5 * s), 5 * s),
        granted=int(3.5 * s),
    )
    recorded.now = 60 * s
    recorded.restart("s0", 8, down_ns=59 * s)
    recorded.lock("b.2", at=(61 * s, 62 * s))
    recorded.watcher.write("doubt", "b.1", "s1", 30 * s, 33 * s)
    recorded.faults.write("fault", "stop shard", ["s0"], 29 * s, 32 * s)

    found = figures.judge(recorded.loaded()).recovery

    assert found["serving to first grant"].n == 1
    assert found["serving to first grant"].max_s == pytest.approx(1.0)
    assert found["holder killed to next grant"].max_s == pytest.approx(0.5)
    assert found["in doubt"].max_s == pytest.approx(1.0)


def test_spread_of_nothing_is_zero():
    """Percentiles are of what there is."""
    assert figures.spread([]).n == 0
    assert figures.spread([10**9, 3 * 10**9]) == figures.Spread(2, 1.0, 3.0, 3.0)


def test_torn_last_line_is_left_out(tmp_path):
    """A process that was killed in mid-line leaves half of one; in the middle it is an error."""
    path = tmp_path / "a.journal"
    path.write_bytes(b'["begin","a.1"]\n["gran')
    assert list(read_lines(path)) == [["begin", "a.1"]]

    path.write_bytes(b'["begin","a.1"]\n["gran\n["end"]\n')
    with pytest.raises(ValueError, match="line 2"):
        list(read_lines(path))


def test_folder_of_something_else_is_refused(tmp_path):
    """A wrong folder is named."""
    with pytest.raises(ConfigError, match="no folder of a chaos run"):
        evidence.load(tmp_path)


def test_without_namespaces_what_is_left_out_is_named(monkeypatch):
    """On a system without the tools the cell runs on the loopback, and says what is missing."""
    monkeypatch.setenv("PATH", "")
    with closing(hosts.open_hosts(("s0", "g0"))) as found:
        assert isinstance(found, hosts.Loopback)
        assert any(
            "partitions (the program unshare is not installed)" in name for name in found.missing
        )
        with pytest.raises(LinkError, match="one host"):
            found.cut("s0", "g0")
    with pytest.raises(LinkError, match="not installed"):
        hosts.open_hosts(("s0", "g0"), required=True)


def test_told_has_the_words_of_the_journal():
    """What journals say is what the checker understands."""
    assert {told.value for told in LockOutcome} == {"committed", "not committed", "unknown"}
