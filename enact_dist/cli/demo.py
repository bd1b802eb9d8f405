"""`enact demo palletizing`: the application of ENACT 4.2, simulated or on real recordings.

`enact demo workcell` is in `demo_workcell`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from enact_dist.cli import demo_workcell
from enact_dist.cli.verbs import add_noun, add_verb, verbs_of, whole
from enact_dist.errors import ConfigError

if TYPE_CHECKING:
    import argparse

    from enact_dist.cli.verbs import Verb

_EXTRA: Final = ("open3d", "scipy", "cv2")
"""Modules of the `actors` extra, which the core does without."""


def add_to(nouns: argparse._SubParsersAction[Verb]) -> None:
    """Add the noun and its verbs."""
    verbs = verbs_of(add_noun(nouns, "demo"))
    demo_workcell.add_to(verbs)
    demo = add_verb(
        verbs,
        "palletizing",
        "a robot packs a tray; actors train models, judge each package and react",
        run=run_palletizing,
        example="enact demo palletizing --packages 6 --seed 1 --speed 1 --out demo\n"
        "enact demo palletizing --cell cell.toml --out demo\n"
        "enact demo palletizing --views redwood_rgbd --out surface\n"
        "enact demo palletizing --model milk.pcd --scene table.pcd --out pose\n"
        "enact demo palletizing --check-net push.toml --out nets",
    )
    demo.add_argument("--packages", type=whole, metavar="N", help="how many packages come by")
    demo.add_argument("--seed", type=int, metavar="S", help="of packages and sensors")
    demo.add_argument(
        "--speed", type=float, metavar="X", help="simulated time per real time (default: 1.25)"
    )
    demo.add_argument("--out", type=Path, metavar="DIR", help="where pictures and tables go")
    demo.add_argument(
        "--keep-running", action="store_true", help="leave the cell up afterwards, until Ctrl-C"
    )
    demo.add_argument(
        "--cell",
        type=Path,
        metavar="FILE",
        help="the cell.toml of a palletizing cell that runs already, to be watched and scored",
    )
    demo.add_argument(
        "--check-net",
        type=Path,
        metavar="FILE",
        help="check a primitive net or skeleton (TOML) and draw it to DIR; nothing runs",
    )
    real = demo.add_argument_group("real recordings instead of the simulated sensor")
    real.add_argument("--views", type=Path, metavar="DIR", help="train from an RGB-D recording")
    real.add_argument("--model", type=Path, metavar="FILE", help="a model to find (PLY, PCD, …)")
    real.add_argument("--scene", type=Path, metavar="FILE", help="the cloud to find it in")


def run_palletizing(arguments: argparse.Namespace) -> int:
    """Run the demonstration that the options ask for."""
    _refuse_mixture(arguments)
    try:
        return _run(arguments)
    except ImportError as error:
        if (error.name or "").partition(".")[0] in _EXTRA or ".so" in str(error):
            raise _missing(error) from error
        raise


def _run(arguments: argparse.Namespace) -> int:
    out: Path = arguments.out or Path("demo_out")
    if arguments.check_net:
        return _check_net(arguments.check_net, out)
    if arguments.views:
        from actors.palletizing.real_input import run_views

        return run_views(arguments.views, out)
    if arguments.model:
        from actors.palletizing.real_input import run_match

        return run_match(arguments.model, arguments.scene, out)
    if arguments.cell:
        from actors.palletizing.demo_packing import watch_packing

        return watch_packing(arguments.cell, out=out)
    from actors.palletizing.demo_packing import run_packing

    names = ("packages", "seed", "speed")
    given = {
        name: getattr(arguments, name) for name in names if getattr(arguments, name) is not None
    }
    return run_packing(out=out, keep_running=arguments.keep_running, **given)


def _check_net(file: Path, out: Path) -> int:
    from actors.palletizing.net_check import check_net
    from actors.palletizing.nets import NetError

    try:
        print(check_net(file, out))
    except (NetError, OSError) as error:
        raise ConfigError(str(error)) from error
    return 0


def _refuse_mixture(arguments: argparse.Namespace) -> None:
    if (arguments.model is None) != (arguments.scene is None):
        raise ConfigError("--model and --scene belong together: the model is found in the scene")
    if arguments.views and arguments.model:
        raise ConfigError("--views trains, --model and --scene find: run them one after the other")
    simulated = [
        name
        for name in ("packages", "seed", "speed", "keep_running")
        if getattr(arguments, name) not in {None, False}
    ]
    option = f"--{simulated[0].replace('_', '-')}" if simulated else ""
    if arguments.check_net and (option or arguments.cell or arguments.views or arguments.model):
        raise ConfigError("--check-net only checks a file; it goes with --out and no other option")
    if arguments.cell and (arguments.views or arguments.model):
        raise ConfigError("--cell watches a cell that runs; recordings need none")
    if arguments.cell and option:
        raise ConfigError(f"{option} can only be set when the cell is started, not with --cell")
    if option and (arguments.views or arguments.model):
        raise ConfigError(f"{option} belongs to the simulated sensor, not to real recordings")


def _missing(error: ImportError) -> ConfigError:
    if ".so" in str(error):
        return ConfigError(
            f"the demo cannot load a shared library ({error}); enact doctor names the package"
        )
    return ConfigError(
        f"the demo needs {error.name}, which is not installed; install the actors extra:"
        " pip install -e '.[actors]' in the clone of enact-dist"
    )
