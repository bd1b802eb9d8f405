"""`enact demo palletizing`: the application of ENACT 4.2, simulated or on real recordings."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from enact_dist.errors import ConfigError
from enact_dist.extras import needing

if TYPE_CHECKING:
    import argparse

    from actors.running_cell import DemoStore


@needing("the demo", "actors", "open3d", "scipy", "cv2")
def run_palletizing(options: argparse.Namespace) -> int:
    """Run the demonstration that the options ask for."""
    _refuse_mixture(options)
    out: Path = options.out or Path("demo_out")
    if options.check_net:
        return _check_net(options.check_net, out)
    if options.views:
        from actors.palletizing.real.input import run_views

        return run_views(options.views, out)
    if options.model:
        from actors.palletizing.real.input import run_match

        return run_match(options.model, options.scene, out)
    if options.cell:
        from actors.palletizing.demo.packing import watch_packing

        return watch_packing(options.cell, out=out)
    from actors.palletizing.demo.packing import run_packing

    names = ("packages", "seed", "speed")
    given = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    store = _store_of(options)
    return run_packing(out=out, keep_running=options.keep_running, store=store, **given)


def _store_of(options: argparse.Namespace) -> DemoStore:
    """Return where the cell's data are instead of a folder.

    Raises:
        ConfigError: A takeover is asked for where nothing can take over.
        MisuseError: The address has a password.
        StoreError: The driver is missing.
    """
    from actors.running_cell import DemoStore
    from enact_dist.cli.shard.shard import refuse_password
    from enact_dist.link.postgres.address import require_driver

    url = options.store or os.environ.get("ENACT_STORE", "")
    if options.store:
        refuse_password(url)
    if url:
        require_driver(url)
    elif options.fail_over_after:
        raise ConfigError("--fail-over-after needs a store: say --store URL, or set ENACT_STORE")
    return DemoStore(url, options.fail_over_after or 0)


def _check_net(file: Path, out: Path) -> int:
    from actors.palletizing.handling.net_check import check_net
    from actors.palletizing.handling.nets import NetError

    try:
        print(check_net(file, out))
    except (NetError, OSError) as error:
        raise ConfigError(str(error)) from error
    return 0


def _refuse_mixture(options: argparse.Namespace) -> None:
    if (options.model is None) != (options.scene is None):
        raise ConfigError("--model and --scene belong together: the model is found in the scene")
    if options.views and options.model:
        raise ConfigError("--views trains, --model and --scene find: run them one after the other")
    simulated = [
        name
        for name in ("packages", "seed", "speed", "keep_running", "store", "fail_over_after")
        if getattr(options, name) not in {None, False}
    ]
    option = f"--{simulated[0].replace('_', '-')}" if simulated else ""
    if options.check_net and (option or options.cell or options.views or options.model):
        raise ConfigError("--check-net only checks a file; it goes with --out and no other option")
    if options.cell and (options.views or options.model):
        raise ConfigError("--cell watches a cell that runs; recordings need none")
    if options.cell and option:
        raise ConfigError(f"{option} can only be set when the cell is started, not with --cell")
    if option and (options.views or options.model):
        raise ConfigError(f"{option} belongs to the simulated sensor, not to real recordings")
