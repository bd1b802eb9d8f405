"""Which host a store connects to, and what each class of durability asks of the database."""

import postgres_nodes
import psycopg
import pytest
from ports import free_port
from shard_stores import address_of, state

from enact_dist.config.types import without_password
from enact_dist.link.postgres.connection import LOST, Connector
from enact_dist.terms import Durability


@pytest.mark.parametrize(
    ("durability", "asked"), [(Durability.DURABLE, "on"), (Durability.OS, "remote_write")]
)
def test_a_commit_is_confirmed_as_its_aspect_asks(server, stores, durability, asked):
    """Never less than what the other host's system has got: that would be lost with a failover."""
    store, _, medium = stores.open(address_of(server.url))
    store.write([state(1, durability=durability)])
    found = medium.line._session.connection.execute("SHOW synchronous_commit").fetchone()
    assert found == (asked,)


def test_the_host_that_answered_last_is_asked_first(server):
    """A dead host costs its time once, not at each reconnection."""
    dead = free_port()
    url = f"postgresql://postgres@127.0.0.1:{dead},127.0.0.1:{server.port}/postgres"
    connector = Connector(url, "test")
    assert [port for _, port in connector._places] == [str(dead), str(server.port)]
    session = connector.connect()
    session.close()
    assert connector._places == (("127.0.0.1", str(server.port)), ("127.0.0.1", str(dead)))


def test_nothing_of_ours_cancels_a_wait_for_the_standby(server):
    """Whatever the role or the address says: a cancelled wait would be taken for a success."""
    url = server.url + "?options=-c%20statement_timeout%3D1000%20-c%20work_mem%3D8MB"
    session = Connector(url, "test").connect()
    try:
        shown = {
            name: session.row(f"SHOW {name}")[0]
            for name in ("statement_timeout", "work_mem", "client_min_messages")
        }
    finally:
        session.close()
    assert shown == {
        "statement_timeout": "0",
        "work_mem": "8MB",
        "client_min_messages": "warning",
    }


def test_the_end_of_an_idle_connection_is_no_warning(server):
    """The server's last words come as a notice; the connection is lost, and a new one helps."""
    session = Connector(server.url, "test").connect()
    line = session.connection.pgconn
    server.execute("SELECT pg_terminate_backend(%s)", (line.backend_pid,))
    words = []
    session.connection.add_notice_handler(lambda notice: words.append(notice.sqlstate))
    with pytest.raises(psycopg.OperationalError):
        while True:
            line.consume_input()
            line.is_busy()
    assert words == ["57P01"]
    session.check()
    with pytest.raises(LOST):
        session.row("SELECT 1")


def test_two_names_of_one_server_are_one_host(server):
    """A wait for the standby is not broken off for the other name."""
    port = server.port
    url = f"postgresql://{postgres_nodes.USER}@127.0.0.1:{port},localhost:{port}/postgres"
    connector = Connector(url, "a test")
    session = connector.connect()
    try:
        assert connector.primary_beside(session) == ""
    finally:
        session.close()


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("postgresql://enact:ge/heim@db1,db2/cell", "postgresql://enact@db1,db2/cell"),
        ("postgresql://enact:p@ss@db1/cell", "postgresql://enact@db1/cell"),
        ("postgresql://db1/cell?sslpassword=x&a=b", "postgresql://db1/cell?sslpassword=…&a=b"),
        ("postgresql://enact@db1/cell?password=x", "postgresql://enact@db1/cell?password=…"),
        ("postgresql://db1/cell", "postgresql://db1/cell"),
    ],
)
def test_no_password_is_shown(url, shown):
    """Before the host or among the parameters, whatever signs it contains."""
    assert without_password(url) == shown
