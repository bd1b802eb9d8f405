"""The samples beside these tests, and a cell of a robot arm."""

import sys
from pathlib import Path

import pytest

from enact_dist import local

sys.path.insert(0, str(Path(__file__).parent))
from view_samples import ARM, POSE, SPEED, moved


@pytest.fixture
def cell():
    with local(worlds=["online", "truth"], actor="writer") as cell:
        online = cell.world("online")
        online.init(ARM, SPEED, 0.5)
        online.init(ARM, POSE, moved(0.0))
        yield cell
