"""Camera watch: which cameras give images, and substitute silhouettes for those that do not.

A stand-in is all foreground: it vetoes nothing, so the hull only grows.  A set needs no stand-in to
be used, but it would wait for a missing camera; with one, a dead camera costs no time.

Two actors, since the watch looks at all cameras at every tick and must not block any of them from
writing: `CameraWatch` only looks; `StandIn` locks the silhouette of one dead camera at a time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Final, NamedTuple, Self

import numpy as np

from actors.workcell.vocabulary import (
    ABSENT,
    CALIBRATION,
    CAMERA_COUNT,
    CAMERA_STATES,
    CAMERAS,
    IMAGES_COMPARED,
    PERIOD_S,
    SET_BACK_NS,
    SILHOUETTE,
    SYSTEM,
    CameraState,
    Silhouette,
    camera_entity,
)
from enact_dist import Actor, View, ViewEach, World, Write, WriteEach

if TYPE_CHECKING:
    from collections.abc import Mapping

    from enact_dist import Entity, Lock

SILENT: Final = "silent"
STUCK: Final = "stuck"
MISFIT: Final = "background no longer fits"


class Seen(NamedTuple):
    """What is known of a camera from its own silhouettes.

    Attributes:
        last_ns: Stamp of the newest.
        checksums: Of its image and of those before it, the newest first, `IMAGES_COMPARED` in all.
        alike: How many in a row, up to it, were an image of those before.
        foreground: Share of the image that is foreground.
        missed: Sets without it, since its first.
    """

    last_ns: int = 0
    checksums: tuple[int, ...] = ()
    alike: int = 0
    foreground: float = 0.0
    missed: int = 0

    def after(self, silhouette: Silhouette, captured_ns: int) -> Seen:
        """Return what is known when another silhouette has come."""
        if silhouette.stand_in or self.last_ns - SET_BACK_NS <= captured_ns <= self.last_ns:
            return self
        checksum = silhouette.image_checksum
        same = checksum != 0 and checksum in self.checksums
        share = silhouette.foreground_px / (8 * silhouette.packed.size)
        return Seen(
            captured_ns,
            (checksum, *self.checksums)[:IMAGES_COMPARED],
            self.alike + 1 if same else 0,
            share,
            self.missed,
        )

    def state(
        self, tick_ns: int, late_s: float, alike_max: int, foreground_max: float
    ) -> tuple[Seen, CameraState]:
        """Return what is known after a tick, and how the camera does at it.

        Args:
            tick_ns: The tick, ns since 1970.
            late_s: Longest time since the newest silhouette of one that is not silent.
            alike_max: Silhouettes in a row of one image that are no trouble yet.
            foreground_max: Greatest share of foreground that a background still fits.
        """
        trouble = MISFIT if self.foreground > foreground_max else ""
        if tick_ns - self.last_ns > late_s * 1e9:
            trouble = SILENT
        elif self.alike > alike_max:
            trouble = STUCK
        alive = trouble not in {SILENT, STUCK}
        missed = self.missed + (not alive and self.last_ns != 0)
        return self._replace(missed=missed), CameraState(alive, self.last_ns, missed, trouble)


class CameraWatch(Actor):
    """Tell how each calibrated camera does, at every tick.

    A camera is silent if it gave no silhouette for the tick before: it is dead, frozen, or its
    stamps stand still.  It is stuck if its images are, bit by bit, among its last four.  Its
    background no longer fits if too much of the image is foreground.  `absent_ns` asks for a
    stand-in for each silent camera, as long as one camera lives.
    """

    online = World("online")
    silhouette_0 = View(online, camera_entity(0), SILHOUETTE)
    silhouette_1 = View(online, camera_entity(1), SILHOUETTE)
    silhouette_2 = View(online, camera_entity(2), SILHOUETTE)
    silhouette_3 = View(online, camera_entity(3), SILHOUETTE)
    silhouette_4 = View(online, camera_entity(4), SILHOUETTE)
    silhouette_5 = View(online, camera_entity(5), SILHOUETTE)
    silhouette_6 = View(online, camera_entity(6), SILHOUETTE)
    silhouette_7 = View(online, camera_entity(7), SILHOUETTE)
    calibrations = ViewEach(online, CAMERAS, CALIBRATION)
    states = Write(online, SYSTEM, CAMERA_STATES)
    absent = WriteEach(online, CAMERAS, ABSENT)
    every_s = PERIOD_S

    _count: ClassVar[int] = CAMERA_COUNT

    late_s: float = 0.15
    """Longest time between a tick and the stamp of the newest silhouette."""
    alike_max: int = 1
    """Silhouettes in a row of an image that came before, that are no trouble yet."""
    foreground_max: float = 0.3
    """Greatest share of foreground that a background still fits."""

    def __init__(self, *, cameras: int | None = None) -> None:
        if cameras not in (None, self._count):
            raise ValueError(
                f"asked for {cameras} cameras; this class is for {self._count};"
                " CameraWatch.of(cameras) returns another"
            )
        self._seen: dict[Entity, Seen] = {}

    @classmethod
    def of(cls, cameras: int = CAMERA_COUNT) -> type[Self]:
        """Return the watch of a cell with so many cameras, 1 or more.

        Raises:
            ValueError: There are none.
        """
        if cameras < 1:
            raise ValueError(f"cameras is {cameras}; there is nothing to watch")
        if cameras == cls._count:
            return cls
        names: dict[str, object] = dict.fromkeys(map(_attribute, range(cls._count)))
        for number in range(cameras):
            names[_attribute(number)] = View(cls.online, camera_entity(number), SILHOUETTE)
        return type(
            cls.__name__, (cls,), {**names, "_count": cameras, "__module__": cls.__module__}
        )

    @classmethod
    def of_options(cls, options: Mapping[str, object]) -> type[Self]:
        """Return the watch of a cell by the option `cameras`."""
        cameras = options.get("cameras")
        return cls.of(cameras if isinstance(cameras, int) else cls._count)

    def update(self, lock: Lock) -> None:
        """Look at the newest silhouettes."""
        calibrated = lock[self.calibrations].keys()
        states: dict[str, CameraState] = {}
        silent = []
        for number in range(self._count):
            camera = camera_entity(number)
            if camera not in calibrated:
                continue
            view: View[Silhouette] = getattr(self, _attribute(number))
            seen = self._seen.get(camera, Seen())
            newest = lock.get(view)
            if newest is not None:
                seen = seen.after(newest, lock.stamp_ns(view))
            seen, state = seen.state(lock.tick_ns, self.late_s, self.alike_max, self.foreground_max)
            if state.trouble == SILENT:
                silent.append(camera)
            states[camera.name], self._seen[camera] = state, seen
        lock[self.states] = states
        if len(silent) < len(states):
            for camera in silent:
                lock[self.absent][camera] = lock.tick_ns


def _attribute(number: int) -> str:
    """Return under which name the watch declares the silhouette of a camera."""
    return f"silhouette_{number}"


class StandIn(Actor):
    """Give the silhouette of a camera that is silent: all foreground, with the stamp of the set."""

    online = World("online")
    absent = View(online, CAMERAS, ABSENT)
    calibration = View(online, CAMERAS, CALIBRATION)
    silhouette = Write(online, CAMERAS, SILHOUETTE)
    triggers = (absent,)
    shared = (silhouette,)

    def update(self, lock: Lock) -> None:
        """Write a substitute, unless the camera's own silhouette has arrived after all."""
        stamp_ns = lock[self.absent]
        if lock.is_null(self.calibration) or lock.stamp_ns(self.silhouette) >= stamp_ns:
            return
        camera = lock[self.calibration]
        packed = np.full((camera.height, (camera.width + 7) // 8), 255, np.uint8)
        stand_in = Silhouette(packed, camera.width * camera.height, stand_in=True)
        lock.put(self.silhouette, stand_in, stamp_ns=stamp_ns)
