"""The cell of one run of the workcell: processes under `enact up`, or all of it in this process."""

from __future__ import annotations

import contextlib
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

from actors import running_cell
from actors.geometry.files import write_whole
from actors.running_cell import DemoCell, placed, toml_of
from actors.workcell.demo.options import Options
from enact_dist import ActorThread, local
from enact_dist.actor.running.load import configured_actor
from enact_dist.config.read import load_config
from enact_dist.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from enact_dist import Cell

TEMPLATE: Final = Path(__file__).parents[1] / "cell.toml"
SETUP: Final = "setup"
"""The actor that is done once it has written what is known; all others go on."""

CAMERA: Final = "actors.workcell.simulation.camera:SimulatedCamera"
SMART_CAMERA: Final = "actors.workcell.simulation.camera:SimulatedSmartCamera"
DONE_BY_SMART: Final = (
    "actors.workcell.background:BackgroundLearning",
    "actors.workcell.background:BackgroundSubtraction",
)
"""What a smart camera does beside giving images."""


def options_of(config: Path, out: Path, *, quiet: bool = False) -> Options:
    """Return what the `cell.toml` of a cell that runs already says of its scenario.

    Args:
        config: The file; the args of its actor `setup` name scenario, seed, seconds and grid.
        out: Folder for pictures, report, recording; it exists.
        quiet: Print the report as JSON.

    Raises:
        ConfigError: The file cannot be used, or is not of a simulated workcell, or its scenario
            breaks processes.
    """
    actors = load_config(config).actors
    setup = next((one for one in actors if one.class_path.endswith(".setup:Setup")), None)
    camera = next((one for one in actors if one.class_path in {CAMERA, SMART_CAMERA}), None)
    if setup is None or camera is None:
        raise ConfigError(
            f"{config}: asked for a simulated workcell, with an actor"
            " actors.workcell.setup:Setup and simulated cameras; found none; only of a simulated"
            " one is the truth known",
            path=str(config),
        )
    given: dict[str, Any] = {
        name: value
        for name, value in setup.options.items()
        if name in {"scenario", "seed", "seconds", "voxel_m", "scale"}
    }
    source = str(camera.options.get("source", "live"))
    separate = camera.class_path == CAMERA
    return Options(out, source=source, separate=separate, quiet=quiet, cell=config, **given)


def configured(template: str, options: Options) -> dict[str, Any]:
    """Return the parsed `cell.toml` of a run: scenario, seed, source of images, grid, layout."""
    config = tomllib.loads(template)
    actors = config["actors"]
    actors[SETUP]["args"] = {
        "scenario": options.scenario,
        "seed": options.seed,
        "seconds": options.seconds,
        "voxel_m": options.voxel_m,
        "scale": options.scale,
    }
    config["aspects"]["hull"]["voxel_m"] = options.voxel_m
    for table in actors.values():
        if table["class"] == CAMERA:
            table["args"] = {**table.get("args", {}), "source": options.source}
            table["class"] = CAMERA if options.separate else SMART_CAMERA
    if not options.separate:
        for name in [name for name, table in actors.items() if table["class"] in DONE_BY_SMART]:
            del actors[name]
    return config


class RunningCell(running_cell.RunningCell):
    """A workcell of processes that is up between entering and leaving the block."""

    def __init__(self, options: Options) -> None:
        def of_this_run(template: str, data: Path, ports: Sequence[int]) -> str:
            config = configured(template, options)
            placed(config, data, ports)
            return toml_of(config)

        super().__init__(options.out, name="workcell", template=TEMPLATE, configured=of_this_run)


class EmbeddedCell(DemoCell):
    """A workcell in this process: one shard, a thread per actor."""

    def __init__(self, options: Options) -> None:
        super().__init__(options.out / "cell.toml", log="this process's output")
        self._options = options
        self._open = contextlib.ExitStack()

    def __enter__(self) -> Self:
        config = configured(TEMPLATE.read_text(), self._options)
        config.pop("data_folder", None)
        write_whole({self.config: toml_of(config).encode()})
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def joined(self) -> contextlib.AbstractContextManager[Cell]:
        """Start the shard and the actors, and return the cell, which is closed after its actors."""
        config = load_config(self.config)
        cell = self._open.enter_context(local(config=config, actor="demo"))
        for actor in config.actors:
            thread = ActorThread(
                configured_actor(actor), cell, dict(actor.worlds) or None, name=actor.name
            )
            self._open.enter_context(thread)
        return contextlib.nullcontext(cell)
