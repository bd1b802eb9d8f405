"""An answer that never arrives is asked about, never guessed."""

import random
import threading

import pytest

from enact_dist import Aspect, Entity, Lock, View, Write
from enact_dist.core.protocol.messages import (
    Acquire,
    Commit,
    Fenced,
    Fetch,
    Outcome,
    Release,
    Validate,
)
from enact_dist.errors import CommitUnknownError
from enact_dist.link.client import locks as link_client
from enact_dist.link.client.lanes import KEPT_MAX, Lanes

pytestmark = pytest.mark.carrier("local", "drawn")

COUNT = Aspect("count", int)
counter = Entity("counter")


class LosingCarrier:
    """Carries every request, and loses answers of some kinds on their way back."""

    def __init__(self, inner, *, kinds, seed, chance):
        self._inner = inner
        self._kinds = kinds
        self._draw = random.Random(seed)
        self._chance = chance
        self.lost = 0

    def __getattr__(self, name):
        return getattr(self._inner, name)

    def _maybe(self, request, answer):
        if isinstance(request, self._kinds) and self._draw.random() < self._chance:
            self.lost += 1
            return None
        return answer

    def request(self, shard, message, *, timeout_s, **more):
        return self._maybe(
            message, self._inner.request(shard, message, timeout_s=timeout_s, **more)
        )

    def begin(self, shard, message, *, timeout_s):
        return LosingBegun(self, message, self._inner.begin(shard, message, timeout_s=timeout_s))

    def request_all(self, requests, *, timeout_s):
        answers = self._inner.request_all(requests, timeout_s=timeout_s)
        return [self._maybe(q, a) for (_, q), a in zip(requests, answers, strict=True)]


class LosingBegun:
    """A call that was begun, and whose answer may get lost."""

    def __init__(self, carrier, message, begun):
        self._carrier, self._message, self._begun = carrier, message, begun
        self.abandon = begun.abandon

    def wait(self, into=None):
        return self._carrier._maybe(self._message, self._begun.wait(into))


def lose(cell, *kinds, chance=0.3, seed=1):
    cell._client.carrier = LosingCarrier(
        cell._client.carrier, kinds=kinds, seed=seed, chance=chance
    )
    return cell._client.carrier


@pytest.mark.parametrize("seed", range(3))
def test_increments_are_exact_when_answers_are_lost(cell, online, seed):
    """With 3 of 10 answers of every kind lost, 4 threads x 25 increments are 100."""
    carrier = lose(cell, Acquire, Commit, Outcome, Validate, Release, Fetch, seed=seed)
    count = Write(online, counter, COUNT)

    def increment():
        for _ in range(25):
            with Lock(count, wait_s=60.0) as lock:
                lock[count] = lock.get(count, 0) + 1

    threads = [threading.Thread(target=increment) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    view = View(online, counter, COUNT)
    assert online.view(view)[view] == 100
    assert carrier.lost > 30


def test_commit_raises_unknown_when_no_answer_ever_comes(cell, online, monkeypatch):
    """CommitUnknownError comes only after the deadline, and names the lock."""
    monkeypatch.setattr(link_client, "FINISH_S", 0.3)
    count = Write(online, counter, COUNT)
    with (
        pytest.raises(CommitUnknownError, match="took effect is unknown") as caught,
        Lock(count) as lock,
    ):
        lock[count] = 1
        deaf = lose(cell, Commit, Outcome, chance=1.1)
    cell._client.carrier = deaf._inner
    for _ in range(KEPT_MAX + 1):
        with Lock(count) as lock:
            lock[count] += 1

    assert cell.outcome(caught.value.lock_id) is not None
    assert cell.outcome(caught.value.lock_id) == cell.outcome(caught.value.lock_id)


def test_commit_that_never_came_through_is_known_not_to_stand(cell, online, monkeypatch):
    """Asked for, the outcome is *nothing written*, and a late copy of the commit finds no lock."""
    monkeypatch.setattr(link_client, "FINISH_S", 0.3)
    count = Write(online, counter, COUNT)
    kept = []

    class Swallowing(LosingCarrier):
        def request(self, shard, message, *, timeout_s, **more):
            if isinstance(message, Commit | Outcome):
                kept.append(message)
                return None
            return super().request(shard, message, timeout_s=timeout_s, **more)

    inner = cell._client.carrier
    with pytest.raises(CommitUnknownError) as caught, Lock(count) as lock:
        lock[count] = 1
        cell._client.carrier = Swallowing(inner, kinds=(), seed=1, chance=0.0)
    cell._client.carrier = inner

    assert cell.outcome(caught.value.lock_id) is None
    assert isinstance(inner.request("local", kept[0], timeout_s=5), Fenced)
    view = View(online, counter, COUNT)
    assert online.view(view).get(view) is None


def test_lanes_of_unanswered_commits_are_used_again_when_there_are_too_many():
    """Outcomes are kept for 64 of them; a session has no more than 1,024 lanes."""
    lanes = Lanes()
    for _ in range(KEPT_MAX + 10):
        lanes.keep(lanes.take())

    assert lanes.take() in range(10)
