"""Fixtures of the core's tests: a shard without a host, clients without a network."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from shard_bench import ShardBench


@pytest.fixture
def bench(request) -> ShardBench:
    """A shard with one aspect of each durability, on a disk that is done at once.

    A module says by SESSIONS which sessions are open from the start, and by BENCH of which kind it
    is.
    """
    made = getattr(request.module, "BENCH", ShardBench)()
    made.hello(*getattr(request.module, "SESSIONS", ()))
    return made
