"""The list-driven cell of a palletizing demonstration, which others run: in containers for one."""

from __future__ import annotations

from pathlib import Path
from typing import Final
from urllib.parse import parse_qsl

from actors.running_cell import DemoCell
from enact_dist.config.read import load_config
from enact_dist.errors import ConfigError

_SENSORS: Final = "actors.palletizing.simulation.sensors"
_EYE: Final = "online-perception"


class PalletizingCell(DemoCell):
    """A palletizing cell that others run."""

    def __init__(self, config: Path, *, packages: int, seed: int) -> None:
        super().__init__(config, log="the logs of its processes")
        self.packages, self.seed = packages, seed


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
    return PalletizingCell(config, packages=packages, seed=seed)
