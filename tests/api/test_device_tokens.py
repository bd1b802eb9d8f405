"""Tokens as outside devices compare them: they grow when a shard gets a folder, or loses it."""

import itertools
import time

from enact_dist import Aspect, Entity, Lock, Write, local
from enact_dist.core.protocol.datum import Token
from enact_dist.core.state.clock import device_token, unkept_epoch
from enact_dist.link import opening
from enact_dist.link.clock import SystemClock

PLAN = Aspect("plan", int)


def token_of(*place):
    """Start a shard, with a folder or without; return the token of its first and second lock."""
    with local(*place, worlds=["online"]) as cell:
        write, found = Write(cell.world("online"), Entity("arm"), PLAN), []
        for number in range(2):
            with Lock(write) as lock:
                lock[write] = number
                ((_, *token),) = lock.token
                found.append(token)
    return found


def test_token_grows_when_a_shard_gets_a_folder_and_when_it_loses_it(tmp_path, monkeypatch):
    """A device that has seen the newest pair refuses whoever still has one of before."""
    ahead_s = itertools.count()

    class Later(SystemClock):
        """The clock of a start that is a second after the one before, as starts of a daemon are."""

        def __init__(self):
            self._ahead_ns = next(ahead_s) * 1_000_000_000

        def wall_ns(self):
            return time.time_ns() + self._ahead_ns

    monkeypatch.setattr(opening, "SystemClock", Later)
    tokens = [*token_of(), *token_of(), *token_of(tmp_path), *token_of(tmp_path), *token_of()]

    assert tokens == sorted(tokens)
    assert next(ahead_s) == 5, "each start had its own second"


def test_pairs_of_both_kinds_are_ordered_by_the_second_of_the_start():
    """Without a folder by the millisecond, and then by the number."""
    start_ns = 1_700_000_000_250_000_000
    unkept = unkept_epoch(start_ns)
    pairs = [
        device_token(Token(1_699_999_999, 5)),
        device_token(Token(unkept, 1)),
        device_token(Token(unkept, 2)),
        device_token(Token(unkept + 1, 1)),
        device_token(Token(1_700_000_001, 1)),
    ]

    assert pairs == sorted(set(pairs))
