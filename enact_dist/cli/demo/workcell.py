"""`enact demo workcell`: the application of ENACT 4.1, simulated or on real pictures."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, Final

from enact_dist.errors import ConfigError
from enact_dist.extras import needing

_MODULES: Final = ("cv2", "scipy", "numba", "mujoco", "ompl", "ruckig", "mcap")
"""Modules that the demo needs beside those of the core."""
_CHOICES: Final = ("scenario", "seed", "seconds", "voxel_m", "scale", "source")


@needing("the demo", "workcell,record", *_MODULES, "foxglove_schemas_protobuf")
def run_workcell(options: argparse.Namespace) -> int:
    """Run the demonstration that the options ask for."""
    out: Path = options.out or Path("workcell_out")
    _refuse_mixture(options)
    if options.cameras:
        return _run_folder(options, out)
    from actors.workcell.demo.cell import options_of
    from actors.workcell.demo.options import Options
    from actors.workcell.demo.run import record_views, run_demo

    if options.cell:
        out.mkdir(parents=True, exist_ok=True)
        return run_demo(options_of(options.cell, out, quiet=options.json))

    given: dict[str, Any] = {
        name: getattr(options, name, None)
        for name in _CHOICES
        if getattr(options, name, None) is not None
    }
    if options.live and options.play:
        raise ConfigError("--live draws the images that --play plays; leave out one of both")
    if options.live:
        given["source"] = "live"
    if options.play:
        given["source"] = f"playback+robot:{options.play.resolve()}"
    chosen = Options(
        out,
        embedded=options.embedded,
        separate=options.separate,
        quiet=options.json,
        keep_running=options.keep_running,
        **given,
    )
    if options.record:
        return record_views(chosen, options.record, options.renderer or "composite")
    out.mkdir(parents=True, exist_ok=True)
    return run_demo(chosen)


def _run_folder(options: argparse.Namespace, out: Path) -> int:
    from actors.workcell.folders.pictures import colour_of
    from actors.workcell.folders.run import FolderOptions, run_folder

    given: dict[str, Any] = {
        name: getattr(options, name)
        for name in ("grid", "unit", "frame")
        if getattr(options, name) is not None
    }
    if options.key is not None:
        try:
            given["key"] = colour_of(options.key)
        except ValueError as error:
            raise ConfigError(f"--key: {error}") from None
    wanted = FolderOptions(
        **given, pixel_distortion=options.distortion == "pixel", quiet=options.json
    )
    return run_folder(options.cameras, out, wanted)


def _refuse_mixture(options: argparse.Namespace) -> None:
    if options.renderer and not options.record:
        raise ConfigError("--renderer belongs to --record DIR; leave it out, or record views first")
    simulated = (
        "scenario",
        "seed",
        "seconds",
        "voxel_m",
        "scale",
        "live",
        "play",
        "record",
        "embedded",
        "separate",
    )
    real = ("grid", "unit", "frame", "key", "distortion")
    if options.cell:
        for name in (*simulated, *real, "cameras", "keep_running"):
            if getattr(options, name) not in {None, False}:
                raise ConfigError(
                    f"--{name.replace('_', '-')} is the choice of those who started the cell that"
                    " --cell names; leave out one of both"
                )
    for names, fits, where in (
        (simulated, not options.cameras, "the simulated cell, not to --cameras"),
        (real, bool(options.cameras), "--cameras FOLDER"),
    ):
        found = [name for name in names if getattr(options, name) not in {None, False}]
        if found and not fits:
            option = found[0].replace("_", "-")
            raise ConfigError(f"--{option} belongs to {where}; leave out one of both")
