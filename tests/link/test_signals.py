"""Signals never meet a lock that their own thread holds."""

import os
import signal
import threading

from enact_dist.link.signals import StopSignals


def test_signal_sets_event_and_calls_act_once():
    """The first signal acts, later ones are counted."""
    acted = []
    done = threading.Event()
    with StopSignals() as signals:
        signals.call(lambda name: (acted.append(name), done.set()))
        os.kill(os.getpid(), signal.SIGTERM)
        assert signals.event.wait(5)
        assert done.wait(5)
        os.kill(os.getpid(), signal.SIGINT)
    assert acted == ["SIGTERM"]
    assert signals.count == 2


def test_signal_that_came_first_acts_when_act_is_known():
    """A signal before `call` is not lost."""
    acted = []
    with StopSignals() as signals:
        os.kill(os.getpid(), signal.SIGTERM)
        assert signals.event.wait(5)
        signals.call(acted.append)
    assert acted == ["SIGTERM"]


def test_signal_inside_a_wait_never_deadlocks():
    """A storm of signals between the steps of `Event.wait` leaves the main thread going.

    With `event.set()` inside the handler this hangs at once.
    """
    with StopSignals() as signals:
        storm = threading.Thread(
            target=lambda: [os.kill(os.getpid(), signal.SIGTERM) for _ in range(2000)]
        )
        storm.start()
        waits = 0
        while storm.is_alive() or not signals.event.is_set():
            signals.event.wait(0.0001)
            waits += 1
        storm.join()
    assert signals.count > 0
    assert waits > 0
