"""Lets the tests of this folder share their samples; a cell in this process."""

import sys
from pathlib import Path

import pytest

from enact_dist import local

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def cell():
    with local(worlds=["online", "training"]) as opened:
        yield opened


@pytest.fixture
def online(cell):
    return cell.world("online")
