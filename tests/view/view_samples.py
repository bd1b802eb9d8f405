"""Data for the tests of the view: versions without a cell, and what they write into one."""

import numpy as np

from enact_dist import Aspect, Entity, Lock, Retention, Write
from enact_dist.config.shows import Shows
from enact_dist.core.protocol.datum import Slot
from enact_dist.recording.exact import Recorded
from enact_dist.view.drawing.scene import shown_of
from enact_dist.wire.payload import encode_datum

SECOND_NS = 1_000_000_000
BEGIN_NS = 1_700_000_000 * SECOND_NS

POSE = Aspect("pose", np.ndarray, retention=Retention(versions=3))
SPEED = Aspect("speed", float)
ARM = Entity("arm")
SLOT, SPEED_SLOT = Slot("online", "arm", "pose"), Slot("online", "arm", "speed")
SHOWS = {"pose": Shows(("pose",), frame="cell")}


def moved(x_m):
    matrix = np.eye(4)
    matrix[0, 3] = x_m
    return matrix


def move(cell, x_m, world="online"):
    pose = Write(cell.world(world), ARM, POSE)
    with Lock(pose) as lock:
        lock[pose] = moved(x_m)
    return lock.position


def slot(entity, aspect="x", world="online"):
    return Slot(world, entity, aspect)


def shown(value, *kinds, entity="thing", aspect="x", version=1, **options):
    """Return one version of a datum as the scene takes it."""
    stamp_ns = BEGIN_NS + version * SECOND_NS
    datum = encode_datum(value, type(value))
    recorded = Recorded(slot(entity, aspect), version, stamp_ns, "left", 1, datum)
    return shown_of(recorded, Shows(kinds, **options))
