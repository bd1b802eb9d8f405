"""Train from a real RGB-D recording: its views through a world context, as the simulated ones go.

    RecordedPerception -> cloud, viewpoint, colour of each view
    Reconstruction     -> its boundary representation      (the same actor as in the simulation)
    RecordedFusion     -> one coloured surface of all views

A recording may show a whole room, with no plate below and nothing to segment, so perception keeps
all points; and fusion takes the poses as they were recorded and keeps every surface, where the
product's fusion refines within what a robot is off and carves the surroundings away.

Annotations stay real types here (no `from __future__ import annotations`): the wire reads them.
"""

import time
from pathlib import Path
from typing import Final

import numpy as np

from actors.geometry.scans.recordings import read_recording
from actors.geometry.shapes import DepthFrame, PointCloud, RecordedFrame
from actors.geometry.surfaces.coloured_surface import ColouredSurface
from actors.geometry.surfaces.depth import depth_of_points, metres, millimetres, points_grid
from actors.geometry.surfaces.rgbd_fusion import fuse_frames, natural_voxel_m
from actors.palletizing.vocabulary import (
    CLOUD,
    SCAN,
    SURFACE,
    VIEWPOINT,
    VIEWS,
    Viewpoint,
    product_entity,
    view_entity,
)
from enact_dist import Actor, Aspect, Lock, View, ViewEach, World, Write, WriteEach

RECORDED: Final = "recording"
"""Name under which what a recording shows stands among the products."""

VIEWS_MAX: Final = 40
"""Views kept of a longer recording, evenly spread: 15 MB and a second of reconstruction each."""

COLOUR: Final = Aspect("colour", np.ndarray)
"""Colour image registered to the depth image (view/*), (H, W, 3) uint8, RGB."""
COLOURED_SURFACE: Final = Aspect("coloured_surface", ColouredSurface)
"""Surface of everything that was recorded (product/recording), world frame of the trajectory."""


class RecordedPerception(Actor):
    """Put a recording into the training context, one view per update (ENACT 4.2, offline).

    Args:
        directory: The recording; read and checked here, before anything is written.
        views_max: Views kept of a longer recording, evenly spread.

    Raises:
        InputFileError: The recording cannot be used.
    """

    training = World("training")
    scan = Write(training, product_entity(RECORDED), SCAN)
    clouds = WriteEach(training, VIEWS, CLOUD)
    viewpoints = WriteEach(training, VIEWS, VIEWPOINT)
    colours = WriteEach(training, VIEWS, COLOUR)
    every_s = 0.05

    def __init__(self, directory: str, views_max: int = VIEWS_MAX) -> None:
        self.recording = read_recording(Path(directory), views_max=views_max)

    def update(self, lock: Lock) -> None:
        """Write the next view that is missing, if one is."""
        done = lock[self.viewpoints].keys()
        for number, frame in enumerate(self.recording.frames):
            view = view_entity(RECORDED, number)
            if view not in done:
                grid_m = points_grid(metres(frame.depth.depth_mm), self.recording.camera)
                lock[self.clouds][view] = PointCloud(grid_m[np.isfinite(grid_m).all(axis=2)])
                lock[self.viewpoints][view] = Viewpoint(frame.depth.acquisition, time.time_ns())
                lock[self.colours][view] = frame.colour
                lock[self.scan] = len(self.recording.frames)
                return


class RecordedFusion(Actor):
    """Fuse all views of a recording into one coloured surface, once the last one is there.

    Args:
        voxel_m: Edge of the grid, metres; 0 for two pixels at the median depth.
    """

    training = World("training")
    scan = View(training, product_entity(RECORDED), SCAN)
    viewpoints = ViewEach(training, VIEWS, VIEWPOINT)
    colours = ViewEach(training, VIEWS, COLOUR)
    surfaces = ViewEach(training, VIEWS, SURFACE)
    model = Write(training, product_entity(RECORDED), COLOURED_SURFACE)
    triggers = (surfaces,)

    def __init__(self, voxel_m: float = 0.0) -> None:
        self.voxel_m = voxel_m

    def update(self, lock: Lock) -> None:
        """Fuse, if every view has its surface."""
        surfaces = lock[self.surfaces]
        views = [view for view in surfaces if view.name.split("/")[1] == RECORDED]
        if len(views) < lock.get(self.scan, len(views) + 1):
            return
        frames = []
        for view in sorted(views):
            acquisition = lock[self.viewpoints][view].acquisition
            depth_m = depth_of_points(surfaces[view].vertices_m, acquisition.camera)
            depth = DepthFrame(millimetres(depth_m), acquisition)
            frames.append(RecordedFrame(view.name, depth, lock[self.colours][view]))
        lock[self.model] = fuse_frames(frames, voxel_m=self.voxel_m or natural_voxel_m(frames))
