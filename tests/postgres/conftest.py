"""A PostgreSQL server for the tests here, and a pair of which one copies the other."""

import itertools
import os
import shutil
import sys
import threading
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "link"))
sys.path.insert(0, str(Path(__file__).parent))

import postgres_nodes

_numbers = itertools.count()


def pytest_collection_modifyitems(items):
    """Skip all of this folder, with the reason, where something is missing."""
    missing = postgres_nodes.why_missing()
    for item in items:
        if missing and Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.skip(reason=missing))


@pytest.fixture(scope="session")
def server():
    """A server without a standby."""
    folder = postgres_nodes.make_folder()
    node = postgres_nodes.Node(folder, "alone")
    try:
        node.init()
        node.start()
        yield node
    finally:
        node.close()
        shutil.rmtree(folder)


@pytest.fixture(scope="module")
def pair():
    """A server and its synchronous standby."""
    with postgres_nodes.two_nodes() as nodes:
        yield nodes


@pytest.fixture
def stores():
    """Opens shards in a database, and closes them after the test."""
    from shard_stores import Stores

    with Stores() as stores:
        yield stores


@pytest.fixture
def shard_name():
    """A shard that no other test has."""
    return f"s{os.getpid()}-{next(_numbers)}"


@pytest.fixture
def stopped():
    """What ends waiting threads of a test."""
    event = threading.Event()
    yield event
    event.set()
