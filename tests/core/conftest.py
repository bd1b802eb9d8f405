"""Fixtures of the core's tests: a shard without a host, clients without a network."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from shard_bench import ShardBench


@pytest.fixture
def bench() -> ShardBench:
    """A shard with one aspect of each durability, on a disk that is done at once."""
    return ShardBench()
