"""Threads of the view that stand back behind the cell."""

import os
import sys
import threading

import pytest

from enact_dist.view.follower import NICER, stand_back


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has a priority for each thread")
def test_a_thread_stands_back_once_however_often_it_is_asked():
    """The thread of the server is asked for each browser that connects; one made by it, too."""
    found = []

    def note():
        found.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))

    def made_by_it():
        stand_back("view test")
        note()

    def often():
        for _ in range(3):
            stand_back("view test")
            note()
        inner = threading.Thread(target=made_by_it)
        inner.start()
        inner.join()

    before = os.getpriority(os.PRIO_PROCESS, os.getpid())
    outer = threading.Thread(target=often)
    outer.start()
    outer.join()

    assert found == [before + NICER] * 4
    assert os.getpriority(os.PRIO_PROCESS, os.getpid()) == before
