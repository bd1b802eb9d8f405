"""What a service manager is told, over a real socket: ready, alive, status, stopping."""

import os
import socket
import threading

import pytest

from enact_dist.link.daemon.service_manager import ServiceManager


@pytest.fixture(params=["path", "abstract"])
def manager(request, tmp_path):
    """A manager's socket and what its address is in the environment."""
    path = f"@enact-test-{os.getpid()}" if request.param == "abstract" else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as heard:
        heard.bind(path.replace("@", "\0", 1))
        heard.settimeout(30.0)
        yield heard, path


def told(heard):
    """Return everything that lies in the socket, without waiting."""
    heard.settimeout(0.0)
    lines = []
    while True:
        try:
            lines += heard.recv(4096).decode().splitlines()
        except BlockingIOError:
            heard.settimeout(30.0)
            return lines


def test_ready_status_and_stopping_are_told_once(manager):
    """The variables are gone then: a child must not speak for its parent."""
    heard, path = manager
    environment = {"NOTIFY_SOCKET": path, "WATCHDOG_USEC": "3000000", "HOME": "/"}
    mine = ServiceManager(environment)
    mine.ready("open")
    mine.stopping()

    assert told(heard) == ["READY=1", "STATUS=open", f"MAINPID={os.getpid()}", "STOPPING=1"]
    assert environment == {"HOME": "/"}


def test_pings_are_as_rare_as_they_may_be_and_a_status_is_told_when_it_changes(manager):
    """`alive` comes ten times a second; the manager hears of a third of its period."""
    heard, path = manager
    mine = ServiceManager({"NOTIFY_SOCKET": path, "WATCHDOG_USEC": "60000000"})
    for status in ("open", "open", "drains", "drains"):
        mine.alive(status)

    assert mine.ping_s == 20.0
    assert told(heard) == ["STATUS=open", "WATCHDOG=1", "STATUS=drains"]


def test_no_pings_for_the_watchdog_of_another_process(manager):
    """A wrapper's watchdog is the wrapper's business."""
    heard, path = manager
    other = {"NOTIFY_SOCKET": path, "WATCHDOG_USEC": "1", "WATCHDOG_PID": str(os.getpid() + 1)}
    ServiceManager(other).alive()

    assert told(heard) == []


def test_nothing_is_done_where_nobody_asked():
    """Without NOTIFY_SOCKET a watchdog's period means nothing."""
    mine = ServiceManager({"WATCHDOG_USEC": "1000"})
    mine.ready()
    mine.alive("open")

    assert mine.ping_s == 0.0


def test_a_manager_that_is_away_is_named_once(tmp_path, caplog):
    """A daemon serves though nobody hears that it does."""
    mine = ServiceManager({"NOTIFY_SOCKET": str(tmp_path / "gone"), "WATCHDOG_USEC": "1"})
    mine.ready()
    mine.alive("open")

    (record,) = caplog.records
    assert f"the service manager at {tmp_path / 'gone'} does not answer" in record.message


def test_a_full_queue_never_delays_a_ping(manager):
    """A manager that does not read costs no time of the dispatcher's."""
    heard, path = manager
    mine = ServiceManager({"NOTIFY_SOCKET": path, "WATCHDOG_USEC": "1"})
    pinging = threading.Thread(target=lambda: [mine.alive(str(n)) for n in range(2000)])
    pinging.start()
    pinging.join(60)

    assert not pinging.is_alive()
    assert len(told(heard)) < 4000


def test_what_a_full_queue_had_no_room_for_is_sent_with_the_next_call(manager):
    """Else a manager that was slow once kills a process that lives."""
    heard, path = manager
    mine = ServiceManager({"NOTIFY_SOCKET": path, "WATCHDOG_USEC": "3600000000"})
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other:
        other.settimeout(0.0)
        with pytest.raises(BlockingIOError):
            while True:
                other.sendto(b"noise", path.replace("@", "\0", 1))
        mine.alive("open")
        assert set(told(heard)) == {"noise"}

    mine.alive("open")
    mine.alive("open")

    assert told(heard) == ["STATUS=open", "WATCHDOG=1"]


def test_a_hung_dispatcher_is_not_pinged_for(manager, daemon, endpoint):
    """Whoever holds the shard's mutex for ever stops the pings; when it goes on, so do they."""
    heard, path = manager
    mine = ServiceManager({"NOTIFY_SOCKET": path, "WATCHDOG_USEC": "30000"})  # each tick pings
    host = daemon(endpoint).host
    host.each_tick(lambda: mine.alive(host.state))
    assert "WATCHDOG=1" in heard.recv(4096).decode()

    with host._mutex:
        timer_is_at_the_mutex = threading.Event()
        host.add_inbox(timer_is_at_the_mutex.set)  # called before each tick
        assert timer_is_at_the_mutex.wait(30)
        told(heard)
        heard.settimeout(0.5)  # five ticks
        with pytest.raises(TimeoutError):
            heard.recv(4096)
    heard.settimeout(30.0)

    assert heard.recv(4096) == b"WATCHDOG=1"
