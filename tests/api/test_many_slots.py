"""What one lock may hold and write at most: said where it is asked for, and kept by a pattern too."""

import pytest

from enact_dist import Aspect, Entities, Entity, Lock, View, Write, WriteEach
from enact_dist.errors import MisuseError
from enact_dist.wire.limits import ITEMS_MAX

pytestmark = pytest.mark.carrier("local", "drawn")
COUNT = Aspect("count", int)
MANY = [Entity(f"tray/{number}") for number in range(ITEMS_MAX + 1)]


def test_lock_and_view_of_too_many_requests_name_what_has_no_such_limit(online):
    """A pattern is one request; that it writes no more is said, too."""
    with pytest.raises(MisuseError, match="shows all matching data, but one lock writes at most"):
        Lock(*(Write(online, entity, COUNT) for entity in MANY))
    with pytest.raises(
        MisuseError, match="A ViewEach counts as one request and shows all matching data"
    ):
        online.view(*(View(online, entity, COUNT) for entity in MANY))


def test_pattern_writes_as_many_data_as_a_lock_has_requests(online):
    """All of them at once; one more is refused, and the others are written all the same."""
    each = WriteEach(online, Entities("tray/*"), COUNT)
    with Lock(each) as lock:
        for entity in MANY[:-1]:
            lock[each][entity] = 1
        with pytest.raises(
            MisuseError, match="at most 4096 data, including those of patterns; use several"
        ):
            lock[each][MANY[-1]] = 1

    with Lock(each) as lock:
        assert len(lock[each]) == ITEMS_MAX
