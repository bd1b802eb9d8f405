"""`lock.new` and forked children: what a child writes to its parent's arrays stays with it."""

import os
import threading

import numpy as np
import pytest

from enact_dist import Aspect, Durability, Entity, Lock, View, Write
from enact_dist.link.memory.maps import leftovers

CLOUD = Aspect("cloud", np.ndarray, Durability.VOLATILE)
CARRIERS = pytest.mark.carrier("local", "socket", "zenoh")
SIZES = pytest.mark.parametrize("size", [1000, 100_000, 9_000_000])
pytestmark = pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")


def change_in_a_child(array):
    """Let a forked child see ones and write to them; return its status."""
    child = os.fork()
    if not child:
        status = 3
        try:
            status = 0 if (array == 1).all() else 1
            array[:] = 99
            status = status or (0 if (array == 99).all() else 2)
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


@CARRIERS
@SIZES
def test_child_of_a_block_changes_nothing_that_its_parent_commits(online, size):
    """It was forked after `new`, and has the array as its own from then on."""
    write, view = (kind(online, Entity("work_piece"), CLOUD) for kind in (Write, View))
    with Lock(write) as lock:
        cloud = lock.new(write, (size,), np.uint8)
        cloud[:] = 1
        assert change_in_a_child(cloud) == 0
        assert (cloud == 1).all()
        cloud[0] = 2

    with Lock(view) as lock:
        assert lock[view][:3].tolist() == [2, 1, 1]
        assert (lock[view][1:] == 1).all()


@CARRIERS
@SIZES
def test_child_that_is_forked_as_an_array_is_cut_off_changes_no_version(online, size):
    """The commit stands, and who cuts the array off in the parent has not come to it."""
    write, view = (kind(online, Entity("work_piece"), CLOUD) for kind in (Write, View))
    go_on = threading.Event()
    leftovers().start()
    leftovers().later(go_on.wait, 60.0)
    try:
        with Lock(write) as lock:
            cloud = lock.new(write, (size,), np.uint8)
            cloud[:] = 1
            kept = cloud[:]
        assert change_in_a_child(kept) == 0
    finally:
        go_on.set()

    assert leftovers().wait(30.0)
    with Lock(view) as lock:
        assert (lock[view] == 1).all()
    assert (cloud == 1).all()
