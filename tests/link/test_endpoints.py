"""What is said of places by their names alone."""

import socket
import threading

import pytest
from ports import free_endpoint

from enact_dist import connect
from enact_dist.errors import ShardUnreachableError
from enact_dist.link.zenoh import endpoints
from enact_dist.link.zenoh.endpoints import somebody_listens, unknown_hosts


@pytest.fixture
def names(monkeypatch):
    """Host names that can be resolved; nobody is asked for them."""
    known = set()

    def look_up(host, *_, **__):
        if host not in known:
            raise socket.gaierror(socket.EAI_AGAIN, "no name server")
        return []

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    return known


def test_hosts_that_cannot_be_resolved_are_named_once(names):
    """In the order of the endpoints."""
    names.add("robot")

    found = unknown_hosts(["tcp/robto:7447", "tcp/robot:7447", "tls/arm:1?a=b", "tcp/robto:7448"])

    assert found == ["robto", "arm"]


def test_name_server_that_is_silent_is_not_waited_for(monkeypatch):
    """The error that it would explain is late enough; what is not known is not said."""
    monkeypatch.setattr(endpoints, "LOOK_UP_S", 0.01)
    answers = threading.Event()
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_: answers.wait(60.0))

    found = unknown_hosts(["tcp/robot:7447"])
    answers.set()

    assert found == []


def test_connect_says_that_the_name_is_wrong(names):
    """Else one looks for a shard that does not run."""
    endpoint = free_endpoint()

    with pytest.raises(ShardUnreachableError, match=r"the host name 127.0.0.1 cannot be resolved"):
        connect(endpoint, timeout_s=0.1)


def test_connect_says_nothing_of_a_name_that_is_right(names):
    """The shard is what is missing then."""
    names.add("127.0.0.1")

    with pytest.raises(ShardUnreachableError) as caught:
        connect(free_endpoint(), timeout_s=0.1)

    assert "resolved" not in str(caught.value)


def test_nobody_listens_at_a_free_port():
    """A closed port says so at once; of what is no TCP nothing is known."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        assert somebody_listens(f"tcp/127.0.0.1:{server.getsockname()[1]}")

    assert not somebody_listens(free_endpoint())
    assert somebody_listens("udp/127.0.0.1:1")
