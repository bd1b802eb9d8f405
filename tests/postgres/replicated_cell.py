"""A cell of one shard in a database, with two daemons and clients that count."""

import threading
import time

from polling import until
from ports import free_endpoint

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.config.environment import without_overrides
from enact_dist.errors import CommitUnknownError, EnactError
from enact_dist.link.log import READY
from enact_dist.verify.daemons import LineProcess

SHARD = "left"
COUNT = Aspect("count", int)


class ReplicatedCell:
    """Two places at which a daemon of the shard may run.

    Attributes:
        file: Its cell.toml.
        places: The endpoints of the two.
    """

    def __init__(self, folder, url, environment, *, lease_s=2.0, name="replicated"):
        self.folder = folder
        self.url = url
        self.places = (free_endpoint(), free_endpoint())
        self.daemons = []
        self._environment = without_overrides(environment)
        self.file = folder / "cell.toml"
        both = ", ".join(f'"{place}"' for place in self.places)
        first = self.places[0]
        self.file.write_text(
            f'name = "{name}"\nworlds = ["online"]\nstore = "{url}"\nlease_s = {lease_s}\n'
            f'[shards.{SHARD}]\nlisten = "{first}"\nadvertise = [{both}]\n'
        )

    def log(self, place):
        return self.folder / f"{self.places[place].rpartition(':')[2]}.log"

    def start(self, place, *, store="", says=READY):
        """Start a daemon; return once it serves, or stands by."""
        words = ["shard", "run", SHARD, "--cell", str(self.file), "--listen", self.places[place]]
        words += ["--standby", *(["--store", store] if store else [])]
        daemon = LineProcess(
            "enact_dist.cli.main", words, self.log(place), environment=self._environment
        )
        self.daemons.append(daemon)
        daemon.expect(says)
        return daemon

    def end(self):
        for daemon in self.daemons:
            daemon.end()


class Counting:
    """A client that adds one to its slot for ever, and notes what became of it.

    Attributes:
        done_s: When each update was acknowledged.
        errors: What was raised.
        values: What each lock read.
    """

    def __init__(self, file, number):
        self.done_s = []
        self.errors = []
        self.values = []
        self.unknown = 0
        self.last = 0
        self._file, self._number = file, number
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"counting {number}")
        self._thread.start()

    def _run(self):
        with connect(self._file, actor=f"counting{self._number}", timeout_s=20.0) as cell:
            entity, world = Entity(f"counter/{self._number}"), cell.world("online")
            write = Write(world, entity, COUNT)
            world.init(entity, COUNT, 0)
            while not self._ends.is_set():
                try:
                    with Lock(write, wait_s=30.0) as lock:
                        value = lock[write]
                        lock[write] = value + 1
                except CommitUnknownError as error:
                    self.unknown += 1
                    self.errors.append(error)
                except EnactError as error:
                    self.errors.append(error)
                else:
                    self.values.append(value)
                    self.done_s.append(time.monotonic())
            with Lock(write, wait_s=30.0) as lock:
                self.last = lock[write]

    def await_after(self, moment_s, timeout_s=20.0):
        """Return how long after a moment the next update was acknowledged."""
        later = until(
            lambda: [done_s for done_s in self.done_s[-200:] if done_s > moment_s],
            limit_s=timeout_s,
            missed=lambda: f"no update for {timeout_s} s: {self.errors[-3:]}",
        )
        return later[0] - moment_s

    def next_update(self, timeout_s):
        """Return after how long the next update was acknowledged, but for the one under way."""
        asked_s = time.monotonic()
        first_s = self.await_after(asked_s, timeout_s)
        return first_s + self.await_after(asked_s + first_s, timeout_s)

    def stop(self):
        """End without a look at what was counted."""
        self._ends.set()

    def end(self):
        """End, and check: each acknowledged update counts once, and no other but unknown ones."""
        self._ends.set()
        self._thread.join(40)
        assert not self._thread.is_alive()
        assert self.values == sorted(set(self.values)), "a value was read twice"
        assert len(self.values) <= self.last <= len(self.values) + self.unknown
