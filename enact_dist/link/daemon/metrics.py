"""The metrics that a shard serves to Prometheus: counters and gauges, in text format 0.0.4.

Each counter of `link.daemon.counters` becomes ``enact_NAME_total``, and each other figure
``enact_NAME``, with the meaning given there as help text.  All samples have the labels `cell` and
`shard`.  The table in `deploy/metrics.md` is `table()`.

Beside the page there are two probes for a supervisor such as Kubernetes, which cost no process.
``GET /alive`` and ``GET /ready`` answer with 200 or 503.

The page is served over HTTP from threads that never block the shard.  A slow reader occupies one of
`READERS_MAX` threads, for at most `READ_S` per step; further readers are refused.  While the
process has no free descriptor, new connections stay in the queue and are tried again after a pause.
"""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from itertools import accumulate
from socketserver import TCPServer, ThreadingMixIn
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

from enact_dist.core.state.clock import BOUNDS_S, Latencies
from enact_dist.errors import LinkError
from enact_dist.link.daemon.counters import GAUGES_OF_A_SHARD, LATENCIES_OF_A_SHARD, OF_A_SHARD

if TYPE_CHECKING:
    from enact_dist.link.daemon.settings import DaemonSettings
    from enact_dist.link.host import ShardHost

READERS_MAX: Final = 8
READ_S: Final = 5.0
PATH: Final = "/metrics"
ALIVE_S: Final = 20.0
"""How long a dispatcher may stand still, as in the unit of systemd."""
SEES_S: Final = 5.0
"""How long a daemon that stands by sees its database after a look at it."""
POLL_S: Final = 0.1
"""How long `close` may wait for the thread that accepts."""
PAUSE_S_MIN: Final = 0.05
PAUSE_S_MAX: Final = 1.0
"""Pause after a connection that could not be accepted; doubles up to the second figure."""

_log = logging.getLogger("enact.link")


class Pulse:
    """Whether something has happened in the last `for_s`.  Thread-safe."""

    def __init__(self, for_s: float) -> None:
        self._for_s = for_s
        self._until_s = 0.0

    def beat(self) -> None:
        """Note that it happens now."""
        self._until_s = time.monotonic() + self._for_s

    def __call__(self) -> bool:
        """Return whether the last beat still counts."""
        return time.monotonic() < self._until_s


@dataclass(frozen=True, slots=True)
class MetricsSource:
    """What a server of metrics shows; called from its threads.

    Attributes:
        alive: Whether the process does its work.
        ready: Whether the shard serves, or stands by and sees its database.
        count: Called with "metrics_readers_refused" for each refused reader.
    """

    page: Callable[[], str]
    alive: Callable[[], bool]
    ready: Callable[[], bool]
    count: Callable[[str], None]


class MetricsServer:
    """Answers ``GET /metrics``, ``/alive`` and ``/ready`` until it is closed.

    Args:
        address: Host and port; port 0 takes any that is free.
        source: What it shows, until `show`.

    Attributes:
        port: The port on which it listens.

    Raises:
        LinkError: The address is in use, or not an address of this host.
    """

    def __init__(self, address: tuple[str, int], source: MetricsSource) -> None:
        host, port = address
        try:
            self._server = _Server(address, source)
        except OSError as error:
            raise LinkError(
                f"metrics cannot be served at {host}:{port}: {error.strerror or error}; name"
                " another address with --metrics"
            ) from error
        self.port: int = self._server.server_address[1]
        self._thread = threading.Thread(
            target=lambda: self._server.serve_forever(POLL_S), name="enact-metrics", daemon=True
        )
        self._thread.start()

    def show(self, source: MetricsSource) -> None:
        """Show something else from now on."""
        self._server.source = source

    def close(self) -> None:
        """Stop listening; idempotent."""
        self._server.ending.set()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Server(ThreadingMixIn, TCPServer):
    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], source: MetricsSource) -> None:
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        self.source = source
        self.ending = threading.Event()
        self._pause_s = 0.0
        self._room = threading.BoundedSemaphore(READERS_MAX)
        super().__init__(address, _Handler)

    def get_request(self) -> tuple[Any, Any]:
        """Accept the waiting connection; if the system refuses, the caller retries at once."""
        try:
            taken = super().get_request()
        except OSError as error:
            if not self._pause_s:
                _log.warning("cannot accept a reader of the metrics now: %s", error)
            self.source.count("metrics_readers_refused")
            self._pause_s = min(max(2 * self._pause_s, PAUSE_S_MIN), PAUSE_S_MAX)
            self.ending.wait(self._pause_s)
            raise
        self._pause_s = 0.0
        return taken

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._room.acquire(blocking=False):
            self.source.count("metrics_readers_refused")
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except BaseException:  # the system has no more threads
            self._room.release()
            self.source.count("metrics_readers_refused")
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._room.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        _log.info(
            "a reader of the metrics at %s disconnected before it had the answer", client_address
        )


class _Handler(BaseHTTPRequestHandler):
    timeout = READ_S
    server_version, sys_version = "enact", ""

    def do_GET(self) -> None:
        source = cast("_Server", self.server).source
        path = self.path.partition("?")[0]
        probe = {"/alive": source.alive, "/ready": source.ready}.get(path)
        if probe is None and path != PATH:
            self.send_error(HTTPStatus.NOT_FOUND, f"this server has only {PATH}, /alive and /ready")
            return
        passed = probe is None or probe()
        text = source.page() if probe is None else f"{'yes' if passed else 'no'}\n"
        body = text.encode()
        self.send_response(HTTPStatus.OK if passed else HTTPStatus.SERVICE_UNAVAILABLE)
        self.send_header("Content-Type", CONTENT_TYPE)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *arguments: object) -> None:  # noqa: A002 - its base's word
        """Log nothing: requests come every few seconds."""


CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"


class Metric(NamedTuple):
    """One metric: its name in Prometheus and in the figures of a `ShardHost`; see `Figure`."""

    name: str
    figure: str
    meaning: str
    remedy: str
    kind: str


METRICS: Final = tuple(
    Metric(f"enact_{name}{'_total' * (counter.kind == 'counter')}", name, *counter)
    for table in (GAUGES_OF_A_SHARD, OF_A_SHARD, LATENCIES_OF_A_SHARD)
    for name, counter in table.items()
)
"""All metrics of a shard, in the order in which it serves them."""


def source_of(host: ShardHost, cell: str) -> MetricsSource:
    """Return what a running shard shows."""
    alive = Pulse(ALIVE_S)
    alive.beat()
    host.each_tick(alive.beat)

    def ready() -> bool:
        """Whether it grants locks, and its answers go out."""
        return bool(host.figures()["ready"]) and (host.silence is None or host.silence.holds)

    return MetricsSource(lambda: page(host, cell), alive, ready, host.count)


class StandbyProbes:
    """What a daemon shows while it stands by, and while it reads a shard that it has taken over."""

    def __init__(self, settings: DaemonSettings, figures: Callable[[], dict[str, int]]) -> None:
        self._alive, self._sees = Pulse(ALIVE_S), Pulse(SEES_S)
        self._alive.beat()
        self._takes = False
        self._labels = _labels(settings.cell, settings.shard.name)
        self._figures = figures

    def source(self) -> MetricsSource:
        """Return it for a server."""
        return MetricsSource(
            page=lambda: _listed({"standby": 1, **self._figures()}, self._labels, {}),
            alive=lambda: self._takes or self._alive(),
            ready=lambda: not self._takes and self._sees(),
            count=lambda _: None,
        )

    def looked(self, answered: bool) -> None:
        """Note a look at the shard's row, and whether the database answered."""
        self._takes = False
        self._alive.beat()
        if answered:
            self._sees.beat()

    def takes(self) -> None:
        """Note that the shard is taken over now, which takes as long as it takes to read it."""
        self._takes = True


def page(host: ShardHost, cell: str) -> str:
    """Return all metrics of a shard in the format of Prometheus, without locking the shard."""
    figures = dict.fromkeys(GAUGES_OF_A_SHARD | OF_A_SHARD, 0.0) | host.figures()
    return _listed(figures, _labels(cell, host.name), host.latencies())


def _listed(figures: Mapping[str, float], labels: str, latencies: Mapping[str, Latencies]) -> str:
    lines: list[str] = []
    for metric in METRICS:
        if metric.figure not in (latencies if metric.kind == "histogram" else figures):
            continue
        help_ = metric.meaning.replace("\\", r"\\").replace("\n", r"\n")
        lines += [f"# HELP {metric.name} {help_}", f"# TYPE {metric.name} {metric.kind}"]
        if metric.kind == "histogram":
            lines += _histogram(metric.name, labels, latencies[metric.figure])
        else:
            lines.append(f"{metric.name}{{{labels}}} {_number(figures[metric.figure])}")
    return "\n".join((*lines, ""))


def _histogram(name: str, labels: str, latencies: Latencies) -> Iterator[str]:
    *totals, count = accumulate(list(latencies.counts))
    for bound_s, total in zip((*map(_number, BOUNDS_S), "+Inf"), (*totals, count), strict=True):
        yield f'{name}_bucket{{{labels},le="{bound_s}"}} {total}'
    yield f"{name}_sum{{{labels}}} {_number(latencies.sum_s)}"
    yield f"{name}_count{{{labels}}} {count}"


def _number(value: float) -> str:
    return str(int(value)) if value == int(value) else repr(float(value))


def _labels(cell: str, shard: str) -> str:
    return f'cell="{_escaped(cell)}",shard="{_escaped(shard)}"'


def _escaped(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")


def table() -> str:
    """Return the metrics as a Markdown table."""
    rows = (f"| `{m.name}` | {m.kind} | {m.meaning} | {m.remedy or '-'} |" for m in METRICS)
    return "\n".join(
        ("| metric | kind | meaning | what to do if it grows |", "|---|---|---|---|", *rows, "")
    )
