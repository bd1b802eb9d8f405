"""A shard that decides is lost for good while others are prepared: what an operator can do."""

import json
import shutil
import threading

import pytest
from accounts import COUNT, LEFT, RIGHT, open_accounts, start_trapped, two_trapped_shards
from polling import until

from enact_dist import Lock, View, Write, connect
from enact_dist.errors import CommitUnknownError
from enact_dist.link.client import locks as link_client

pytestmark = pytest.mark.slow
ANSWER_S = "4"
"""How long the shard that is there may take to answer; the lost one is waited for as long."""


@pytest.fixture
def cell(make_cell):
    """Two shards with one account of 0 on each; s0 decides what is written on both."""
    cell = two_trapped_shards(make_cell, ttl_s=1.0)
    with connect(cell.file) as joined:
        open_accounts(joined)
    return cell


def leave_in_doubt(cell, step, monkeypatch):
    """Let a client commit over both shards and kill the deciding one at `step`, with its folder."""
    monkeypatch.setattr(link_client, "FINISH_S", 1.0)
    told = []
    with connect(cell.file, actor="painter") as joined:
        world = joined.world("online")
        left, right = Write(world, LEFT, COUNT), Write(world, RIGHT, COUNT)

        def commit():
            try:
                with Lock(left, right) as lock:
                    lock[left] = lock[right] = 1
            except CommitUnknownError as error:
                told.append(error)

        cell.daemons["s0"].tell(f"arm {step}")
        cell.daemons["s0"].expect("armed")
        client = threading.Thread(target=commit)
        client.start()
        cell.daemons["s0"].expect("reached")
        cell.kill("s0")
        shutil.move(cell.folder / "data" / "s0", cell.folder / "lost")
        client.join(180.0)
    assert told, "the deciding shard never came back: nobody can say"


def in_doubt(cell):
    """Return the one lock that `enact lock ls` shows, of the shard that is left."""
    done = cell.enact("lock", "ls", "--json", "--timeout", ANSWER_S)
    assert done.returncode == 3
    assert "shard s0 at tcp/" in done.stderr
    (lock,) = json.loads(done.stdout)
    return lock


def resolve(cell, *words):
    return cell.enact("lock", "resolve", "--force-abort", *map(str, words), "--timeout", ANSWER_S)


def audited(cell):
    return [(entry["shard"], entry["kind"]) for entry in json.loads(
        cell.enact("lock", "audit", "--json", "--timeout", ANSWER_S).stdout
    )]  # fmt: skip


def test_lock_in_doubt_is_shown_given_up_and_audited(cell, monkeypatch):
    """The lost shard and the age are shown; resolve wants a reason, frees the data, is audited."""
    leave_in_doubt(cell, "all-prepared", monkeypatch)
    lock = in_doubt(cell)
    assert lock["modes"] == "write, in doubt until s0 decides"
    assert lock["slots"] == ["online:account/right/count (write)"]
    assert lock["age_s"] > 1.0
    assert resolve(cell, lock["number"]).returncode == 2, "without a reason"
    assert in_doubt(cell)["number"] == lock["number"]

    done = resolve(cell, lock["number"], "--reason", "disk of s0 is gone")

    assert done.returncode == 0, done.stderr
    assert f"gave up lock {lock['number']} on s1" in done.stdout
    with connect(cell.file) as joined:
        right = Write(joined.world("online"), RIGHT, COUNT)
        with Lock(right, wait_s=60.0) as free:
            assert free[right] == 0
            free[right] = 7
    table = cell.enact("lock", "audit", "--timeout", ANSWER_S).stdout
    assert "forced" in table
    assert "disk of s0 is gone" in table

    start_trapped(cell, "s0")  # without its data: it has not committed anything
    until(lambda: ("s1", "confirmed") in audited(cell))
    assert "in part" not in cell.enact("doctor").stdout


def test_deciding_shard_that_comes_back_with_a_commit_raises_an_alarm(cell, monkeypatch):
    """Its folder is found after all and says *committed*: log, audit, shard ls and doctor tell."""
    leave_in_doubt(cell, "decided", monkeypatch)
    lock = in_doubt(cell)
    assert resolve(cell, lock["number"], "--reason", "given up").returncode == 0

    shutil.move(cell.folder / "lost", cell.folder / "data" / "s0")
    start_trapped(cell, "s0")

    until(lambda: ("s1", "alarm") in audited(cell))
    assert audited(cell) == [("s1", "forced"), ("s1", "alarm")]
    assert "CRITICAL" in (cell.folder / "s1.log").read_text()
    assert "ALARMS: 1 (enact lock audit)" in cell.enact("shard", "ls").stdout
    doctor = cell.enact("doctor")
    assert doctor.returncode == 1
    assert "commits on s1: 1 locks that were aborted by hand" in doctor.stdout
    with connect(cell.file) as joined:
        views = [View(joined.world("online"), entity, COUNT) for entity in (LEFT, RIGHT)]
        seen = joined.world("online").view(*views)
        assert [seen[view] for view in views] == [1, 0], "torn, as the alarm says"

    assert cell.enact("lock", "audit", "--acknowledge", "mended").returncode == 2, "of which shard?"
    done = cell.enact("lock", "audit", "--acknowledge", "right written again", "--shard", "s1")
    assert done.returncode == 0
    assert "ALARMS" not in cell.enact("shard", "ls").stdout
    assert audited(cell)[-1] == ("s1", "settled")
