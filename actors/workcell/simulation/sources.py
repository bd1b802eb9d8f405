"""The simulated cameras as sources: drawn live, or played from a recording with the arm drawn live.

Everything but the arm is known before the tick: `prepare` draws or reads the people of the next
tick, `frame` draws the arm where its joints say, and adds the noise of the tick.

What plays, since when, and where the arm is, the actor tells them by `look`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.arms.kinematics import capsules_at
from actors.workcell.cameras.sources import FRAME_S, CameraError, check_options
from actors.workcell.scenarios import scenario_of
from actors.workcell.simulation.arm import ARM, HOME_RAD, shown_at
from actors.workcell.simulation.drawing.render import View, robot_colours
from actors.workcell.simulation.recording import Tape, check_truth
from actors.workcell.simulation.stage import Stage
from actors.workcell.vocabulary import PERIOD_NS

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.workcell.simulation.drawing.render import Rendered
    from actors.workcell.simulation.room import Box
    from actors.workcell.vocabulary import Calibration, Joints, Playing

    Image = npt.NDArray[np.uint8]

FOLLOW_S: Final = 60.0
"""How long another scenario may take to be drawn and compared with its recording."""
EARLY_S: Final = -1.0
"""A time before any person appears, in every scenario."""


@dataclass(frozen=True, slots=True, eq=False)
class Ahead:
    """A view that is ready but for the arm."""

    stamp_ns: int
    playing: Playing | None
    view: Rendered


class LiveSource:
    """A camera of the simulated room, drawn at run time.

    Args:
        camera: Name of the camera: a number.
    """

    draws_arm = True

    def __init__(self, camera: str) -> None:
        if not camera.isdecimal():
            raise CameraError(f"camera/{camera}: asked for a simulated camera, camera/NUMBER")
        self._number = int(camera)
        self._view: View | None = None
        self._seen: tuple[Playing | None, Joints | None, bool] = None, None, False
        self._playing: Playing | None = None
        self._stage: Stage | None = None
        self._ahead: Ahead | None = None
        self._last: Image | None = None

    @property
    def exposed_ns(self) -> int:
        """0: exposed at the tick."""
        return 0

    def open(self, calibration: Calibration) -> None:
        """Draw the room and compile the loops.

        Raises:
            CameraError: What draws is not installed.
        """
        self._view = View(calibration, seed=self._number)
        away = np.array([[0.0, 0.0, 1.5, 0.0, 0.0, 1.6, 0.1]])
        try:
            self._view.render(away, robot_colours(1))
        except ImportError as error:
            raise CameraError(
                f"camera/{self._number}: asked for a simulated camera; found that it cannot draw"
                f" ({error}); install the extra workcell"
            ) from None
        self._ahead = self._playing = self._stage = None
        self._follow()  # draws the rooms of what plays: `frame` has less time

    def look(self, playing: Playing | None, joints: Joints | None, *, stuck: bool = False) -> None:
        """See what plays and where the arm is; `stuck` repeats the last image.

        Unlike the other methods this one may be called by any thread.
        """
        self._seen = playing, joints, stuck

    def _follow(self) -> None:
        """Take up another scenario.

        Raises:
            CameraError: This source cannot play it.
        """
        assert self._view is not None, "open first"
        playing = self._seen[0]
        if playing != self._playing:
            stage = None if playing is None else self.stage_of(playing)
            for boxes in () if stage is None or stage is self._stage else stage.rooms:
                self._view.backdrop(boxes)  # half a second each: now, not while a person walks
            self._stage, self._playing = stage, playing

    def stage_of(self, playing: Playing) -> Stage:
        """Return what a scenario puts where; one that only begins at another time stays as it is.

        Raises:
            CameraError: It begins between two ticks, so that no image is of its second 0.
        """
        if playing.start_ns < 1 << 62 and playing.start_ns % PERIOD_NS:
            raise CameraError(
                f"camera/{self._number}: asked for a scenario that begins at a tick, a multiple of"
                f" {PERIOD_NS} ns; found the begin {playing.start_ns}"
            )
        if self._stage is not None and self._plays(playing):
            return self._stage
        return Stage(scenario_of(playing.scenario, playing.seed, playing.seconds))

    def _plays(self, playing: Playing) -> bool:
        """Whether this is the scenario that plays, whenever it begins."""
        now = self._playing
        return now is not None and (playing.scenario, playing.seed, playing.seconds) == (
            now.scenario,
            now.seed,
            now.seconds,
        )

    @property
    def frame_s(self) -> float:
        """How long the next image may take: another scenario has rooms to draw.

        As `look`, it may be called by any thread.
        """
        playing = self._seen[0]
        return FRAME_S if playing is None or self._plays(playing) else FOLLOW_S

    def prepare(self, stamp_ns: int) -> None:
        """Get the people of a tick ready.

        Raises:
            CameraError: They cannot be.
        """
        self._follow()
        self._ahead = Ahead(stamp_ns, self._playing, self.people(self._at_s(stamp_ns)))

    def frame(self, stamp_ns: int) -> Image:
        """Return the image of a tick.

        Raises:
            CameraError: No image is available.
        """
        self._follow()
        assert self._view is not None
        playing, joints, stuck = self._playing, *self._seen[1:]
        if stuck and self._last is not None:
            return self._last
        ahead, at_s = self._ahead, self._at_s(stamp_ns)
        if ahead is None or ahead.stamp_ns != stamp_ns or ahead.playing is not playing:
            ahead = Ahead(stamp_ns, playing, self.people(at_s))
        self._ahead = None
        view = ahead.view
        if playing is not None and playing.robot and self.draws_arm:
            q = np.array(HOME_RAD) if joints is None else shown_at(joints, stamp_ns)
            arm = capsules_at(ARM, q)[0]
            view = self._view.render(arm, robot_colours(len(arm)), self._boxes(at_s), onto=view)
        brightness = 1.0 if self._stage is None else self._stage.brightness_at(at_s)
        self._last = self._view.exposed(view.image, stamp_ns, brightness)
        return self._last

    def people(self, at_s: float) -> Rendered:
        """Return the room and the people at a time of the scenario."""
        assert self._view is not None
        if self._stage is None:
            return self._view.empty()
        scene = self._stage.scene_at(at_s)
        return self._view.render(scene.capsules, scene.colours, scene.boxes)

    def close(self) -> None:
        """Nothing is open."""

    def _boxes(self, at_s: float) -> tuple[Box, ...]:
        assert self._stage is not None
        return self._stage.boxes + self._stage.things_at(at_s)

    def _at_s(self, stamp_ns: int) -> float:
        """Return the second of the scenario, or a time without people."""
        playing = self._playing
        if playing is None or not 0 <= stamp_ns - playing.start_ns < playing.seconds * 1e9:
            return EARLY_S
        return (stamp_ns - playing.start_ns) / 1e9


class PlaybackSource(LiveSource):
    """A camera of the simulated room, played from a recording.

    Args:
        camera: Name of the camera: a number.
        place: Folder of the recording.
        draws_arm: The arm is drawn over it; else it moves as recorded.
    """

    def __init__(self, camera: str, place: str, *, draws_arm: bool) -> None:
        super().__init__(camera)
        self._folder, self.draws_arm = Path(place), draws_arm
        self._tape: Tape | None = None

    def open(self, calibration: Calibration) -> None:
        """Open the recording.

        Raises:
            CameraError: It is missing, incomplete or of another calibration.
        """
        self._tape = Tape(self._folder, self._number, calibration)
        if self._tape.info.robot and self.draws_arm:
            raise CameraError(
                f"{self._folder}: asked for a recording without the arm; found one with it; play"
                " it as playback:, or record another one"
            )
        super().open(calibration)

    def stage_of(self, playing: Playing) -> Stage:
        """Return what the recording shows.

        Raises:
            CameraError: It is of another scenario, or of this one as it was before a change.
        """
        assert self._tape is not None, "open first"
        info, wanted = self._tape.info, (playing.scenario, playing.seed, playing.seconds)
        if wanted != (info.scenario, info.seed, info.seconds):
            raise CameraError(
                f"{self._folder}: asked for a recording of {playing.scenario}, seed {playing.seed},"
                f" {playing.seconds:g} s; found {info.scenario}, seed {info.seed},"
                f" {info.seconds:g} s; record it, or play what was recorded"
            )
        stage = super().stage_of(playing)
        if stage is not self._stage:
            check_truth(self._folder, stage)
        return stage

    def people(self, at_s: float) -> Rendered:
        """Return the recorded image; depth and shadows are drawn where the arm will need them."""
        assert self._view is not None
        assert self._tape is not None
        if self._stage is None:
            view = self._view.empty()
            self._tape.play(view.image, None)
            return view
        scene = self._stage.scene_at(at_s)
        view = self._view.empty(scene.boxes)
        self._tape.play(view.image, None if at_s < 0.0 else round(at_s * 1e9 / PERIOD_NS))
        if not self.draws_arm:
            return view
        return self._view.render(scene.capsules, None, scene.boxes, onto=view)


def simulated_source(kind: str, place: str, options: dict[str, str], camera: str) -> LiveSource:
    """Return the source at an address of the kinds `live`, `playback` and `playback+robot`.

    Raises:
        CameraError: An option is unknown, or the camera is none of the simulated room.
    """
    check_options(f"{kind}:{place}", options)
    if kind == "live":
        return LiveSource(camera)
    return PlaybackSource(camera, place, draws_arm=kind == "playback+robot")
