"""`/metrics`: what Prometheus' own reader makes of it, what it costs the shard, who is turned away."""

import errno
import http.client
import itertools
import socket
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from enact_dist.core.protocol.messages import AspectEntry, Committed, PlacementMap, ShardEntry
from enact_dist.core.shard.state import ShardSettings
from enact_dist.core.state.clock import Latencies
from enact_dist.errors import LinkError
from enact_dist.link.daemon import metrics
from enact_dist.link.daemon.metrics import (
    CONTENT_TYPE,
    METRICS,
    MetricsServer,
    MetricsSource,
    source_of,
    table,
)
from enact_dist.link.opening import open_host

DOCUMENT = Path(__file__).parents[2] / "deploy" / "metrics.md"
DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))


@pytest.fixture
def host(tmp_path):
    """A shard with a store, and the call of a client."""
    placement = PlacementMap(1, (ShardEntry("s0", ("tcp/h:1",)),), ())
    aspects = (AspectEntry("count", "", "durable"),)
    settings = ShardSettings("s0", placement, worlds=("online",), aspects=aspects)
    opened = open_host(settings, tmp_path / "s0")
    yield opened
    opened.close()


@pytest.fixture
def peer(host, make_peer):
    """A client of the shard."""

    def call(_, message):
        answers, come = [], threading.Event()
        host.submit(message, lambda answer: (answers.append(answer), come.set()))
        return answers[0] if come.wait(60) else None

    peer = make_peer(call)
    peer.hello()
    return peer


@pytest.fixture
def served(host):
    """Ask a real server for the metrics: `served()` returns its text."""
    server = MetricsServer(("127.0.0.1", 0), source_of(host, 'cell "a"'))

    def ask(path="/metrics"):
        with DIRECT.open(f"http://127.0.0.1:{server.port}{path}", timeout=30) as answer:
            assert answer.headers["Content-Type"] == CONTENT_TYPE
            return answer.read().decode()

    ask.server = server
    yield ask
    server.close()


def samples(text):
    """Return the value of each sample by name, as Prometheus reads them."""
    return {
        sample.name + sample.labels.get("le", ""): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_every_metric_is_served_with_its_kind_and_meaning_and_no_other(served):
    """Prometheus' own reader finds what the table says, with cell and shard on each sample."""
    families = list(text_string_to_metric_families(served()))
    found = {
        (f.name + ("_total" if f.type == "counter" else ""), f.type, f.documentation)
        for f in families
    }

    assert found == {(metric.name, metric.kind, metric.meaning) for metric in METRICS}
    assert all(s.labels["cell"] == 'cell "a"' for f in families for s in f.samples)
    assert all(s.labels["shard"] == "s0" for f in families for s in f.samples)


def test_document_has_each_metric_that_a_shard_serves():
    """Whoever adds a counter adds its line: python -c 'from … import table; print(table())'."""
    rows = [line for line in DOCUMENT.read_text("utf-8").splitlines() if line.startswith("|")]

    assert rows == table().splitlines()


def test_metrics_follow_what_the_shard_does(served, peer):
    """A lock that is held, one that waits, a durable commit and its time on the disk."""
    before = samples(served())
    granted = peer.acquire("cup")
    during = samples(served())
    assert isinstance(peer.commit(granted, "cup", b"12345"), Committed)
    after = samples(served())

    assert (before["enact_ready"], before["enact_sessions"]) == (1, 1)
    assert (before["enact_locks_held"], during["enact_locks_held"]) == (0, 1)
    assert after["enact_locks_held"] == 0
    assert after["enact_commits_total"] == before["enact_commits_total"] + 1
    assert after["enact_locks_granted_total"] == 1
    assert after["enact_lock_wait_seconds_count"] == 1
    assert after["enact_lock_wait_seconds_bucket0.001"] == 1
    assert after["enact_slots"] == 1
    assert after["enact_slot_bytes"] == 5
    written = after["enact_store_write_seconds_count"]
    assert written > before["enact_store_write_seconds_count"]
    assert after["enact_store_write_seconds_bucket+Inf"] == written
    assert after["enact_store_write_seconds_sum"] > 0


def test_draining_shard_is_not_ready(served, host):
    """It is served until the end, so that somebody can see why nothing is granted."""
    host.drain()
    found = samples(served())

    assert (found["enact_ready"], found["enact_draining"]) == (0, 1)


def test_scrape_needs_no_lock_of_the_shard(served, host):
    """Who asks waits for nobody, and nobody for him: the dispatcher may be deep in its work."""
    with host._mutex:
        assert "enact_ready" in served()


def test_durations_are_counted_in_their_classes():
    """A bound belongs to its class, as Prometheus has it; what is longer than all is counted."""
    latencies = Latencies()
    for took_s in (0.0005, 0.001, 0.0011, 60.0):
        latencies.add(took_s)

    assert latencies.counts == [2, 1, *[0] * 10, 1]
    assert latencies.sum_s == pytest.approx(60.0026)


def test_other_paths_are_not_found(served):
    """The text says what there is."""
    with pytest.raises(urllib.error.HTTPError, match=r"404: this server has only /metrics"):
        served("/")


def test_readers_that_do_not_read_leave_the_shard_alone(served, host, monkeypatch):
    """They hold a few threads; one more is turned away, and when they go others are served."""
    address = ("127.0.0.1", served.server.port)
    idle = [socket.create_connection(address) for _ in range(metrics.READERS_MAX)]
    with pytest.raises(
        (http.client.RemoteDisconnected, ConnectionResetError, urllib.error.URLError)
    ):
        while True:  # until all of them have their threads
            served()
    for connection in idle:
        connection.close()
    host.count("stalls")
    while True:
        try:
            text = served()
        except (OSError, http.client.HTTPException):
            continue  # until the first of them is gone
        break

    assert samples(text)["enact_stalls_total"] == 1
    assert samples(text)["enact_metrics_readers_refused_total"] >= 1


def test_reader_that_cannot_be_taken_is_looked_for_after_a_pause(served, monkeypatch, caplog):
    """While no descriptor is free its connection stays at the door, and the server does not spin."""
    tries = []
    accept = metrics.TCPServer.get_request

    def refused(server):
        tries.append(time.monotonic())
        if len(tries) < 4:
            raise OSError(errno.EMFILE, "Too many open files")
        return accept(server)

    monkeypatch.setattr(metrics.TCPServer, "get_request", refused)
    text = served()

    pauses = [later - earlier for earlier, later in itertools.pairwise(tries)]
    assert min(pauses) >= 0.04
    assert samples(text)["enact_metrics_readers_refused_total"] == 3
    assert caplog.text.count("Too many open files") == 1


def test_address_in_use_is_named():
    """A shard that cannot serve what it was told to does not start without it."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(LinkError, match=rf"127.0.0.1:{port}: Address already in use; name"):
            MetricsServer(("127.0.0.1", port), MetricsSource(str, bool, bool, print))


def probe(server, path):
    """Return the status and the text of a probe."""
    try:
        with DIRECT.open(f"http://127.0.0.1:{server.port}{path}", timeout=30) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def test_a_shard_that_grants_locks_is_alive_and_ready(served, host):
    """Both probes answer; while it drains, it is alive alone."""
    assert probe(served.server, "/alive") == (200, "yes\n")
    assert probe(served.server, "/ready?x=1") == (200, "yes\n")
    host.drain()
    assert probe(served.server, "/ready") == (503, "no\n")
    assert probe(served.server, "/alive") == (200, "yes\n")
    assert probe(served.server, "/live")[0] == 404


def test_a_dispatcher_that_hangs_is_not_alive(host, monkeypatch):
    """A pulse counts for a while only, and each tick of the shard is a beat."""
    ticks = []
    monkeypatch.setattr(host, "each_tick", ticks.append)
    monkeypatch.setattr(metrics.time, "monotonic", lambda: now_s)
    now_s = 100.0
    source = metrics.source_of(host, "cell")
    now_s += metrics.ALIVE_S - 0.1
    assert source.alive()
    now_s += 0.2
    assert not source.alive()
    ticks[0]()
    assert source.alive()


def test_readers_for_whom_there_was_no_thread_take_no_place(served, monkeypatch):
    """When the system has threads again, the metrics are there again."""

    def refused(*_):
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(metrics.ThreadingMixIn, "process_request", refused)
        for _ in range(metrics.READERS_MAX):
            with pytest.raises(OSError, match=r"closed|reset"):
                served()

    assert "enact_ready" in served()
