"""What a shard tells Prometheus: its counters and what there is now, in text format 0.0.4.

Each counter of `link.counters` is ``enact_NAME_total``, each of its figures of the moment
``enact_NAME``; their meanings there are the help here.  All samples bear `cell` and `shard`.
`deploy/metrics.md` is `table()`.
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
        name: As Prometheus knows it.
        kind: "counter", "gauge" or "histogram".
        meaning: What it is.
        remedy: What to do where it grows; empty where that is as it should be.
        figure: Its name among the figures, or latencies, of a `ShardHost`.
    """

    name: str
    kind: str
    meaning: str
    remedy: str
    figure: str


_NOW: Final = {
    "ready": ("1 while locks are granted, 0 after a start and before an end", ""),
    "epoch": ("number of this start; a change is a restart", "see the shard's log for why"),
    "uptime_seconds": ("time since this start", ""),
    "sessions": ("clients that are connected, or have been a moment ago", ""),
    "slots": ("slots that lie here, null ones too", ""),
    "slot_bytes": (f"bytes of their newest data: {BODIES}", "enact world tree shows which"),
    "locks_held": ("locks that are held", ""),
    "locks_waiting": ("locks that wait", "enact lock ls shows for whom"),
    "requests_parked": ("requests that wait for their answers", ""),
}
_TOOK: Final = {
    "lock_wait_seconds": (
        "how long locks that were granted had waited here since they were first asked for",
        "enact lock ls shows who holds; hold locks shorter, or View",
    ),
    "store_write_seconds": (
        "how long batches of records took to be kept, on the disk where an aspect asks for it",
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
"""All metrics of a shard, in the order in which they are served."""


def page(host: ShardHost, cell: str) -> str:
    """Return all metrics of a shard as Prometheus reads them; takes no lock of the shard."""
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
    """Return the metrics as a table of a Markdown file."""
    rows = (f"| `{m.name}` | {m.kind} | {m.meaning} | {m.remedy or '-'} |" for m in METRICS)
    return "\n".join(
        ("| metric | kind | meaning | what to do where it grows |", "|---|---|---|---|", *rows, "")
    )
