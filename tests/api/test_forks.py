"""Forks of world contexts, and their end: over a shard, over two, and with one of them away."""

import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import numpy as np
import pytest
from counted import COUNT, put, value_of

from enact_dist import (
    Aspect,
    Durability,
    Entities,
    Entity,
    Lock,
    Position,
    Read,
    View,
    ViewEach,
    Write,
)
from enact_dist.core.protocol.messages import DropWorld, Fork
from enact_dist.errors import (
    ForgottenError,
    LockHeldError,
    MisuseError,
    ShardUnreachableError,
    UnknownWorldError,
)
from enact_dist.link.client.session import SessionClient

pytestmark = pytest.mark.carrier("local", "drawn")

CLOUD = Aspect("cloud", np.ndarray)
LEFT, RIGHT = Entity("left/arm"), Entity("right/arm")
ARM = Entity("arm")


def test_fork_has_the_data_of_its_source_and_a_life_of_its_own(cell, online):
    """A write to either is not seen in the other."""
    put(online, ARM, 1)

    what_if = online.fork("what_if")
    put(what_if, ARM, 2)
    put(online, Entity("leg"), 3)

    assert (value_of(online, ARM), value_of(what_if, ARM)) == (1, 2)
    assert what_if.entities() == (ARM,)
    assert "what_if" in cell.worlds()
    assert cell.world("what_if").forked_from == what_if.forked_from
    assert what_if.forked_from[0] == "online"
    assert online.forked_from is None


def test_fork_of_a_fork_names_the_fork(online):
    """Whatever a fork is asked of, it is one of that."""
    put(online, ARM, 1)

    first = online.fork("first")
    put(first, ARM, 2)
    second = first.fork("second")

    assert value_of(second, ARM) == 2
    assert second.forked_from[0] == "first"


def test_large_data_of_a_fork_are_those_of_its_source(online):
    """Nothing is copied; the datum is readable in both, also when one goes."""
    cloud = np.arange(100_000, dtype=np.float64)
    put(online, ARM, cloud, CLOUD)

    what_if = online.fork("what_if")
    put(online, ARM, np.zeros(3), CLOUD)

    assert np.array_equal(value_of(what_if, ARM, CLOUD), cloud)


def test_name_that_exists_is_refused_and_the_same_fork_is_the_same(online):
    """Nothing is forked over; whoever asks for the same fork again gets it."""
    position = put(online, ARM, 1)
    what_if = online.fork("what_if", at=position)
    put(what_if, ARM, 5)

    again = online.fork("what_if", at=position)

    assert value_of(again, ARM) == 5
    with pytest.raises(
        MisuseError, match=r"there is a world context 'what_if'.*a fork of 'online'"
    ):
        online.fork("what_if")
    with pytest.raises(MisuseError, match=r"'training'.*no fork.*take another name"):
        online.fork("training")
    with pytest.raises(MisuseError, match=r"'a b' cannot name a world context"):
        online.fork("a b")


def test_fork_of_what_is_yet_to_come_is_refused(online):
    """By this host's clock, before a shard is asked."""
    with pytest.raises(MisuseError, match=r"s in the future"):
        online.fork("what_if", at=time.time() + 60.0)


def test_dropped_context_is_unknown_to_whoever_holds_a_handle(cell, online):
    """Its name is free again, and its versions go on where they were."""
    put(online, ARM, 1)
    what_if = online.fork("what_if")
    put(what_if, ARM, 2)

    assert cell.drop_world("what_if") == 1

    assert "what_if" not in cell.worlds()
    arm = Read(what_if, ARM, COUNT)
    for use in (
        lambda: what_if.view(View(what_if, ARM, COUNT)),
        lambda: Lock(arm).__enter__(),
        what_if.list_slots,
        lambda: what_if.init(ARM, COUNT, 1),
        lambda: what_if.fork("further"),
        lambda: cell.world("what_if"),
        lambda: cell.drop_world("what_if"),
    ):
        with pytest.raises(UnknownWorldError, match=r"what_if"):
            use()
    anew = cell.create_world("what_if")
    assert anew.init(ARM, COUNT, 7)
    view = View(anew, ARM, COUNT)
    assert anew.view(view).version(view) > 2
    assert value_of(online, ARM) == 1


def test_context_is_not_dropped_under_a_lock_or_out_of_the_cell_file(cell, online):
    """Nobody's data vanish while somebody holds them."""
    put(online, ARM, 1)
    what_if = online.fork("what_if")
    with Lock(Read(what_if, ARM, COUNT)):
        with pytest.raises(LockHeldError, match=r"drop_world inside a lock"):
            cell.drop_world("what_if")
        with pytest.raises(LockHeldError, match=r"fork inside a lock"):
            online.fork("other")
    with pytest.raises(MisuseError, match=r"stands in cell.toml"):
        cell.drop_world("online")

    assert value_of(what_if, ARM) == 1


# ---------------------------------------------------------------- two shards


def test_fork_over_shards_is_one_cut_with_everything_that_was_reported(two_shards):
    """Every commit that was reported before is in it, and none half."""
    online = two_shards.cell.world("online")
    both = [Write(online, LEFT, COUNT), Write(online, RIGHT, COUNT)]
    for number in range(20):
        with Lock(*both) as lock:
            for request in both:
                lock[request] = number

        fork = online.fork(f"fork_{number}")

        arms = ViewEach(fork, Entities("*/arm"), COUNT)
        assert dict(fork.view(arms)[arms]) == {LEFT: number, RIGHT: number}


def test_fork_of_what_one_shard_has_forgotten_is_taken_back(two_shards, loose):
    """The error names the oldest known moment, and the other shard has nothing of it left."""
    cell, online = two_shards.cell, two_shards.cell.world("online")
    fleeting = Aspect("fleeting", int, Durability.VOLATILE, retention=2)
    put(online, LEFT, 1)
    then = put(online, RIGHT, 1, fleeting)
    for number in (2, 3):
        put(online, RIGHT, number, fleeting)
    loose.end()
    put(online, RIGHT, 4, fleeting)

    with pytest.raises(ForgottenError, match=r"right/arm/fleeting is older than .* known from"):
        online.fork("what_if", at=then)

    assert cell.worlds() == ("online", "training")
    assert value_of(online.fork("what_if"), RIGHT, fleeting) == 4


def test_lock_of_somebody_else_keeps_a_context_on_every_shard(two_shards):
    """Refused before one shard has dropped it; the holder is named."""
    online = two_shards.cell.world("online")
    put(online, LEFT, 1)
    what_if = online.fork("what_if")
    with two_shards.connect(actor="holder") as other:
        arm = Read(other.world("what_if"), RIGHT, COUNT)
        with Lock(arm), pytest.raises(MisuseError, match=r"'what_if' is not dropped: .*holder@"):
            _in_a_thread(lambda: two_shards.cell.drop_world("what_if"))
        assert value_of(what_if, LEFT) == 1

    assert two_shards.cell.drop_world("what_if") >= 1


def _in_a_thread(call):
    """Call where no lock is held by this thread."""
    with ThreadPoolExecutor(1) as threads:
        return threads.submit(call).result()


class DeafCarrier:
    """Carries everything but requests of some kinds to shard "right", which never hears of them."""

    def __init__(self, inner, *kinds):
        self._inner, self._kinds = inner, kinds

    def __getattr__(self, name):
        return getattr(self._inner, name)

    def request(self, shard, message, *, timeout_s, **more):
        if shard == "right" and isinstance(message, self._kinds):
            return None
        return self._inner.request(shard, message, timeout_s=timeout_s, **more)

    def request_all(self, requests, *, timeout_s):
        return [self.request(shard, one, timeout_s=timeout_s) for shard, one in requests]


@pytest.fixture
def deaf(two_shards, monkeypatch):
    """Let "right" not hear of forks and drops while the block runs."""

    @contextmanager
    def block():
        client = two_shards.cell._client
        with monkeypatch.context() as patch:
            patch.setattr("enact_dist.world.forks.FINISH_S", 0.5)
            patch.setattr(client, "carrier", DeafCarrier(client.carrier, Fork, DropWorld))
            yield

    return block


def test_nothing_is_forked_or_dropped_while_a_shard_is_away(two_stored, monkeypatch):
    """Whoever is away is named before anybody begins."""
    monkeypatch.setattr("enact_dist.link.client.session.SessionClient.call_all", _in_a_second)
    cell, online = two_stored.cell, two_stored.cell.world("online")
    put(online, LEFT, 1)
    what_if = online.fork("what_if")
    two_stored.stop("right")

    for begin in (lambda: online.fork("other"), lambda: cell.drop_world("what_if")):
        with pytest.raises(ShardUnreachableError, match=r"shard right at .* did not answer"):
            begin()
    two_stored.start("right")

    assert cell.worlds() == ("online", "training", "what_if")
    assert value_of(what_if, LEFT) == 1


def _in_a_second(client, calls, *, timeout_s=1.0, _whole=SessionClient.call_all):
    return _whole(client, calls, timeout_s=min(timeout_s or 1.0, 1.0))


def test_fork_on_one_shard_alone_is_told_and_completed_later(two_shards, deaf):
    """It is no world context until every shard has it."""
    cell, online = two_shards.cell, two_shards.cell.world("online")
    put(online, LEFT, 1)
    position = put(online, RIGHT, 2)

    with deaf(), pytest.raises(ShardUnreachableError) as error:
        online.fork("what_if", at=position)

    told = str(error.value)
    assert "is made on left and not on right, so it is no world context yet" in told
    assert f"at=Position({position.stamp_ns}, 'right')" in told
    for use in (cell.world, cell.create_world):
        with pytest.raises(UnknownWorldError, match=r"a part of it is on left alone"):
            use("what_if")
    with pytest.raises(MisuseError, match=r"ask again with --at \d+@left, or at=Position"):
        online.fork("what_if")

    what_if = online.fork("what_if", at=Position(position.stamp_ns, "right"))

    assert (value_of(what_if, LEFT), value_of(what_if, RIGHT)) == (1, 2)
    assert what_if.forked_from == ("online", position.stamp_ns)


def test_fork_on_one_shard_alone_is_given_up_by_dropping_it(two_shards, deaf):
    """What one shard has of it goes; then the name is free."""
    cell, online = two_shards.cell, two_shards.cell.world("online")
    position = put(online, LEFT, 1)
    with deaf(), pytest.raises(ShardUnreachableError):
        online.fork("what_if", at=position)

    assert cell.drop_world("what_if") == 1

    assert cell.worlds() == ("online", "training")
    assert value_of(online.fork("what_if"), LEFT) == 1


def test_context_dropped_on_one_shard_alone_is_none_and_goes_with_the_next_drop(two_shards, deaf):
    """The message says where it is gone, and what to do."""
    cell, online = two_shards.cell, two_shards.cell.world("online")
    put(online, RIGHT, 1)
    online.fork("what_if")

    with deaf(), pytest.raises(ShardUnreachableError, match=r"dropped on left, but not on right"):
        cell.drop_world("what_if")

    with pytest.raises(UnknownWorldError, match=r"a part of it is on right alone"):
        cell.world("what_if")
    assert cell.drop_world("what_if") == 1
    assert cell.worlds() == ("online", "training")


def test_fork_survives_a_restart_of_a_shard(two_stored):
    """It is as durable as its data."""
    online = two_stored.cell.world("online")
    put(online, RIGHT, 2)
    what_if = online.fork("what_if")
    put(online, RIGHT, 3)

    two_stored.stop("right")
    two_stored.start("right")

    assert value_of(what_if, RIGHT) == 2
    assert two_stored.cell.world("what_if").forked_from == what_if.forked_from
