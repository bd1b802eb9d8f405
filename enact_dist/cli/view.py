"""`enact view`: a cell, or a recording, in the browser."""

from __future__ import annotations

import argparse
import os
import sys
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from enact_dist.cli.arguments import CELL_NAMED, above_zero, pair, seconds_of
from enact_dist.cli.record import shows_of
from enact_dist.cli.target import cell_target, open_cell
from enact_dist.cli.verbs import DONE, NOUNS, Verb, many, option
from enact_dist.errors import ConfigError
from enact_dist.link.signals import StopSignals

if TYPE_CHECKING:
    from enact_dist.config.shows import Shows
    from enact_dist.terms import Aspect
    from enact_dist.view.pages.viewer import ViewSettings
    from enact_dist.view.recorded import RecordingSource
    from enact_dist.world.cell import Cell
    from enact_dist.world.lineage import Made

PORT: Final = 8080
PORTS_TRIED: Final = 1000
ANSWER_S: Final = 2.0
"""How long a shard is waited for: a page goes on without one that has gone."""

TOKEN_VARIABLE: Final = "ENACT_VIEW_TOKEN"  # noqa: S105 - its name


def port(text: str) -> int:
    """Read a port, 0 for any; an `argparse` type."""
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is no port from 0 to 65535")
    return int(text)


RESOLUTION_MIN: Final = 0.25
"""With less, one thing looks like another."""


def resolution(text: str) -> float:
    """Read a factor from 0.25 to 1; an `argparse` type."""
    value = above_zero(text)
    if not RESOLUTION_MIN <= value <= 1.0:
        raise argparse.ArgumentTypeError(f"{text!r} is no factor from {RESOLUTION_MIN} to 1")
    return value


VERBS: Final = (
    Verb(
        "view", NOUNS["view"].summary, "run_view",
        "enact view cell.toml\n"
        "enact view tcp/robot:7447 --world online --shows image=image\n"
        "enact view run.mcap --port 8090",
        (
            CELL_NAMED,
            option("--world", "NAME", "the context that a page begins with (default: the first)",
                   default=""),
            option("--host", "ADDRESS",
                   "address to listen on; beyond the loopback a browser needs the token that is"
                   f" printed, or that {TOKEN_VARIABLE} has (default: 127.0.0.1)",
                   default="127.0.0.1"),
            option("--port", "N",
                   f"port, 0 for any (default: {PORT}, or the next free one if that is taken)",
                   type=port),
            many("--shows", "ASPECT=KIND",
                 "as in enact record (default: as the cell.toml says, else guessed)", type=pair),
            option("--rate", "HZ", "most updates of a page per second (default: 10)",
                   type=above_zero, default=10.0),
            option("--bytes", "MB", "most megabytes per second that are fetched of the present"
                   " (default: 150)", dest="megabytes_s", type=above_zero, default=150.0),
            option("--resolution", "FACTOR",
                   "draw so many pixels for each of the page, in both directions, from 0.25 to 1:"
                   " 0.5 for a browser without a graphics card (default: viser adapts it)",
                   type=resolution),
            seconds_of("--timeout", "how long a shard may take to answer (default: 2)", ANSWER_S,
                       dest="timeout_s"),
        ),
    ),
)  # fmt: skip


def run_view(options: argparse.Namespace) -> int:
    """Serve pages until a signal."""
    from enact_dist.view.pages.server import ViewServer, load_viser
    from enact_dist.view.pages.viewer import Viewer
    from enact_dist.world.look import look_at

    load_viser()
    with ExitStack() as stack:
        stop = stack.enter_context(StopSignals())
        if Path(options.cell or "").suffix == ".mcap":
            from enact_dist.view.recorded import RecordingSource

            shown: Cell | RecordingSource = RecordingSource(options.cell)
            options.cell = None
        else:
            options.cell = cell_target(options)
            shown = stack.enter_context(open_cell(options, actor="view"))
            look_at(shown)  # without the right `observe` it ends here, by its name
        viewer = stack.enter_context(Viewer(shown, _settings(options)))
        token = os.environ.get(TOKEN_VARIABLE)
        server = stack.enter_context(
            ViewServer(
                viewer,
                host=options.host,
                port=PORT if options.port is None else options.port,
                tries=PORTS_TRIED if options.port is None else 1,
                token=token,
                resolution=options.resolution,
            )
        )
        if options.port is None and server.port != PORT:
            print(f"enact: port {PORT} is taken; this is the next free one", file=sys.stderr)
        print(f"{viewer.name}: {server.url}", flush=True)
        stop.event.wait()
    return DONE


def _settings(options: argparse.Namespace) -> ViewSettings:
    from enact_dist.view.pages.viewer import ViewSettings

    return ViewSettings(
        _shows(options),
        options.world,
        options.rate,
        options.megabytes_s * 1e6,
        partial(_aspects, options.cell),
        partial(_pin, options.cell) if options.cell else None,
    )


def _shows(options: argparse.Namespace) -> dict[str, Shows]:
    """Return what aspects look like; those of a recording as the cell.toml here says, if any."""
    if options.cell or options.shows:
        return shows_of(options)
    try:
        return shows_of(options)
    except ConfigError:
        return {}


def _aspects(target: str) -> list[Aspect[Any]]:
    """Return the aspects of a cell.toml that have a comparator; others are compared exactly.

    Raises:
        ConfigError: The file would run a module outside the packages of the cell's actors.
    """
    from enact_dist.cli.world.diff import configured_aspects

    asked = argparse.Namespace(cell=target, tolerance=[], aspect=None, trust=False)
    return list(configured_aspects(asked).values())


def _pin(target: str, label: str, versions: list[Made]) -> None:
    """Pin versions through a session of its own: that of the view may only look."""
    from enact_dist.world.connecting import connect

    with connect(target, actor="view") as cell:
        cell.pin(label, versions)
