"""deploy/own: a project's own actors in an image on the one of this repository, in a cell."""

import json

import pytest
from stack import until

pytestmark = pytest.mark.containers

FILE = ("--project-name", "own", "--file", "deploy/own/compose.yaml")


@pytest.fixture
def own(engine, images):
    """The cell of deploy/own, up on images that were built here."""
    engine.compose(*FILE, "up", "--build", "--detach")
    yield engine
    engine.compose(*FILE, "down", "--volumes", "--timeout", 5)


def test_an_actor_of_ones_own_commits(own):
    """As the page on own actors calls it: built on enact-core, run, and looked at from a container."""

    def log():
        return own.compose(*FILE, "logs", check=False).stdout[-3000:]

    def counted():
        done = own.compose(
            *FILE, "exec", "-T", "shard-main",
            "enact", "world", "history", "online", "counter/count", "--json",
            check=False,
        )  # fmt: skip
        versions = json.loads(done.stdout) if done.returncode == 0 else []
        return versions if len(versions) >= 2 else None

    versions = until(counted, log)
    shown = own.compose(
        *(*FILE, "run", "--rm", "-T", "enact"),
        *("world", "watch", "online", "--data", "--count", "1"),
    )

    assert versions[-1]["cause"]["actor"] == "counter"
    assert "online:counter/count  v" in shown.stdout
    services = own.compose(*FILE, "config", "--services").stdout.split()
    assert sorted(services) == ["counter", "shard-main"]
