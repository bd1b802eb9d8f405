"""The metrics that a shard serves to Prometheus: counters and gauges, in text format 0.0.4.

Each counter of `link.counters` becomes ``enact_NAME_total``, and each current value ``enact_NAME``,
with the meaning given there as help text.  All samples have the labels `cell` and `shard`.
The table in `deploy/metrics.md` is `table()`.
"""

from __future__ import annotations

from itertools import accumulate
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.core.latencies import BOUNDS_S
from enact_dist.link.counters import BODIES, OF_A_SHARD

if TYPE_CHECKING:
    from collections.abc import Iterator

    from enact_dist.core.latencies import Latencies
    from enact_dist.link.host import ShardHost

CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"


class Metric(NamedTuple):
    """One metric.

    Attributes:
        name: Its name in Prometheus.
        kind: "counter", "gauge" or "histogram".
        meaning: What it measures.
        remedy: What to do if it grows; empty if growth is normal.
        figure: Its name in the figures or latencies of a `ShardHost`.
    """

    name: str
    kind: str
    meaning: str
    remedy: str
    figure: str


_NOW: Final = {
    "ready": (
        "1 while the shard grants locks, 0 right after its start and while it shuts down",
        "",
    ),
    "epoch": ("number of this start; it changes with each restart", "the shard's log says why"),
    "uptime_seconds": ("time since this start", ""),
    "sessions": ("clients that are connected, or were until a moment ago", ""),
    "slots": ("slots on this shard, including null ones", ""),
    "slot_bytes": (
        f"bytes of the newest data of all slots: {BODIES}",
        "enact world tree shows each",
    ),
    "locks_held": ("locks held now", ""),
    "locks_waiting": ("locks waiting now", "enact lock ls shows who holds them up"),
    "requests_parked": ("requests waiting for an answer", ""),
}
_TOOK: Final = {
    "lock_wait_seconds": (
        "time from the first request of a lock to its grant here",
        "enact lock ls shows the holders; hold locks for less time, or use View",
    ),
    "store_write_seconds": (
        "time to store a batch of records, on the disk if an aspect is durable",
        "move the shard's folder to a faster disk",
    ),
}


def _metrics() -> Iterator[Metric]:
    for name, (meaning, remedy) in _NOW.items():
        yield Metric(f"enact_{name}", "gauge", meaning, remedy, name)
    for name, counter in OF_A_SHARD.items():
        kind, ending = ("gauge", "") if counter.now else ("counter", "_total")
        yield Metric(f"enact_{name}{ending}", kind, counter.meaning, counter.remedy, name)
    for name, (meaning, remedy) in _TOOK.items():
        yield Metric(f"enact_{name}", "histogram", meaning, remedy, name)


METRICS: Final = tuple(_metrics())
"""All metrics of a shard, in the order in which it serves them."""


def page(host: ShardHost, cell: str) -> str:
    """Return all metrics of a shard in the format of Prometheus, without locking the shard."""
    labels = f'cell="{_escaped(cell)}",shard="{_escaped(host.name)}"'
    figures, latencies = host.figures(), host.latencies()
    lines: list[str] = []
    for metric in METRICS:
        help_ = metric.meaning.replace("\\", r"\\").replace("\n", r"\n")
        lines += [f"# HELP {metric.name} {help_}", f"# TYPE {metric.name} {metric.kind}"]
        if metric.kind == "histogram":
            lines += _histogram(metric.name, labels, latencies[metric.figure])
        else:
            lines.append(f"{metric.name}{{{labels}}} {_number(figures.get(metric.figure, 0))}")
    return "\n".join((*lines, ""))


def _histogram(name: str, labels: str, latencies: Latencies) -> Iterator[str]:
    *totals, count = accumulate(list(latencies.counts))
    for bound_s, total in zip((*map(_number, BOUNDS_S), "+Inf"), (*totals, count), strict=True):
        yield f'{name}_bucket{{{labels},le="{bound_s}"}} {total}'
    yield f"{name}_sum{{{labels}}} {_number(latencies.sum_s)}"
    yield f"{name}_count{{{labels}}} {count}"


def _number(value: float) -> str:
    return str(int(value)) if value == int(value) else repr(float(value))


def _escaped(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")


def table() -> str:
    """Return the metrics as a Markdown table."""
    rows = (f"| `{m.name}` | {m.kind} | {m.meaning} | {m.remedy or '-'} |" for m in METRICS)
    return "\n".join(
        ("| metric | kind | meaning | what to do if it grows |", "|---|---|---|---|", *rows, "")
    )
