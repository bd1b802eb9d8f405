"""Pages of a start that was killed: clients that have mapped them find no grant there any more."""

from __future__ import annotations

import os

import pytest

from enact_dist.core.protocol.messages import PLACES, PROVE
from enact_dist.link.memory.shared_folder import SharedFolder, open_shared
from enact_dist.link.memory.use_marks import ClientPage, ShardMarks

SESSION, NUMBER = "5e55", 7


@pytest.fixture
def killed(tmp_path):
    """The folder of a start that was killed, with the page of a client that lives."""
    folder = SharedFolder("cell", "s0", root=tmp_path)
    marks = ShardMarks(folder)
    assert marks.keep(SESSION, NUMBER) == PROVE
    opened = open_shared(folder.name, folder.nonce, root=tmp_path)
    page = ClientPage(opened.descriptor, opened.owner, SESSION)
    place = marks.keep(SESSION, NUMBER) - PLACES
    assert place >= 0
    yield folder, page, place
    opened.close()


def test_start_clears_the_cells_of_the_one_before(tmp_path, killed):
    """What was volatile is lost by then; nothing of before may be read under its grants."""
    folder, page, place = killed
    assert page.lives(place, NUMBER)
    os.close(folder.descriptor)  # as the kernel does

    assert page.lives(place, NUMBER)
    after = SharedFolder("cell", "s0", root=tmp_path)

    assert not page.lives(place, NUMBER)
    assert not folder.path.exists()
    after.close()


def test_cells_of_a_shard_that_runs_stay(tmp_path, killed):
    """Another shard that starts beside it has nothing to say."""
    folder, page, place = killed

    SharedFolder("cell", "s1", root=tmp_path).close()

    assert page.lives(place, NUMBER)
    folder.close()
