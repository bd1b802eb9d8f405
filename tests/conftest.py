"""Rules for all tests: nothing skipped in CI, Ctrl-C as at a terminal, no lock left behind.

Which cases of long tests (`sampled`) and which tests of applications and tools a run takes.

And over which carrier each of them runs, see `carriers.py` beside this file.
"""

import math
import os
import signal
import sys
from collections import Counter, defaultdict
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from enact_dist.access import lock

sys.path.insert(0, str(Path(__file__).parent))
import carriers
import ports

HALVED = [
    Path(__file__).parent / name for name in ("actors", "bench", "cli", "recording", "verify")
]
"""Of the tests of applications and tools each run takes half of the files of a folder.

Of the files with other slow tests it takes the slow ones of every second.
"""

# How long an example takes says more about the machine than about what is tested.
settings.register_profile("load", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("load")


def pytest_configure(config):
    """Take SIGINT as a program at a terminal does: in the background a shell has it ignored."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        carriers.choice()
    except ValueError as error:
        raise pytest.UsageError(str(error)) from None


def pytest_generate_tests(metafunc):
    """Run over both carriers what has to."""
    ways = carriers.ways(metafunc.definition)
    if len(ways) > 1:
        metafunc.parametrize("carrier", ways, indirect=True)


def pytest_collection_modifyitems(config, items):
    """Leave out what a run does not take of long tests that are much alike, drawn by its seed.

    `ENACT_TEST_ALL=1` takes all.  A case that is named alone on the command line always runs.
    """
    if os.environ.get("ENACT_TEST_ALL") == "1":
        return
    groups = defaultdict(lambda: defaultdict(list))
    for item in items:
        mark = item.get_closest_marker("sampled")
        if mark is None and any(folder in item.path.parents for folder in HALVED):
            groups[item.path.parent, 1 / 2][item.path.name].append(item)
        elif mark is None and item.get_closest_marker("slow"):
            groups["slow", 1 / 2][str(item.path)].append(item)
        elif mark is not None:
            of, case = mark.kwargs.get("of", "test"), item.nodeid
            if of == "test":
                of = f"{item.path}::{item.originalname}"
            elif of == "file":
                of = str(item.path)
            else:  # some of several files, whole
                case = str(item.path)
            groups[of, mark.args[0]][case].append(item)
    left_out = set()
    for (_, count), cases in groups.items():
        taken = count if count >= 1 else math.ceil(count * len(cases))
        for case in sorted(cases, key=carriers.rank)[taken:]:
            left_out.update(cases[case])
    if left_out:
        config.hook.pytest_deselected(items=[item for item in items if item in left_out])
        items[:] = [item for item in items if item not in left_out]


@pytest.fixture(autouse=True)
def carrier(request, monkeypatch):
    """How this test and the processes that it starts talk to shards, see `carriers.py`."""
    way = getattr(request, "param", None) or carriers.ways(request.node)[0]
    if way in carriers.BOTH:
        monkeypatch.setenv("ENACT_CARRIER", way)
    else:  # what a cell.toml says holds
        monkeypatch.delenv("ENACT_CARRIER", raising=False)
    for name, value in carriers.switches(request.node).items():
        monkeypatch.setenv(name, value)
    request.node.user_properties.append(("carrier", way))
    return way


def pytest_terminal_summary(terminalreporter):
    """Say what ran over what, and how to have it again."""
    reports = [*terminalreporter.getreports("passed"), *terminalreporter.getreports("failed")]
    drawn = Counter(dict(report.user_properties).get("carrier") for report in reports)
    told = ", ".join(f"{drawn[way]} over {way}" for way in carriers.BOTH)
    again = f"{carriers.VARIABLE}={carriers.choice()}"
    if any(drawn[way] for way in carriers.BOTH):
        terminalreporter.line(f"carriers: {told}; again with {again}")


@pytest.fixture(autouse=True)
def no_lock_left_behind():
    """Let a test that failed inside a lock fail alone, not with all that follow."""
    yield
    lock._thread.lock = None


@pytest.fixture(autouse=True)
def _ports_are_given_back():
    """Keep the ports of a test's daemons for them until the test is over."""
    yield
    ports.give_back()


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item, call):
    """Turn a skip into a failure where CI is set: there, every environment has to be present."""
    outcome = yield
    report = outcome.get_result()
    if report.failed:
        way = dict(item.user_properties).get("carrier")
        again = f"{carriers.VARIABLE}={carriers.choice()}"
        report.sections.append(("Carrier", f"{way}; drawn again with {again}"))
    if report.skipped and os.environ.get("CI") and not hasattr(report, "wasxfail"):
        report.outcome = "failed"
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
        report.longrepr = f"skipped, which CI does not allow: {reason}"
