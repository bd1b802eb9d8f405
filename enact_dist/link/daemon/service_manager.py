"""Reports this process's state to a service manager such as systemd: `sd_notify` datagrams.

=============  ==================================================================================
message        sent
=============  ==================================================================================
READY=1        once, when the process is ready
STATUS=…       whenever its text has changed
WATCHDOG=1     from the thread that it vouches for, three times per WatchdogSec: a hung dispatcher
               sends none, so the manager kills and restarts it
STOPPING=1     when the process was asked to end
=============  ==================================================================================

Without NOTIFY_SOCKET nothing happens.  The variables are removed from the environment, so that no
child sends in this process's name.  An absent manager causes neither errors nor delays.
"""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import MutableMapping
from typing import Final

SEND_S: Final = 1.0
"""How long a message about a change may wait for a manager that is slow to read."""
PINGS_PER_PERIOD: Final = 3

_log = logging.getLogger("enact.link")


class ServiceManager:
    """The service manager of this process.  `alive` is for one thread, the rest for any.

    Args:
        environment: Contains NOTIFY_SOCKET, WATCHDOG_USEC and WATCHDOG_PID, which are removed.

    Attributes:
        ping_s: How often `alive` pings, seconds; 0 without a watchdog.
    """

    def __init__(self, environment: MutableMapping[str, str] | None = None) -> None:
        environment = os.environ if environment is None else environment
        path = environment.pop("NOTIFY_SOCKET", "")
        self._address = f"\0{path[1:]}" if path.startswith("@") else path
        period = environment.pop("WATCHDOG_USEC", "")
        mine = environment.pop("WATCHDOG_PID", "") in {"", str(os.getpid())}
        asked = self._address and mine and period.isdecimal()
        self.ping_s = int(period) / 1e6 / PINGS_PER_PERIOD if asked else 0.0
        self._ping_at_s = 0.0
        self._status = ""
        self._failed = False

    def ready(self, status: str = "") -> None:
        """Report that this process is ready."""
        if self._send(f"READY=1\n{_status_line(status)}MAINPID={os.getpid()}"):
            self._status = status

    def stopping(self) -> None:
        """Report that this process was asked to end."""
        self._send("STOPPING=1\n")

    def alive(self, status: str = "") -> None:
        """Ping for the calling thread, and send a changed status.

        May be called at any rate: pings are sent only as often as needed.  Never blocks; what the
        manager cannot take now is sent with the next call.
        """
        if not self._address:
            return
        line = _status_line(status) if status != self._status else ""
        now_s = time.monotonic()
        pings = bool(self.ping_s) and now_s >= self._ping_at_s
        if pings:
            line += "WATCHDOG=1"
        if line and self._send(line, wait_s=0.0):
            self._status = status
            if pings:
                self._ping_at_s = now_s + self.ping_s

    def _send(self, text: str, *, wait_s: float = SEND_S) -> bool:
        """Send a message; return whether the manager got it."""
        if not self._address:
            return False
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
                line.settimeout(wait_s)
                line.sendto(text.encode(), self._address)
        except OSError as error:  # too long a path, no receiver, a full queue
            if not self._failed:
                self._failed = True
                where = self._address.replace("\0", "@", 1)
                _log.warning("the service manager at %s does not answer: %s", where, error)
            return False
        self._failed = False
        return True


def _status_line(status: str) -> str:
    return f"STATUS={' '.join(status.split())}\n" if status else ""
