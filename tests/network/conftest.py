"""One set of hosts for all tests of this folder."""

import sys
from itertools import permutations
from pathlib import Path

import pytest

HERE = Path(__file__).parent
sys.path.append(str(HERE))  # not first: other folders have a conftest, too

from network_site import SHARDS, Site  # noqa: E402 - found by the line above

from enact_dist.errors import LinkError  # noqa: E402
from enact_dist.verify.chaos.network.switch import Cable  # noqa: E402


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The cell with its hosts; skipped with the system's own words where there can be none."""
    try:
        made = Site(tmp_path_factory.mktemp("site"))
    except LinkError as error:
        pytest.skip(str(error))
    try:
        yield made.start()
    finally:
        made.close()


@pytest.fixture
def whole(site):
    """The cell, and afterwards a network without faults and a history without anomalies."""
    yield site
    site.heal(*permutations((*SHARDS, "near", "far"), 2))
    site.lay(Cable())
    site.check()
