"""The cell of one demonstration with the robot: its simulated hardware, and its actors."""

from __future__ import annotations

import re
import select
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

from actors import running_cell
from actors.palletizing.simulation.remote_cell import RemoteCell
from actors.running_cell import DemoCell, DemoError, placed, toml_of
from enact_dist.config.read import load_config
from enact_dist.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from actors.running_cell import DemoStore

TEMPLATE: Final = Path(__file__).parents[1] / "robot_cell.toml"
HARDWARE_S: Final = 30.0
"""How long the simulated hardware may take to start; it takes a second or two."""
_PORT: Final = re.compile(r"port=\d+")
_SEED: Final = re.compile(r"seed=\d+")


class RobotCell(DemoCell):
    """A cell with a simulated robot that others run."""

    def __init__(self, config: Path, *, hardware: RemoteCell, packages: int) -> None:
        super().__init__(config, log="the logs of its processes")
        self.hardware, self.packages = hardware, packages

    def __exit__(self, *error: object) -> None:
        self.hardware.close()
        super().__exit__(*error)


class RunningRobotCell(running_cell.RunningCell):
    """A cell with its simulated hardware that is up between entering and leaving the block.

    Args:
        out: Folder for `cell.toml`, `cell.log` and `hardware.log`; it exists.
        packages: How many packages come.
        seed: Of packages and sensors.
        speed: Simulated seconds per second.
        store: Where its data are instead of a folder.

    Attributes:
        hardware: The simulated hardware, which knows the truth.
        packages: How many packages come.
    """

    hardware: RemoteCell

    def __init__(
        self,
        out: Path,
        *,
        packages: int,
        seed: int,
        speed: float,
        store: DemoStore | None = None,
    ) -> None:
        self.packages, self._seed, self._speed = packages, seed, speed
        self._hardware_log = out / "hardware.log"
        self._server: subprocess.Popen[bytes] | None = None
        self._port = 0

        def of_this_run(template: str, data: Path, ports: Sequence[int]) -> str:
            return configured(
                template,
                packages=packages,
                seed=seed,
                data=data,
                ports=ports,
                hardware=self._port,
            )

        super().__init__(
            out, name="packing", template=TEMPLATE, configured=of_this_run, store=store
        )

    def __enter__(self) -> Self:
        command = [sys.executable, "-m", "actors.palletizing.simulation.cell.server", "--until-eof"]
        command += ["--packages", str(self.packages), "--seed", str(self._seed), "--port", "0"]
        command += ["--speed", f"{self._speed:g}"]
        with self._hardware_log.open("wb") as log:
            self._server = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,  # it ends with this process, however that ends
                stdout=subprocess.PIPE,
                stderr=log,
                process_group=0,
            )
        self._port = self._told_port()
        self.hardware = RemoteCell(self._port)
        try:
            return super().__enter__()
        except BaseException:
            self._end_hardware()
            raise

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        self.hardware.close()
        self._end_hardware()

    def check(self) -> None:
        """Raise `DemoError` if the processes or the simulated hardware are gone."""
        super().check()
        if self._server is not None and self._server.poll() is not None:
            raise DemoError(f"the simulated hardware has ended; see {self._hardware_log}")

    def _told_port(self) -> int:
        """Return the port that the hardware listens at.

        Raises:
            DemoError: It did not start.
        """
        assert self._server is not None
        assert self._server.stdout is not None
        told = select.select([self._server.stdout], [], [], HARDWARE_S)[0]
        line = self._server.stdout.readline().decode(errors="replace").strip() if told else ""
        found = re.search(r"port (\d+)$", line)
        if found is None:
            self._end_hardware()
            lines = self._hardware_log.read_text(errors="replace").splitlines()[-5:]
            raise DemoError("\n".join(["the simulated hardware did not start:", line, *lines]))
        return int(found[1])

    def _end_hardware(self) -> None:
        if self._server is not None:
            self._server.terminate()
            self._server.wait()
            for stream in (self._server.stdin, self._server.stdout):
                if stream is not None:
                    stream.close()
            self._server = None


def configured(
    template: str,
    *,
    packages: int,
    seed: int,
    data: Path,
    ports: Sequence[int],
    hardware: int,
) -> str:
    """Return a `cell.toml` for one run: its ports, the hardware's too, folders, packages, seed."""
    parsed = tomllib.loads(template)
    placed(parsed, data, ports)
    for actor in parsed["actors"].values():
        for name, value in actor.get("options", {}).items():
            if isinstance(value, str):
                actor["options"][name] = _SEED.sub(
                    f"seed={seed}", _PORT.sub(f"port={hardware}", value)
                )
    parsed["actors"]["planning"]["options"]["packages"] = packages
    return toml_of(parsed)


def watched_robot_cell(config: Path) -> RobotCell | None:
    """Return a cell with a simulated robot that runs already; None if it is none.

    Raises:
        ConfigError: The file cannot be used, or its hardware is not simulated.
    """
    loaded = load_config(config)
    belt = next((a.options for a in loaded.actors if a.name == "online-perception"), {})
    address = str(belt.get("belt_sensor", ""))
    if not address:
        return None
    found = re.search(r"remote_cell:belt_sensor\?(?:.*&)?port=(\d+)", address)
    host = re.search(r"host=([^&]+)", address)
    if found is None:
        raise ConfigError(
            f"{config}: the belt's sensor is {address!r}; only of simulated hardware is the truth"
            " known: …remote_cell:belt_sensor?port=7460",
            path=str(config),
        )
    planning = next(actor.options for actor in loaded.actors if actor.name == "planning")
    hardware = RemoteCell(int(found[1]), host[1] if host else "")
    return RobotCell(config, hardware=hardware, packages=int(str(planning["packages"])))
