"""A process that controls something goes before others, where the system allows it."""

import os
import sys
import threading

import pytest

from actors.palletizing.control import urgency
from actors.palletizing.control.urgency import NICE, SWITCH_S, make_urgent


@pytest.fixture
def asked(monkeypatch):
    """Record what the system is asked for; the test's own process stays as it is."""
    calls, interval_s = [], sys.getswitchinterval()
    monkeypatch.setattr(os, "setpriority", lambda *call: calls.append(call))
    yield calls
    sys.setswitchinterval(interval_s)


def test_all_threads_go_before_others(asked):
    """Linux has a priority for each thread, so each is asked for, the loop's included."""
    ended = threading.Event()
    thread = threading.Thread(target=ended.wait)
    thread.start()
    make_urgent()
    ended.set()
    thread.join()
    assert {(which, nice) for which, _, nice in asked} == {(os.PRIO_PROCESS, NICE)}
    assert {os.getpid(), thread.native_id} <= {number for _, number, _ in asked}
    assert sys.getswitchinterval() == pytest.approx(SWITCH_S)


def test_what_is_not_allowed_changes_nothing_else(asked, monkeypatch):
    """Without the right to it the process goes on, its threads make way for each other sooner."""

    def refuse(*_):
        asked.append("refused")
        raise PermissionError("not allowed")

    monkeypatch.setattr(urgency.os, "setpriority", refuse)
    make_urgent()
    assert asked
    assert sys.getswitchinterval() == pytest.approx(SWITCH_S)
