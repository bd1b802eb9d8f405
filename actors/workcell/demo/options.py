"""What a run of the workcell was asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from actors.workcell.cameras.sources import CameraError
from actors.workcell.scenarios import DEFAULT, SECONDS, scenario_of
from actors.workcell.simulation.recording import read_info
from enact_dist.errors import ConfigError

PLAYED: Final = ("playback+robot", "playback")
"""Sources that play views which were drawn before; their address names a folder."""
VOXEL_M_MIN: Final = 0.01
VOXEL_M_MAX: Final = 0.2
"""A voxel of 1 cm takes 35 million; one of 20 cm is larger than an arm."""
SCALE_MIN: Final = 0.25
SEED: Final = 1
"""The seed of a plain run."""


@dataclass(frozen=True, slots=True)
class Options:
    """What was asked for.

    Attributes:
        out: Folder for pictures, report, recording; it exists.
        scenario: Name of the scenario.
        seed: Its seed.
        seconds: How long it lasts.
        source: Address of the cameras' source; one of `PLAYED` alone plays what is kept for it.
        voxel_m: Edge of a voxel.
        scale: Of the images: 1 is 640 x 480 pixels, 0.5 a quarter of the work.
        embedded: All in this process, in place of processes.
        separate: Camera, learning and subtraction are actors of their own, as in Figure 4 of the
            paper, in place of one `SmartCamera` per camera.
        quiet: Print the report as JSON in place of progress and table.
        keep_running: Leave the cell up afterwards, until Ctrl-C.
        cell: The `cell.toml` of a cell whose processes run already, to be conducted and scored.

    Raises:
        ConfigError: There is no such scenario, a value is out of range, or the options contradict
            each other, or the folder to play holds no recording.
    """

    out: Path
    scenario: str = DEFAULT
    seed: int = SEED
    seconds: float = SECONDS
    source: str = PLAYED[0]
    voxel_m: float = 0.025
    scale: float = 1.0
    embedded: bool = False
    separate: bool = False
    quiet: bool = False
    keep_running: bool = False
    cell: Path | None = None

    def __post_init__(self) -> None:
        if not VOXEL_M_MIN <= self.voxel_m <= VOXEL_M_MAX:
            raise ConfigError(
                f"--voxel-m is {self.voxel_m:g}; a voxel of {VOXEL_M_MIN:g} to {VOXEL_M_MAX:g} m is"
                " small enough for a person and large enough for the memory"
            )
        if not SCALE_MIN <= self.scale <= 1.0:
            raise ConfigError(f"--scale is {self.scale:g}; it may be {SCALE_MIN:g} to 1")
        if self.scale < 1.0 and self.source != "live":
            raise ConfigError(
                f"--scale {self.scale:g}: views that were drawn before have 640 x 480 pixels; draw"
                " smaller ones with --live"
            )
        if self.out.exists() and not self.out.is_dir():
            raise ConfigError(f"--out {self.out} is a file; name a folder, it need not exist")
        kind, _, folder = self.source.partition(":")
        if kind in PLAYED and folder:
            self._check_recording(Path(folder))
        scenario = scenario_of(self.scenario, self.seed, self.seconds)
        if self.embedded and scenario.faults:
            raise ConfigError(
                f"scenario {self.scenario} kills and freezes processes, and --embedded has one;"
                " leave out one of both"
            )
        if self.cell is not None and scenario.faults:
            raise ConfigError(
                f"{self.cell}: scenario {self.scenario} kills and freezes processes, and those of"
                " this cell run elsewhere; name another scenario in the args of its actor setup",
                path=str(self.cell),
            )

    def _check_recording(self, folder: Path) -> None:
        """Refuse to play a recording of something else: its cameras would refuse it much later."""
        try:
            info = read_info(folder)
        except CameraError as error:
            raise ConfigError(str(error)) from error
        recorded = (info.scenario, info.seed, info.seconds)
        if recorded != (self.scenario, self.seed, self.seconds):
            scenario, seed, seconds = recorded
            raise ConfigError(
                f"{folder}: asked for a recording of {self.scenario}, seed {self.seed},"
                f" {self.seconds:g} s; found one of {scenario}, seed {seed}, {seconds:g} s; play it"
                f" with --scenario {scenario} --seed {seed} --seconds {seconds:g}"
            )
