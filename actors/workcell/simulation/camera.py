"""The camera of the simulated cell: the `Camera` actor, with a look at what plays."""

from __future__ import annotations

from typing import TYPE_CHECKING

from actors.workcell.camera import Camera
from actors.workcell.cameras.sources import CameraError
from actors.workcell.simulation.sources import LiveSource
from actors.workcell.smart_camera import SmartCamera
from actors.workcell.vocabulary import JOINTS, PLAYING, ROBOT, SCENARIO
from enact_dist import Lock, View, World

if TYPE_CHECKING:
    from actors.workcell.cameras.sources import CameraSource


class SimulatedCamera(Camera):
    """Publishes what one camera of the simulated room sees.

    The truth context names the scenario; the arm's joints give the arm's pose.

    Attributes:
        stuck: The source repeats its last image from now on, as a frozen driver does; `enact actor
            set NAME stuck=true`.
    """

    truth = World("truth")
    playing = View(truth, SCENARIO, PLAYING)
    joints = View(Camera.online, ROBOT, JOINTS)
    stuck: bool = False

    def __init__(self, source: str = "live") -> None:
        super().__init__(source)
        self._simulated: LiveSource | None = None

    def make_source(self) -> CameraSource:
        """Return the source at the actor's address.

        Raises:
            CameraError: It is no address of a simulated source.
        """
        source = super().make_source()
        if not isinstance(source, LiveSource):
            raise CameraError(
                f"{self.source}: asked for a simulated source: live, playback:DIR or"
                " playback+robot:DIR; the actor Camera takes the others"
            )
        self._simulated = source
        return source

    def look(self, lock: Lock) -> None:
        """Tell the source what plays and where the arm is."""
        assert self._simulated is not None
        self._simulated.look(lock.get(self.playing), lock.get(self.joints), stuck=self.stuck)


class SimulatedSmartCamera(SimulatedCamera, SmartCamera):
    """Publishes what one camera of the simulated room sees, and its silhouette."""
