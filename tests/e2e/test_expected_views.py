"""What a lock has read, viewed and expected, judged over one embedded shard and over two daemons."""

import signal
import threading
import time
from dataclasses import dataclass, field

import pytest
from accounts import COUNT, LEFT, RIGHT, open_accounts, start_trapped, two_trapped_shards

from enact_dist import Aspect, Durability, Lock, Read, View, Write, connect, local
from enact_dist.core.protocol.messages import Commit
from enact_dist.errors import (
    ChangedError,
    CommitUnknownError,
    LeaseLostError,
    MisuseError,
    ShardUnreachableError,
)
from enact_dist.link.client import locks as link_client
from enact_dist.verify.checker import ChainState, Checker, LockOutcome, LockStory, StateRead

pytestmark = pytest.mark.slow
TTL_S = 1.0
LONG_TTL_S = 20.0
"""Where nobody loses a lock, however long a busy machine lets its holder wait."""


@pytest.fixture
def daemons(make_cell):
    """Two shards with one account of 0 on each."""
    return two_trapped_shards(make_cell, ttl_s=TTL_S)


@pytest.fixture(params=["embedded", "daemons"])
def joined(request):
    """A connection to both accounts, in this process or over two daemons."""
    if request.param == "embedded":
        with local(worlds=["online"]) as cell:
            yield open_accounts(cell)
    else:
        made = two_trapped_shards(request.getfixturevalue("make_cell"), ttl_s=LONG_TTL_S)
        with connect(made.file) as cell:
            yield open_accounts(cell)


def seen(cell, *entities):
    views = [View(cell.world("online"), entity, COUNT) for entity in entities]
    snapshot = cell.world("online").view(*views)
    return [snapshot[view] for view in views]


# ---------------------------------------------------------------- each views what the other writes


@dataclass
class Skew:
    """Two locks that each write one account and view the other; both have viewed before either ends."""

    cell: object
    expects: bool
    in_turn: bool
    viewed: threading.Barrier = field(default_factory=lambda: threading.Barrier(2))
    first_ended: threading.Event = field(default_factory=threading.Event)
    told: dict = field(default_factory=dict)
    stories: list = field(default_factory=list)

    def run(self):
        threads = [
            threading.Thread(target=self._lock, args=pair)
            for pair in ((LEFT, RIGHT), (RIGHT, LEFT))
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return self.told

    def _lock(self, mine, other):
        world = self.cell.world("online")
        write, view = Write(world, mine, COUNT), View(world, other, COUNT)
        begun_ns, error, base = time.monotonic_ns(), None, 0
        try:
            with Lock(write, view, wait_s=60.0) as lock:
                base = lock.version(view)
                lock[write] = lock[view] + 1
                if self.expects:
                    lock.expect(view)
                self.viewed.wait(60.0)
                if self.in_turn and mine == RIGHT:
                    self.first_ended.wait(60.0)
        except ChangedError as changed:
            error = changed
        finally:
            if mine == LEFT:
                self.first_ended.set()
        self.told[str(mine)] = error
        told = LockOutcome.NOT if error else LockOutcome.COMMITTED
        self.stories.append((str(mine), str(other), base, begun_ns, time.monotonic_ns(), told))

    def judged(self, *, views_count_as_reads):
        """Return what the checker finds wrong; the accounts' versions before were 1."""
        stories, chains = (
            [],
            {str(LEFT): [ChainState(1, "init", 1)], str(RIGHT): [ChainState(1, "init", 1)]},
        )
        for mine, other, base, begun_ns, ended_ns, told in self.stories:
            shown = (StateRead(other, base),)
            reads, views = (shown, ()) if views_count_as_reads else ((), shown)
            own = (StateRead(mine, 1),)
            stories.append(LockStory(mine, begun_ns, ended_ns, told, own + reads, views, (mine,)))
            if told is LockOutcome.COMMITTED:
                chains[mine].append(ChainState(2, mine, 2))
        return Checker(stories, chains, events={"init": (0, 1)}).anomalies()


@pytest.mark.parametrize("in_turn", [True, False])
def test_of_two_locks_that_expect_what_the_other_writes_one_fails(joined, in_turn):
    """With `expect` exactly one is told ChangedError in turn; at once, at least one; no anomaly."""
    skew = Skew(joined, expects=True, in_turn=in_turn)

    failed = [name for name, error in skew.run().items() if error is not None]

    assert len(failed) == 1 if in_turn else failed
    changed = [value for value in seen(joined, LEFT, RIGHT) if value]
    assert len(changed) == 2 - len(failed), "what failed is not visible, what committed is"
    assert skew.judged(views_count_as_reads=True) == []


def test_two_locks_that_only_view_what_the_other_writes_both_commit(joined):
    """Without `expect` a view protects nothing: both commit, and the checker names the cycle."""
    skew = Skew(joined, expects=False, in_turn=True)

    assert list(skew.run().values()) == [None, None]

    assert seen(joined, LEFT, RIGHT) == [1, 1], "no serial order gives that"
    assert skew.judged(views_count_as_reads=False) == [], "nothing was promised of views"
    (anomaly,) = skew.judged(views_count_as_reads=True)
    assert "rw account/left" in str(anomaly)
    assert "rw account/right" in str(anomaly)


# ---------------------------------------------------------------- a read that was lost before the end


def write_right(cell, value):
    right = Write(cell.world("online"), RIGHT, COUNT)
    with Lock(right, wait_s=60.0) as lock:
        lock[right] = value


def test_lock_whose_read_shard_restarted_writes_nothing(daemons):
    """Only the reading participant has lost the lock: the write on the other shard fails, too."""
    with connect(daemons.file) as mine, connect(daemons.file) as other:
        open_accounts(mine)
        world = mine.world("online")
        read, write = Read(world, RIGHT, COUNT), Write(world, LEFT, COUNT)
        with pytest.raises(LeaseLostError, match="nothing was written"), Lock(read, write) as lock:
            lock[write] = lock[read] + 1
            daemons.kill("s1")
            start_trapped(daemons, "s1")
            thread = threading.Thread(target=write_right, args=(other, 5))
            thread.start()
            thread.join()

        assert seen(other, LEFT, RIGHT) == [0, 5]


def test_lock_whose_read_lease_expired_writes_nothing(daemons):
    """A client that stood still for 3 TTLs: its read was overwritten, its write is refused."""
    with connect(daemons.file) as other:
        open_accounts(other)
        client = daemons.worker("skew")
        client.expect("holding")
        client.signal(signal.SIGSTOP)
        stopped_s = time.monotonic()
        write_right(other, 5)  # granted when the lease has ended
        while time.monotonic() - stopped_s < 3 * TTL_S:  # the claim is about three TTLs
            assert seen(other, RIGHT) == [5]
        client.signal(signal.SIGCONT)
        client.tell("")

        assert "nothing was written" in client.expect("lost")
        assert seen(other, LEFT, RIGHT) == [0, 5]


def test_embedded_lock_that_was_held_too_long_writes_nothing():
    """In one process, too: after the hold limit another wrote what was read."""
    with local(worlds=["online"]) as cell:
        open_accounts(cell)
        world = cell.world("online")
        read, write = Read(world, RIGHT, COUNT), Write(world, LEFT, COUNT)
        with (
            pytest.raises(LeaseLostError, match="held longer than its limit"),
            Lock(read, write, hold_s=0.2) as lock,
        ):
            lock[write] = lock[read] + 1
            thread = threading.Thread(target=write_right, args=(cell, 5))
            thread.start()
            thread.join()

        assert seen(cell, LEFT, RIGHT) == [0, 5]


# ---------------------------------------------------------------- answers that stay out


class DeafTo:
    """A carrier that loses the first answer to each commit."""

    def __init__(self, inner):
        self._inner = inner
        self._lost = set()

    def __getattr__(self, name):
        return getattr(self._inner, name)

    @property
    def lost(self):
        return len(self._lost)

    def request(self, shard, message, *, timeout_s, **more):
        answer = self._inner.request(shard, message, timeout_s=timeout_s, **more)
        if isinstance(message, Commit) and message.lock not in self._lost:
            self._lost.add(message.lock)
            return None
        return answer


def test_commit_whose_answer_is_lost_is_told_committed_once(joined):
    """20 commits over both accounts, each first answer lost: 20 told, 20 there, each with a place."""
    carrier = joined._client.carrier = DeafTo(joined._client.carrier)
    left, right = (Write(joined.world("online"), entity, COUNT) for entity in (LEFT, RIGHT))
    positions = set()
    for _ in range(20):
        with Lock(left, right) as lock:
            lock[left] += 1
            lock[right] += 1
        positions.add(lock.position)

    assert carrier.lost == len(positions) == 20
    assert seen(joined, LEFT, RIGHT) == [20, 20]


@pytest.mark.parametrize(("step", "stands"), [("all-prepared", False), ("decided", True)])
def test_unknown_commit_can_be_asked_about_when_its_shard_is_back(
    daemons, monkeypatch, step, stands
):
    """CommitUnknownError only after the deadline; then the outcome, from any process, for long."""
    monkeypatch.setattr(link_client, "FINISH_S", 1.0)
    daemons.daemons["s0"].tell(f"arm {step}")
    daemons.daemons["s0"].expect("armed")
    with connect(daemons.file) as mine, connect(daemons.file) as other:
        killer = threading.Thread(target=lambda: (
            daemons.daemons["s0"].expect("reached"), daemons.kill("s0")
        ))  # fmt: skip
        left, right = (Write(mine.world("online"), entity, COUNT) for entity in (LEFT, RIGHT))
        killer.start()
        started_s = time.monotonic()
        with pytest.raises(CommitUnknownError, match=r"cell\.outcome") as caught, Lock(left, right) as lock:  # fmt: skip
            lock[left], lock[right] = 3, 4
        killer.join()
        assert time.monotonic() - started_s >= 1.0
        with pytest.raises(ShardUnreachableError):
            mine.outcome(caught.value.lock_id, timeout_s=0.2)

        start_trapped(daemons, "s0")
        for _ in range(5):  # later locks of the same client leave the outcome alone
            with Lock(left, right, wait_s=60.0):
                pass
        found = [cell.outcome(caught.value.lock_id) for cell in (mine, other)]

        assert found[0] == found[1]
        assert (found[0] is not None) is stands
        if stands:
            assert found[0].shard == "s0"
            assert mine.wait(found[0])
            assert seen(other, LEFT, RIGHT) == [3, 4]
        with pytest.raises(MisuseError, match="names no lock"):
            mine.outcome("somebody")


class DiesUnheard(DeafTo):
    """A carrier whose shard is killed, and started again, before its first commit is answered."""

    def __init__(self, inner, cell):
        super().__init__(inner)
        self._cell = cell

    def request(self, shard, message, *, timeout_s, **more):
        before = self.lost
        answer = super().request(shard, message, timeout_s=timeout_s, **more)
        if self.lost > before:
            self._cell.kill()
            self._cell.start()
        return answer


@pytest.mark.parametrize("durability", [Durability.VOLATILE, Durability.OS])
def test_commit_that_a_restart_may_have_taken_is_not_told_lost(make_cell, durability):
    """A shard that lost its record of a commit answers *unknown*, now and later; else it knows."""
    daemons = make_cell(ttl_s=TTL_S).start_all()
    with connect(daemons.file) as mine, connect(daemons.file) as other:
        count = Write(mine.world("online"), LEFT, Aspect("count", int, durability))
        mine.world("online").init(LEFT, count.aspect, 0)
        mine._client.carrier = DiesUnheard(mine._client.carrier, daemons)
        if durability is Durability.OS:
            with Lock(count) as lock:
                lock[count] = 1
            assert lock.position.shard == "s0"
            assert seen(other, LEFT) == [1]
            return
        with pytest.raises(CommitUnknownError, match="lost its record") as caught, Lock(count) as lock:  # fmt: skip
            lock[count] = 1
        assert "cell.outcome" not in str(caught.value)  # nobody will ever know
        for cell in (mine, other):
            with pytest.raises(CommitUnknownError, match="no longer knows"):
                cell.outcome(caught.value.lock_id)


class LosesCommits:
    """A carrier that loses every commit on its way."""

    def __init__(self, inner):
        self._inner = inner

    def __getattr__(self, name):
        return getattr(self._inner, name)

    def request(self, shard, message, *, timeout_s, **more):
        if isinstance(message, Commit):
            return None
        return self._inner.request(shard, message, timeout_s=timeout_s, **more)


@pytest.mark.parametrize(
    ("durability", "folder"),
    [(Durability.VOLATILE, "stays"), (Durability.OS, "stays"), (Durability.OS, "goes")],
)
def test_restarted_shard_says_of_a_commit_that_it_would_have_recorded_that_it_never_came(
    make_cell, monkeypatch, durability, folder
):
    """Also of an aspect that the client registered after it had greeted the shard."""
    monkeypatch.setattr(link_client, "FINISH_S", 0.5)
    daemons = make_cell(ttl_s=TTL_S).start_all()
    with connect(daemons.file) as mine:
        count = Write(mine.world("online"), LEFT, Aspect("count", int, durability))
        mine._client.carrier = LosesCommits(mine._client.carrier)
        with pytest.raises(CommitUnknownError, match="no answer") as caught, Lock(count) as lock:
            lock[count] = 1
        daemons.kill()
        if folder == "goes":
            lines = daemons.file.read_text().splitlines()
            daemons.file.write_text("\n".join(x for x in lines if not x.startswith("data_folder")))
        daemons.start()
        with Lock(count, wait_s=30.0):  # it has greeted the shard, which knows its session
            pass
        if (durability, folder) == (Durability.OS, "stays"):
            assert mine.outcome(caught.value.lock_id) is None
        else:
            with pytest.raises(CommitUnknownError, match="no longer knows"):
                mine.outcome(caught.value.lock_id)
