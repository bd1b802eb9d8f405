"""Priority of a process that controls something: before what computes beside it on one host."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

NICE: Final = -10
SWITCH_S: Final = 0.0002
"""After this long one Python thread makes way for another; with Python's 5 ms a loop of 4 ms would
miss its time whenever another thread of its process is busy."""


def make_urgent() -> None:
    """Let all threads of this process go before others, where the system allows it.

    It does for root and with CAP_SYS_NICE; otherwise the process goes on as it is, and what its
    loop's periods are says whether that was enough.
    """
    sys.setswitchinterval(SWITCH_S)
    threads = Path("/proc/self/task")
    numbers = [int(one.name) for one in threads.iterdir()] if threads.exists() else [0]
    for number in numbers:
        with suppress(OSError):  # not allowed, or the thread has ended
            os.setpriority(os.PRIO_PROCESS, number, NICE)
