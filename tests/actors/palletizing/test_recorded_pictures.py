"""What the palletizing cell says that its data look like fits them, frames and units included."""

from pathlib import Path

import numpy as np
import pytest

import actors.palletizing as application
from actors.geometry.shapes import VGA, Acquisition, DepthFrame, PointCloud, Surface
from actors.palletizing import vocabulary
from actors.palletizing.vocabulary import Observation, Plan, Sighting, Viewpoint
from enact_dist.config.read import load_config
from enact_dist.core.protocol.datum import Slot
from enact_dist.recording.drawing.pictures import pictures_of
from enact_dist.recording.exact import Recorded
from enact_dist.wire.payload import encode_datum

POSE = np.eye(4)
POSE[:3, 3] = 0.1, 0.2, 0.3
FRAME = DepthFrame(np.full(VGA.shape, 700, np.uint16), Acquisition(VGA, POSE))
POINTS_M = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
DATA = {
    "cloud": ("package/7", PointCloud(POINTS_M)),
    "observation": ("place/3", Observation(FRAME, FRAME.depth_mm, ("package/7",), 1)),
    "sighting": ("package/7", Sighting(1, POSE, 2, 3)),
    "region": ("place/3", np.zeros(VGA.shape, bool)),
    "surface": ("view/milk/4", Surface.free_form(POINTS_M, np.array([[0, 1, 2]]))),
    "viewpoint": ("view/milk/4", Viewpoint(FRAME.acquisition, 1)),
    "plan": ("place/3", Plan("milk", 1, POSE)),
    "empty": ("tray", FRAME),
}


@pytest.fixture(scope="module")
def declared():
    config = load_config(Path(application.__file__).with_name("cell.toml"), environment={})
    return {aspect.name: aspect.shows for aspect in config.aspects if aspect.shows.kinds}


def shown(declared, name):
    entity, value = DATA[name]
    aspects = [getattr(vocabulary, each) for each in vars(vocabulary) if each.isupper()]
    datum_type = next(a.datum_type for a in aspects if getattr(a, "name", "") == name)
    version = Recorded(
        Slot("online", entity, name), 1, 1, "left", 1, encode_datum(value, datum_type)
    )
    return pictures_of(version, declared[name])


def test_every_declaration_fits_its_data(declared):
    """None is said of an aspect that does not look so."""
    assert sorted(declared) == sorted(DATA)
    for name in declared:
        assert shown(declared, name).unfit == [], name


def test_frames_form_the_tree_of_the_vocabulary(declared):
    """Views hang on their product, places and packages on the tray."""
    found = {name: [one.message for one in shown(declared, name).pictures] for name in declared}
    transform = found["viewpoint"][0]
    assert (transform.parent_frame_id, transform.child_frame_id) == ("product/milk", "view/milk/4")
    assert transform.translation.z == 0.3
    image, camera, transform = found["observation"]
    assert {image.frame_id, camera.frame_id, transform.child_frame_id} == {"place/3/camera"}
    assert transform.parent_frame_id == "tray"
    assert found["cloud"][0].frame_id == found["plan"][0].frame_id == "tray"
    assert found["surface"][0].entities[0].frame_id == "view/milk/4"


def test_depth_is_millimetres(declared):
    """As Foxglove and Rerun read 16UC1."""
    image = shown(declared, "observation").pictures[0].message
    assert (image.encoding, image.width, image.height) == ("16UC1", 640, 480)
    assert set(np.frombuffer(image.data, "<u2")) == {700}
