"""The cell of one palletizing demonstration: one that runs already, or one that is started."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import parse_qsl

from actors import running_cell
from actors.running_cell import DemoCell, placed, toml_of
from enact_dist.config.read import load_config
from enact_dist.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from actors.running_cell import DemoStore

TEMPLATE: Final = Path(__file__).parents[1] / "cell.toml"
_SENSORS: Final = "actors.palletizing.simulation.sensors"
_EYE: Final = "online-perception"


class PalletizingCell(DemoCell):
    """A palletizing cell that others run.

    Attributes:
        packages: How many packages come.
        seed: Seed of all simulated sensors.
    """

    def __init__(self, config: Path, *, packages: int, seed: int, log: str) -> None:
        super().__init__(config, log=log)
        self.packages, self.seed = packages, seed


class RunningCell(running_cell.RunningCell):
    """A palletizing cell that is up between entering and leaving the block.

    Args:
        out: Folder for `cell.toml` and `cell.log`.
        packages: How many packages come.
        seed: Seed of all simulated sensors.
        store: Where its data are instead of a folder.
    """

    def __init__(
        self, out: Path, *, packages: int, seed: int, store: DemoStore | None = None
    ) -> None:
        self.packages, self.seed = packages, seed

        def of_this_run(template: str, data: Path, ports: Sequence[int]) -> str:
            return configured(template, packages=packages, seed=seed, data=data, ports=ports)

        super().__init__(
            out, name="palletizing", template=TEMPLATE, configured=of_this_run, store=store
        )


def watched_cell(config: Path) -> PalletizingCell:
    """Return a palletizing cell that runs already, in containers for instance.

    Args:
        config: Its `cell.toml`; the simulated sensor of `online-perception` names there how many
            packages come and their seed.

    Raises:
        ConfigError: The file cannot be used, or the sensor is not the simulated one, for which
                alone the truth is known.
    """
    loaded = load_config(config)
    address = next(
        (str(actor.options.get("sensor")) for actor in loaded.actors if actor.name == _EYE), ""
    )
    found = dict(parse_qsl(address.partition("?")[2]))
    try:
        packages, seed = int(found["packages"]), int(found["seed"])
    except (KeyError, ValueError):
        raise ConfigError(
            f"{config}: the sensor of {_EYE} is {address!r}, which names no packages and seed; only"
            f" of a simulated one is the truth known: {_SENSORS}:tray_sensor?packages=12&seed=59",
            path=str(config),
        ) from None
    return PalletizingCell(config, packages=packages, seed=seed, log="the logs of its processes")


def configured(template: str, *, packages: int, seed: int, data: Path, ports: Sequence[int]) -> str:
    """Return a `cell.toml` for one run: its own ports, data folder, packages and seed.

    Args:
        template: The text of the `cell.toml` of the application.
        packages: How many packages come.
        seed: Seed of all simulated sensors.
        data: Parent of the shards' folders.
        ports: One of this host for each shard.
    """
    config = tomllib.loads(template)
    placed(config, data, ports)
    overhead = f"{_SENSORS}:tray_sensor?packages={packages}&seed={seed}"
    actors = config["actors"]
    actors["planning"]["options"]["packages"] = packages
    actors["training-perception"]["options"] = {
        "sensor": f"{_SENSORS}:orbit_sensor?seed={seed}",
        "tray_sensor": overhead,
    }
    actors[_EYE]["options"] = {"sensor": overhead}
    return toml_of(config)
