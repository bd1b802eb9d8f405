"""What a run of the workcell was asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from actors.workcell.scenarios import DEFAULT, SECONDS, scenario_of
from enact_dist.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path

PLAYED: Final = ("playback+robot", "playback")
"""Sources that play views which were drawn before; their address names a folder."""
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
        embedded: All in this process, in place of processes.
        separate: Camera, learning and subtraction are actors of their own, as in Figure 4 of the
            paper, in place of one `SmartCamera` per camera.
        quiet: Print the report as JSON in place of progress and table.
        keep_running: Leave the cell up afterwards, until Ctrl-C.

    Raises:
        ConfigError: There is no such scenario, or the options contradict each other.
    """

    out: Path
    scenario: str = DEFAULT
    seed: int = SEED
    seconds: float = SECONDS
    source: str = PLAYED[0]
    voxel_m: float = 0.025
    embedded: bool = False
    separate: bool = False
    quiet: bool = False
    keep_running: bool = False

    def __post_init__(self) -> None:
        scenario = scenario_of(self.scenario, self.seed, self.seconds)
        if self.embedded and scenario.faults:
            raise ConfigError(
                f"scenario {self.scenario} kills and freezes processes, and --embedded has one;"
                " leave out one of both"
            )
