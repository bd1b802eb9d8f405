"""Processes and their connections: left open, forked, killed."""

import pytest

from enact_dist.core.protocol.messages import ListSessions

LEFT_OPEN = """
import sys, threading
from enact_dist.core.protocol.messages import AwaitStamp, Hello
from enact_dist.link.zenoh.carrier import ZenohCarrier
carrier = ZenohCarrier("cell", "left-open", "tester", [sys.argv[1]], ttl_s=2.0)
feed = carrier.subscribe()
hello = Hello("left-open", 0, 2_000_000_000, "tester", "host", 1, True)
epoch = carrier.request("s0", hello, timeout_s=60).epoch
question = AwaitStamp(2**62, 600_000_000_000, "left-open", epoch)
forever = lambda: carrier.request("s0", question, timeout_s=600)
threading.Thread(target=forever, daemon=True).start()
threading.Thread(target=lambda: feed.get(None), daemon=True).start()
print("open", flush=True)
"""


def test_carrier_left_open_never_holds_up_the_end_of_the_interpreter(daemon, endpoint, program):
    """A process that forgets its carrier, calls and feeds ends at once and cleanly."""
    daemon(endpoint)
    process = program(LEFT_OPEN, endpoint)

    _, errors = process.communicate(timeout=180)

    assert process.returncode == 0, errors
    assert errors == ""


FORKED = """
import os, sys
from enact_dist.core.protocol.messages import ListLocks
from enact_dist.errors import MisuseError
from enact_dist.link.zenoh.carrier import ZenohCarrier
carrier = ZenohCarrier("cell", "parent", "tester", [sys.argv[1]], ttl_s=2.0)
child = os.fork()
if child == 0:
    try:
        carrier.request("s0", ListLocks(), timeout_s=1)
    except MisuseError as error:
        print("request:", error, flush=True)
    carrier.close()
    try:
        ZenohCarrier("cell", "child", "tester", [sys.argv[1]], ttl_s=2.0)
    except MisuseError as error:
        print("open:", error, flush=True)
    sys.exit(3)
status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
answer = carrier.request("s0", ListLocks(), timeout_s=30)
print("child", status, "parent", type(answer).__name__, flush=True)
carrier.close()
"""


def test_carrier_raises_in_a_forked_child_which_still_ends(daemon, endpoint, program):
    """A forked child is told to connect for itself, ends normally; the parent goes on."""
    daemon(endpoint)
    process = program(FORKED, endpoint)

    output, errors = process.communicate(timeout=180)

    assert "request: " in output, errors
    assert "was forked" in output
    assert "open: " in output
    assert "child 3 parent Locks" in output


FORKED_AFTER_CLOSE = """
import multiprocessing, os, sys
from enact_dist import connect
from enact_dist.errors import MisuseError

def child():
    try:
        connect(sys.argv[1], timeout_s=1.0)
    except MisuseError as error:
        print("child:", error, flush=True)

connect(sys.argv[1], timeout_s=30.0).close()
process = multiprocessing.get_context("fork").Process(target=child)
process.start()
process.join()
connect(sys.argv[1], timeout_s=30.0).close()
print("child", process.exitcode, "of", os.getpid(), flush=True)
"""


def test_connect_is_refused_in_a_forked_child_though_its_parent_has_closed(
    daemon, endpoint, program
):
    """The child says at once what to do, and the parent connects again."""
    daemon(endpoint)
    process = program(FORKED_AFTER_CLOSE, endpoint)

    output, errors = process.communicate(timeout=60)

    assert f"forked from process {process.pid}, which had connected" in output, errors
    assert "'spawn'" in output
    assert f"child 0 of {process.pid}" in output


KILLED = """
import sys
from enact_dist.core.protocol.messages import Hello
from enact_dist.link.zenoh.carrier import ZenohCarrier
carrier = ZenohCarrier("cell", "victim", "tester", [sys.argv[1]], ttl_s=240.0)
carrier.request("s0", Hello("victim", 0, 240_000_000_000, "victim", "h", 1, False), timeout_s=30)
print("open", flush=True)
sys.stdin.read()
"""


@pytest.mark.slow
def test_shard_sees_at_once_when_a_client_is_killed(daemon, carry, endpoint, program, until):
    """The token of a process killed with -9 vanishes by itself, long before its lease of 240 s."""
    daemon(endpoint)
    watcher = carry(endpoint)
    process = program(KILLED, endpoint)
    process.stdout.readline()

    def present():
        sessions = watcher.request("s0", ListSessions(), timeout_s=30).sessions
        return any(info.session == "victim" and info.token_present for info in sessions)

    until(present)
    process.kill()

    until(lambda: not present(), limit_s=60.0)
