"""`enact demo workcell`: the application of ENACT 4.1, simulated or on real pictures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from enact_dist.cli.verbs import add_verb, seconds
from enact_dist.errors import ConfigError

if TYPE_CHECKING:
    import argparse

    from enact_dist.cli.verbs import Verb

_EXTRA: Final = ("cv2", "scipy", "numba", "mujoco", "ompl", "ruckig")
"""Modules of the `workcell` extra, which the core does without."""
_CHOICES: Final = ("scenario", "seed", "seconds", "voxel_m", "source")


def add_to(verbs: argparse._SubParsersAction[Verb]) -> None:
    """Add the verb."""
    demo = add_verb(
        verbs,
        "workcell",
        "eight cameras watch a person and a robot, which slows down, stops and goes around",
        run=run_workcell,
        example="enact demo workcell\n"
        "enact demo workcell --scenario S3 --seconds 30 --seed 2 --out workcell\n"
        "enact demo workcell --live --json",
    )
    demo.add_argument("--scenario", metavar="S", help="visit (the default) or S1 to S12")
    demo.add_argument("--seed", type=int, metavar="N", help="of ways, speeds and noise")
    demo.add_argument("--seconds", type=seconds, metavar="S", help="how long (default 60)")
    demo.add_argument("--out", type=Path, metavar="DIR", help="where pictures and tables go")
    demo.add_argument("--voxel-m", type=float, metavar="M", help="edge of a voxel (default 0.025)")
    demo.add_argument("--live", action="store_true", help="render the images at run time")
    demo.add_argument("--play", type=Path, metavar="DIR", help="play views recorded there")
    demo.add_argument("--record", type=Path, metavar="DIR", help="draw the views there, and end")
    demo.add_argument(
        "--renderer", choices=("composite", "mujoco"), default="composite", help="of --record"
    )
    demo.add_argument("--embedded", action="store_true", help="all in one process")
    demo.add_argument("--json", action="store_true", help="print the report as JSON")
    demo.add_argument(
        "--keep-running", action="store_true", help="leave the cell up afterwards, until Ctrl-C"
    )


def run_workcell(arguments: argparse.Namespace) -> int:
    """Run the demonstration that the options ask for."""
    try:
        return _run(arguments)
    except ImportError as error:
        if (error.name or "").partition(".")[0] in (*_EXTRA, "mcap", "foxglove_schemas_protobuf"):
            raise ConfigError(
                f"the demo needs {error.name}, which is not installed; install its extras:"
                " pip install -e '.[workcell,record]' in the clone of enact-dist"
            ) from error
        raise


def _run(arguments: argparse.Namespace) -> int:
    from actors.workcell.demo import record_views, run_demo
    from actors.workcell.demo_options import Options

    out: Path = arguments.out or Path("workcell_out")
    given: dict[str, Any] = {
        name: getattr(arguments, name, None)
        for name in _CHOICES
        if getattr(arguments, name, None) is not None
    }
    if arguments.live and arguments.play:
        raise ConfigError("--live draws the images that --play plays; leave out one of both")
    if arguments.live:
        given["source"] = "live"
    if arguments.play:
        given["source"] = f"playback+robot:{arguments.play.resolve()}"
    options = Options(
        out,
        embedded=arguments.embedded,
        quiet=arguments.json,
        keep_running=arguments.keep_running,
        **given,
    )
    if arguments.record:
        return record_views(options, arguments.record, arguments.renderer)
    out.mkdir(parents=True, exist_ok=True)
    return run_demo(options)
