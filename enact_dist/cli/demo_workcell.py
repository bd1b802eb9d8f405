"""`enact demo workcell`: the application of ENACT 4.1, simulated or on real pictures."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from enact_dist.cli.verbs import add_verb, seconds, whole
from enact_dist.errors import ConfigError

if TYPE_CHECKING:
    from enact_dist.cli.verbs import Verb

_EXTRA: Final = ("cv2", "scipy", "numba", "mujoco", "ompl", "ruckig")
"""Modules of the `workcell` extra, which the core does without."""
_CHOICES: Final = ("scenario", "seed", "seconds", "voxel_m", "source")

FORMATS: Final = """\
FOLDER holds, as .png, .jpg, .ppm, .pgm, .bmp or .tif (without MOMENT if there is only one):
  masks/CAMERA/MOMENT.png      not black is foreground
  images/CAMERA/MOMENT.png     where there are no masks, with background/CAMERA.png or --key
and one calibration of all cameras, with x_camera = R X + t:
  cameras.json                 as enact workcell calibrate writes it: "unit", and "cameras", each
                               with "name", "K", "R", "t" (or "P"), "distortion", "width", "height"
  cameras.txt and images.txt   of COLMAP, as text, here or in sparse, sparse/0, colmap
  NAME.txt                     the number of cameras, and a line for each: name K(9) R(9) t(3)
  CAMERA.txt                   a 3 x 4 projection, here or in calib, projections, cameras
  CAMERA.yml, .yaml, .xml      of OpenCV, in the same places: camera_matrix,
                               distortion_coefficients, and R with t, or projection_matrix
bounds.json, {"low": [x, y, z], "high": [x, y, z]}, says where to look, if that is known."""
"""What a folder of pictures holds; `camera_sets` and `folder_pictures` read it."""


def add_to(verbs: argparse._SubParsersAction[Verb]) -> None:
    """Add the verb."""
    demo = add_verb(
        verbs,
        "workcell",
        "eight cameras watch a person and a robot, which slows down, stops and goes around",
        run=run_workcell,
        example="enact demo workcell\n"
        "enact demo workcell --scenario S3 --seconds 30 --seed 2 --out workcell\n"
        "enact demo workcell --live --json\n"
        "enact demo workcell --cell cell.toml --out workcell\n"
        "enact demo workcell --cameras pictures --out hull",
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
        "--renderer", choices=("composite", "mujoco"), help="of --record (default composite)"
    )
    demo.add_argument("--embedded", action="store_true", help="all in one process")
    demo.add_argument(
        "--separate",
        action="store_true",
        help="camera, learning and subtraction as actors of their own, as in the paper's Figure 4",
    )
    demo.add_argument("--json", action="store_true", help="print the report as JSON")
    demo.add_argument(
        "--keep-running", action="store_true", help="leave the cell up afterwards, until Ctrl-C"
    )
    demo.add_argument(
        "--cell",
        type=Path,
        metavar="FILE",
        help="the cell.toml of a workcell that runs already, to be conducted and scored",
    )
    real = demo.add_argument_group(
        "real pictures of calibrated cameras instead of the simulation", FORMATS
    )
    real.add_argument("--cameras", type=Path, metavar="FOLDER", help="pictures or masks")
    real.add_argument("--grid", type=whole, metavar="N", help="voxels along the longest edge")
    real.add_argument("--unit", metavar="U", help="of a calibration that does not say its own: m")
    real.add_argument("--frame", metavar="NAME", help="which moment (default: the first)")
    real.add_argument("--key", metavar="COLOUR", help="of the backdrop: green, #00b140 or 0,177,64")
    real.add_argument("--distortion", choices=("pixel",), help="k1, k2, k3 act on radii in pixels")


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
    out: Path = arguments.out or Path("workcell_out")
    _refuse_mixture(arguments)
    if arguments.cameras:
        return _run_folder(arguments, out)
    from actors.workcell.demo import record_views, run_demo
    from actors.workcell.demo_cell import options_of
    from actors.workcell.demo_options import Options

    if arguments.cell:
        out.mkdir(parents=True, exist_ok=True)
        return run_demo(options_of(arguments.cell, out, quiet=arguments.json))

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
        separate=arguments.separate,
        quiet=arguments.json,
        keep_running=arguments.keep_running,
        **given,
    )
    if arguments.record:
        return record_views(options, arguments.record, arguments.renderer or "composite")
    out.mkdir(parents=True, exist_ok=True)
    return run_demo(options)


def _run_folder(arguments: argparse.Namespace, out: Path) -> int:
    from actors.workcell.folder_pictures import colour_of
    from actors.workcell.folders import FolderOptions, run_folder

    given: dict[str, Any] = {
        name: getattr(arguments, name)
        for name in ("grid", "unit", "frame")
        if getattr(arguments, name) is not None
    }
    if arguments.key is not None:
        try:
            given["key"] = colour_of(arguments.key)
        except ValueError as error:
            raise ConfigError(f"--key: {error}") from None
    options = FolderOptions(
        **given, pixel_distortion=arguments.distortion == "pixel", quiet=arguments.json
    )
    return run_folder(arguments.cameras, out, options)


def _refuse_mixture(arguments: argparse.Namespace) -> None:
    if arguments.renderer and not arguments.record:
        raise ConfigError("--renderer belongs to --record DIR; leave it out, or record views first")
    simulated = (
        "scenario",
        "seed",
        "seconds",
        "voxel_m",
        "live",
        "play",
        "record",
        "embedded",
        "separate",
    )
    real = ("grid", "unit", "frame", "key", "distortion")
    if arguments.cell:
        for name in (*simulated, *real, "cameras", "keep_running"):
            if getattr(arguments, name) not in {None, False}:
                raise ConfigError(
                    f"--{name.replace('_', '-')} is the choice of those who started the cell that"
                    " --cell names; leave out one of both"
                )
    for names, fits, where in (
        (simulated, not arguments.cameras, "the simulated cell, not to --cameras"),
        (real, bool(arguments.cameras), "--cameras FOLDER"),
    ):
        found = [name for name in names if getattr(arguments, name) not in {None, False}]
        if found and not fits:
            option = found[0].replace("_", "-")
            raise ConfigError(f"--{option} belongs to {where}; leave out one of both")
