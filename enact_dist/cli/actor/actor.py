"""`enact actor ls|check`."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

from enact_dist.cli.target import cell_config, see_modules
from enact_dist.cli.verbs import DONE, FAILED, Output
from enact_dist.config.rights import RIGHTS_FILE
from enact_dist.errors import ConfigError, EnactError, ProtocolError
from enact_dist.world.trees import shown_s

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterator

    from enact_dist.actor.report import ActorStatistics
    from enact_dist.config.types import CellConfig
    from enact_dist.world.cell import Cell
    from enact_dist.world.listings import ActorInfo

LOOK_S: Final = 2.0
"""How long a shard may take to say how often the actors run."""


def list_actors(cell: Cell, _options: argparse.Namespace) -> Output:
    """List every session but this one; one line per reporting actor."""
    infos = [info for info in cell.actors() if info.session != cell.session]

    def details() -> None:
        for report in (report for info in infos for report in _reports(info)):
            if report.args:
                print(f"{report.name}: {', '.join(report.args)}")
            for line in _losses(report):
                print(f"{report.name}: {line}")

    return Output(infos, details, rows=[row for info in infos for row in _rows(info)])


def _losses(report: ActorStatistics) -> Iterator[str]:
    """Yield the losses of an actor that the table does not show."""
    last = f", the newest a {report.last_incomplete}" if report.last_incomplete else ""
    never = f", the newest {report.last_interrupted}: how far they came is unknown"
    remedy = ": this actor waits for data with equal stamps; set them with lock.put(…, stamp_ns=…)"
    lost = (
        (report.incomplete, f"incomplete sets{last}"),
        (report.late, "data too late for their set"),
        (report.partial, f"sets ran without some data, the newest a {report.last_partial}"),
        (report.unstamped, f"data without a capture stamp, from {report.unstamped_from}{remedy}"),
        (report.missed, "ticks missed"),
        (
            report.interrupted,
            f"versions taken, never ended{never}; write them again to run them",
        ),
        (report.unknown, "commits without an answer, which may stand (see its log)"),
    )
    yield from (f"{count} {what}" for count, what in lost if count)


def _reports(info: ActorInfo) -> tuple[ActorStatistics, ...]:
    from enact_dist.actor.report import read_reports

    try:
        return read_reports(info.report)
    except ProtocolError:
        return ()  # a session that reports something of its own


def _rows(info: ActorInfo) -> Iterator[tuple[object, ...]]:
    here = (info.host, info.pid)
    left_s = info.lease_left_s
    left = (f"over for {shown_s(-left_s)}" if info.silent else shown_s(left_s), info.locks)
    reports = _reports(info)
    for report in reports:
        ago_s = time.time() - report.last_update_unix_s
        last = f"{shown_s(max(0.0, ago_s))} ago" if report.last_update_unix_s else "never"
        yield (
            report.name, *here, _state(info, _doing(report)), report.updates,
            "-" if info.silent else f"{report.rate_hz:.1f}/s",
            report.failures, report.refused, report.incomplete,
            f"{report.lock_wait_p99_ms:.1f} ms", last, *left, report.last_error or "-",
        )  # fmt: skip
    if not reports:
        yield (info.actor, *here, _state(info, "connected"), *["-"] * 7, *left, "-")


def _doing(report: ActorStatistics) -> str:
    """Return an actor's state; if its update does not return, with the time it has taken."""
    if report.state != "stuck":
        return report.state
    return f"stuck for {shown_s(report.updating_s)} in update (lock lost)"


def _state(info: ActorInfo, reported: str) -> str:
    """Return the state of an actor; a silent one may or may not still run."""
    state = "silent" if info.silent else reported
    return f"{state}, one of {len(info.namesakes) + 1}" if info.namesakes else state


def check_actors(options: argparse.Namespace) -> Output:
    """Print what is wrong with the actors of a `cell.toml`; status 1 if there is an error."""
    from enact_dist.actor.check import check_cell

    config = cell_config(options)
    if options.learn is not None:
        from enact_dist.cli.actor.learn import learn

        return learn(config, options)
    see_modules(config.path)
    if options.rights:
        _write_rights(config)
    findings = check_cell(config, initial=options.initial)
    wrong = any(finding.level == "error" for finding in findings)
    lines = [str(finding) for finding in findings]
    if all(finding.level == "advice" for finding in findings):
        lines.append(f"ok: {len(config.actors)} actors of cell {config.name} fit together")
    if options.graph is not None:
        _draw(config, options.graph)
    return Output(findings, "\n".join(lines), status=FAILED if wrong else DONE)


def _write_rights(config: CellConfig) -> None:
    """Write what the actors may do by their declarations, for the shards.

    Raises:
        ConfigError: An actor cannot be loaded, so that its declaration is unknown.
        OSError: The file cannot be written.
    """
    from enact_dist.actor.check import rights_text

    file = config.path.parent / RIGHTS_FILE
    file.write_text(rights_text(config), "utf-8")
    print(
        f"written: {file}; run enact shard reload --all, or start the shards, so that they read it",
        file=sys.stderr,
    )


def _draw(config: CellConfig, file: Path) -> None:
    """Write the picture of a cell's actors and data.

    Raises:
        ConfigError: The file's name does not end in .svg, or no actor of the cell can be loaded.
        OSError: The file cannot be written.
    """
    from enact_dist.actor.check import declarations_of
    from enact_dist.actor.graph import graph_of, svg_of

    if file.suffix.lower() != ".svg":
        raise ConfigError(f"--graph writes an SVG file; name it FILE.svg, not {file}")
    actors, _ = declarations_of(config)
    if not actors:
        raise ConfigError(f"{config.path} has no actor that can be loaded; nothing is drawn")
    graph = graph_of(actors, rates_hz=_rates_hz(config))
    file.write_text(svg_of(graph, f"cell {config.name}"), encoding="utf-8")
    print(
        f"drawn: {file}, {len(actors)} actors, {len(graph.data)} data, {len(graph.lines)} declared"
        " reads and writes",
        file=sys.stderr,
    )


def _rates_hz(config: CellConfig) -> dict[str, float]:
    """Return the updates per second of the actors that run now; none where no shard answers."""
    from enact_dist.link.zenoh.endpoints import somebody_listens
    from enact_dist.world.connecting import connect

    if not any(somebody_listens(one) for shard in config.shards for one in shard.advertise):
        return {}
    try:
        with connect(
            config.path, actor="enact", timeout_s=LOOK_S, request_timeout_s=LOOK_S, observer=True
        ) as cell:
            infos = cell.actors()
    except EnactError:
        return {}
    return {one.name: one.rate_hz for info in infos if not info.silent for one in _reports(info)}
