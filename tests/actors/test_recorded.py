"""A recording goes through a world context as the simulated views do."""

from __future__ import annotations

import numpy as np
import pytest
from slots import get as seen

from actors.palletizing.real.recorded import (
    COLOUR,
    COLOURED_SURFACE,
    RECORDED,
    RecordedFusion,
    RecordedPerception,
)
from actors.palletizing.reconstruction import Reconstruction
from actors.palletizing.vocabulary import CLOUD, SCAN, VIEWPOINT, product_entity, view_entity
from enact_dist.testing import run_once, worlds

pytest.importorskip("open3d", exc_type=ImportError)

MODEL = product_entity(RECORDED)


def test_perception_writes_one_view_per_update_and_then_rests(recording):
    """Cloud, viewpoint and colour of a view appear together; after the last nothing changes."""
    perception = RecordedPerception(str(recording.write()))
    with worlds("training") as cell:
        training = cell.world("training")

        run_once(perception, cell)

        first, second = view_entity(RECORDED, 0), view_entity(RECORDED, 1)
        assert seen(training, MODEL, SCAN) == 6
        assert len(seen(training, first, CLOUD)) > 60_000
        assert np.array_equal(seen(training, first, COLOUR), perception.recording.frames[0].colour)
        assert seen(training, second, CLOUD) is None
        for _ in range(7):
            run_once(perception, cell)
        pose = seen(training, view_entity(RECORDED, 5), VIEWPOINT).acquisition.world_from_camera
        assert np.array_equal(pose, recording.poses[5])
        assert seen(training, view_entity(RECORDED, 6), VIEWPOINT) is None


def test_fusion_waits_for_the_last_view_and_lies_on_the_place(recording, place_distance):
    """Five of six views give nothing; six give a surface within half a millimetre (median)."""
    perception = RecordedPerception(str(recording.write()))
    reconstruction, fusion = Reconstruction(), RecordedFusion(voxel_m=0.008)
    with worlds("training") as cell:
        training = cell.world("training")
        for _ in range(5):
            run_once(perception, cell)
        run_once(reconstruction, cell)
        run_once(fusion, cell)
        assert seen(training, MODEL, COLOURED_SURFACE) is None

        run_once(perception, cell)
        run_once(reconstruction, cell)
        run_once(fusion, cell)

        surface = seen(training, MODEL, COLOURED_SURFACE)
    assert np.median(place_distance(surface.vertices_m.astype(float))) < 0.0005
    lid = np.abs(surface.vertices_m - (0.0, 0.0, 0.15)).max(1) < 0.05
    assert np.allclose(np.median(surface.colours[lid], axis=0), (200, 60, 40), atol=10)


def test_long_recording_is_thinned_evenly(recording):
    """Of six views three stay: the first, one in the middle, the last."""
    read = RecordedPerception(str(recording.write()), views_max=3).recording

    assert [frame.name for frame in read.frames] == ["00000.png", "00002.png", "00005.png"]
    assert read.recorded == 6
