"""Camera watch: which cameras give images, and substitute silhouettes for those that do not.

A stand-in is all foreground: it vetoes nothing, so the hull only grows.  A set needs no stand-in to
be used, but it would wait for a missing camera; with one, a dead camera costs no time.

Two actors, since the watch looks at all cameras at every tick and must not block any of them from
writing: `CameraWatch` only looks; `StandIn` locks the silhouette of one dead camera at a time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from actors.workcell.vocabulary import (
    ABSENT,
    CALIBRATION,
    CAMERA_STATES,
    CAMERAS,
    IMAGES_COMPARED,
    PERIOD_S,
    SET_BACK_NS,
    SILHOUETTE,
    SYSTEM,
    CameraState,
    Silhouette,
)
from enact_dist import Actor, View, ViewEach, World, Write, WriteEach

if TYPE_CHECKING:
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
    silhouettes = ViewEach(online, CAMERAS, SILHOUETTE)
    calibrations = ViewEach(online, CAMERAS, CALIBRATION)
    states = Write(online, SYSTEM, CAMERA_STATES)
    absent = WriteEach(online, CAMERAS, ABSENT)
    every_s = PERIOD_S

    late_s: float = 0.15
    """Longest time between a tick and the stamp of the newest silhouette."""
    alike_max: int = 1
    """Silhouettes in a row of an image that came before, that are no trouble yet."""
    foreground_max: float = 0.3
    """Greatest share of foreground that a background still fits."""

    def __init__(self) -> None:
        self._seen: dict[Entity, Seen] = {}

    def update(self, lock: Lock) -> None:
        """Look at the newest silhouettes."""
        newest = lock[self.silhouettes]
        states: dict[Entity, CameraState] = {}
        for camera in lock[self.calibrations]:
            seen = self._seen.get(camera, Seen())
            if camera in newest:
                seen = seen.after(newest[camera], newest.stamp_ns(camera))
            self._seen[camera], states[camera] = seen.state(
                lock.tick_ns, self.late_s, self.alike_max, self.foreground_max
            )
        lock[self.states] = {camera.name: state for camera, state in states.items()}
        silent = [camera for camera, state in states.items() if state.trouble == SILENT]
        if len(silent) < len(states):
            for camera in silent:
                lock[self.absent][camera] = lock.tick_ns


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
