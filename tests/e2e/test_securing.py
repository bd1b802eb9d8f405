"""A running cell of two hosts gets keys, then rights, one host after the other."""

import itertools
import shutil
import signal
import threading
import time

import pytest

pytest.importorskip("cryptography", reason="making keys needs the extra 'keys'")

from polling import until
from ports import free_port

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.cli.main import main
from enact_dist.errors import EnactError, PermissionDeniedError

pytestmark = [pytest.mark.slow, pytest.mark.carrier("zenoh")]

TTL_S = 2.0
COUNT = Aspect("count", int)
HOSTS = {"left": "feeder", "right": "press"}
"""A shard for each host, and the actor that writes there all the time."""
RIGHTS = """
[rights]
default = "none"
[[rights.allow]]
who = "feeder"
write = "online:left/own/count"
[[rights.allow]]
who = "press"
write = "online:right/own/count"
[[rights.allow]]
who = "carrier"
write = "online:*/both/count"
"""


class Host:
    """A host: its own copy of cell.toml and of its keys, and its shard."""

    def __init__(self, folder, shard, make_process):
        self.folder, self.shard, self._make_process = folder / shard, shard, make_process
        self.folder.mkdir()
        self.file = self.folder / "cell.toml"
        self.process = None

    def start(self):
        words = ("-m", "enact_dist.cli.main", "shard", "run", self.shard, "--cell", self.file)
        self.process = self._make_process(*words)
        self.process.expect("ready:")

    def restart(self):
        """Stop the shard, start it on the present files; return how long it was away."""
        began_s = time.monotonic()
        self.stop()
        self.start()
        return time.monotonic() - began_s

    def stop(self):
        self.process.signal(signal.SIGTERM)
        self.process.finish()
        self.process.end()


class Updates:
    """Counts in a thread of its own and connects anew when told to; keeps what was acknowledged.

    Args:
        file: The cell.toml of its host.
        actor: Its name.
        entities: Where it counts, all in one commit.
    """

    def __init__(self, file, actor, *entities):
        self.file, self.actor, self.entities = file, actor, entities
        self.acknowledged, self.times, self.faults = 0, [], []
        self._anew, self._ended = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self):
        while not self._ended.is_set():
            self._anew.clear()
            try:
                with connect(self.file, actor=self.actor, request_timeout_s=1.0) as cell:
                    world = cell.world("online")
                    writes = [Write(world, Entity(one), COUNT) for one in self.entities]
                    while not (self._ended.is_set() or self._anew.is_set()):
                        self._update(writes)
            except EnactError:
                self._ended.wait(0.05)

    def _update(self, writes):
        try:
            with Lock(*writes, wait_s=1.0) as lock:
                there = [lock[write] for write in writes]
                if len(set(there)) > 1 or there[0] < self.acknowledged:
                    self.faults.append((there, self.acknowledged))
                for write in writes:
                    lock[write] = there[0] + 1
        except EnactError:
            return
        self.acknowledged = there[0] + 1
        self.times.append(time.monotonic())

    def connect_anew(self):
        """Read cell.toml again, as a restart of the program does."""
        self._anew.set()

    def go_on(self):
        """Return once there are further updates."""
        enough = len(self.times) + 3
        stopped = lambda: f"{self.actor} has stopped at {self.acknowledged}"  # noqa: E731
        until(lambda: len(self.times) >= enough, limit_s=60.0, missed=stopped)

    def longest_s(self, since):
        """Return the longest time between two updates after the first `since`."""
        times = self.times[max(0, since - 1) :]
        return max(b - a for a, b in itertools.pairwise(times))

    def end(self):
        self._ended.set()
        self._thread.join()


def cell_file(ports, scheme="tcp", security="", rights=""):
    """Return the text of cell.toml."""
    lines = ['name = "line"', 'worlds = ["online"]', f"session_ttl_s = {TTL_S}"]
    lines += ['data_folder = "data"', 'carrier = "zenoh"', security]
    for name, port in ports.items():
        lines += [f"[shards.{name}]", f'listen = "{scheme}/127.0.0.1:{port}"']
        lines += ["[[pins]]", f'entities = "{name}/*"', f'shard = "{name}"']
    lines += [f'[actors.{one}]\nclass = "line:{one}"' for one in (*HOSTS.values(), "carrier")]
    return "\n".join(lines) + rights


def make_keys(office, text, hosts, monkeypatch):
    """Make all keys in one place, and copy to each host those of the names that run there."""
    office.mkdir()
    (office / "cell.toml").write_text(text)
    monkeypatch.chdir(office)
    for verb in ("init", "make"):
        assert main(["cell", "keys", verb]) == 0
    for name, host in hosts.items():
        (host.folder / "keys").mkdir(mode=0o700)
        names = (f"shard.{name}", HOSTS[name], *(("carrier",) if name == "left" else ()))
        for file in ("ca.pem", *(f"{one}.{end}" for one in names for end in ("crt", "key"))):
            shutil.copy2(office / "keys" / file, host.folder / "keys" / file)


def test_a_running_cell_gets_keys_and_rights_host_after_host(tmp_path, monkeypatch, make_process):
    """No acknowledged update is lost; each host's interruption is its restart and a lease."""
    ports = {name: free_port() for name in HOSTS}
    hosts = {name: Host(tmp_path, name, make_process) for name in HOSTS}
    security = '[security]\nkeys = "keys"\noperators = ["ada"]'
    updates = {}
    try:
        for host in hosts.values():
            host.file.write_text(cell_file(ports))
        for host in hosts.values():
            host.start()
        with connect(hosts["left"].file, actor="ada") as cell:
            for name in ("left/own", "right/own", "left/both", "right/both"):
                write = Write(cell.world("online"), Entity(name), COUNT)
                with Lock(write) as lock:
                    lock[write] = 0
        for name, actor in HOSTS.items():
            updates[name] = Updates(hosts[name].file, actor, f"{name}/own")
        updates["both"] = Updates(hosts["left"].file, "carrier", "left/both", "right/both")
        for one in updates.values():
            one.go_on()

        make_keys(tmp_path / "office", cell_file(ports, "tls", security), hosts, monkeypatch)
        for step, text, anew in (
            ("keys", cell_file(ports, "tls", security), True),
            ("rights", cell_file(ports, "tls", security, RIGHTS), False),
        ):
            begun = len(updates["both"].times)
            for name, host in hosts.items():
                since = {one: len(updates[one].times) for one in updates}
                host.file.write_text(text)
                if anew:
                    updates[name].connect_anew()
                    if name == "left":
                        updates["both"].connect_anew()
                away_s = host.restart()
                for one in HOSTS:
                    updates[one].go_on()
                own_s = updates[name].longest_s(since[name])
                others = [updates[one].longest_s(since[one]) for one in HOSTS if one != name]
                print(
                    f"{step} on {name}: shard away {away_s:.2f} s, its updates {own_s:.2f} s,"
                    f" those of the other host {others[0]:.2f} s"
                )
                assert own_s < away_s + 2 * TTL_S
                assert others[0] < 2 * TTL_S
            updates["both"].go_on()
            print(f"{step}: commits over both shards {updates['both'].longest_s(begun):.2f} s")

        with connect(hosts["right"].file, actor="press") as press:
            barred = Write(press.world("online"), Entity("left/own"), COUNT)
            with pytest.raises(PermissionDeniedError, match="press"), Lock(barred) as lock:
                lock[barred] = 0
    finally:
        for one in updates.values():
            one.end()
        for host in hosts.values():
            if host.process is not None:
                host.process.end()
    for one in updates.values():
        assert one.faults == []
        assert one.acknowledged > 20
