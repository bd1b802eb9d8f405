"""A client that stops itself right before it sends a commit: `stopped_client.py CELL JOURNAL NAME`.

It writes one thing and journals that as a client of the chaos run does; `said` tells how it ended.
Without a name that begins with `stopped` it does the same without stopping.
"""

import os
import signal
import sys
from pathlib import Path

from enact_dist import Entity, Write, connect
from enact_dist.verify.chaos.journal import Journal
from enact_dist.verify.chaos.workload import ASPECTS, LockWorkload, PlannedLock


class StoppingJournal(Journal):
    """Stops its process once it has the line that comes before a commit is sent."""

    def write(self, *words):
        super().write(*words)
        if words[0] == "write":
            os.kill(os.getpid(), signal.SIGSTOP)


def main():
    file, journal, name = sys.argv[1:]
    kind = StoppingJournal if name.startswith("stopped") else Journal
    with connect(file, actor=name, timeout_s=30.0) as cell:
        work = LockWorkload(cell, kind(Path(journal)), name, seed=0, ttl_s=1.0)
        write = Write(cell.world("online"), Entity("thing/s0/0"), ASPECTS["kept"])
        told = work.take(PlannedLock("write one", [write], [write], wait_s=60.0))
    print("said", told.value, flush=True)


if __name__ == "__main__":
    main()
