"""A cell inside the test's own process, with two world contexts."""

import pytest

from enact_dist import local


@pytest.fixture
def cell():
    with local(worlds=["online", "training"]) as opened:
        yield opened


@pytest.fixture
def online(cell):
    return cell.world("online")
