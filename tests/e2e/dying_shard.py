"""`enact shard run …` that stops itself at one step of a commit over shards.

`dying_shard.py ARGUMENT…` takes what the command line `enact` takes and runs the real daemon.  A
line ``arm STEP`` on standard input arms it; at that step it says ``reached STEP`` and sends itself
SIGSTOP, so that nothing of it goes on before its parent has killed it, or lets it continue by
SIGCONT and a line ``go on``.  (The signal may take effect some steps later in the thread that sent
it; that one waits for the line.)  Each arming is for one time.

==================  ==========================================================================
all-prepared        the deciding commit has come, with every participant prepared; its record is
                    not in the store yet
decided             that record is durable; nobody was told
answered            that record is durable, the client's answer is sent, no participant was told
prepared            a participant's writes are durable; nobody was told
finishing           a participant was told that it is committed, and has not stored that yet
==================  ==========================================================================
"""

import os
import signal
import sys
import threading

from enact_dist.cli.main import main
from enact_dist.core.protocol.messages import Finish
from enact_dist.core.protocol.records import DecisionRecord, PreparedEnded, PreparedRecord
from enact_dist.link.daemon.shard_calls import ShardCalls
from enact_dist.link.store.store import Store

BEFORE_WRITE = {"all-prepared": DecisionRecord, "finishing": PreparedEnded}
AFTER_WRITE = {"decided": DecisionRecord, "prepared": PreparedRecord}


class Trap:
    """Stops this process at the step that it is armed for."""

    def __init__(self):
        self.step = ""
        self._go_on = threading.Event()
        self.decided = set()

    def follow(self, lines):
        for line in lines:
            word, what = line.split()
            if word == "arm":
                self._go_on.clear()
                self.decided.clear()
                self.step = what
                print("armed", what, flush=True)
            else:
                self._go_on.set()

    def look(self, table, batch):
        """Stop if the armed step of `table` is about a record that the batch waits for."""
        asked = table.get(self.step)
        waited_for = [one for persist in batch if persist.ticket for one in persist.records]
        self.decided.update(one.lock for one in waited_for if isinstance(one, DecisionRecord))
        if asked and any(isinstance(one, asked) for one in waited_for):
            self.spring()

    def spring(self):
        step, self.step = self.step, ""
        os.write(1, f"reached {step}\n".encode())
        os.kill(os.getpid(), signal.SIGSTOP)
        self._go_on.wait()


def set_trap():
    """Put the trap between the daemon and its store, and before its calls to other shards."""
    trap, write, submit = Trap(), Store.write, ShardCalls.submit

    def trapped_write(store, batch):
        trap.look(BEFORE_WRITE, batch)
        write(store, batch)
        trap.look(AFTER_WRITE, batch)

    def trapped_submit(calls, shard, request):
        # Not where an earlier decision is told once more.
        first = isinstance(request, Finish) and request.lock in trap.decided
        if first and trap.step == "answered":
            trap.spring()
        submit(calls, shard, request)

    Store.write, ShardCalls.submit = trapped_write, trapped_submit
    threading.Thread(target=trap.follow, args=(sys.stdin,), daemon=True).start()


if __name__ == "__main__":
    set_trap()
    sys.exit(main())
