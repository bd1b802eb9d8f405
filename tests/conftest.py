"""Rules for all tests: nothing skipped in CI, Ctrl-C as at a terminal, no lock left behind."""

import os
import signal

import pytest

from enact_dist import lock


def pytest_configure():
    """Take SIGINT as a program at a terminal does: in the background a shell has it ignored."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def no_lock_left_behind():
    """Let a test that failed inside a lock fail alone, not with all that follow."""
    yield
    lock._thread.lock = None


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item, call):
    """Turn a skip into a failure where CI is set: there, every environment has to be present."""
    outcome = yield
    report = outcome.get_result()
    if report.skipped and os.environ.get("CI") and not hasattr(report, "wasxfail"):
        report.outcome = "failed"
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
        report.longrepr = f"skipped, which CI does not allow: {reason}"
