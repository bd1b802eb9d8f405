"""The hosts of a cell under test: Linux namespaces on a switch of our own, or else the loopback.

::

    s0 ──┐            one host per shard, per group of clients and for the watcher, each with an
    s1 ──┤            address of 198.18.77.0/24, a name, a /dev/shm, a monotonic clock and a boot
    g0 ──┼── switch   id of its own; files and processes they share.  A cut from A to B drops
    g1 ──┘            all that A sends to B, silently.

Each namespace lives as long as a child that waits for the end of its standard input: when this
process ends, however it ends, all of them are gone.  Without root they stand in a user namespace.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import uuid
from collections.abc import Sequence
from dataclasses import astuple
from pathlib import Path
from typing import Final, Protocol

from enact_dist.errors import LinkError
from enact_dist.verify.chaos.network import switch
from enact_dist.verify.chaos.network.switch import Cable, Counts
from enact_dist.verify.daemons import KeptPorts, LineProcess

CLOCK_AHEAD_S: Final = 100_000
"""By how much each host's monotonic clock is ahead of the one before."""
COMMAND_S: Final = 60.0
_PORT: Final = 7447
_DIE_WITH_PARENT: Final = ("setpriv", "--pdeathsig", "KILL")
_MAKE_HOST: Final = """
hostname "$1" && mount -t tmpfs -o size=1g tmpfs /dev/shm && echo "$2" >/dev/shm/boot &&
mount --bind /dev/shm/boot /proc/sys/kernel/random/boot_id && rm /dev/shm/boot &&
echo $$ && exec cat >/dev/null
"""


class Hosts(Protocol):
    """Where the processes of a cell run.

    Attributes:
        missing: What cannot be done here, with the reason.
        clock_ahead_ns: By how much the monotonic clock of a host is ahead of this process's.
    """

    missing: tuple[str, ...]
    clock_ahead_ns: dict[str, int]

    def before(self, host: str) -> tuple[str, ...]:
        """Return the command that runs what follows it on a host."""

    def endpoint(self, host: str, index: int = 0) -> str:
        """Return where a shard on this host listens; several shards differ by `index`."""

    def cut(self, source: str, target: str) -> None:
        """Lose whatever goes from one host to the other."""

    def heal(self, source: str, target: str) -> None:
        """End a cut."""

    def lay(self, source: str, target: str, cable: Cable) -> None:
        """Let what goes from one host to the other go through this cable."""

    def close(self) -> None:
        """Remove everything."""


class Loopback:
    """All on this host: no network of its own, one clock."""

    def __init__(self, hosts: Sequence[str], *, why: str) -> None:
        self.missing: tuple[str, ...] = (
            f"partitions ({why})",
            f"slow, lossy and narrow networks ({why})",
            f"other monotonic clocks ({why})",
        )
        self.clock_ahead_ns = dict.fromkeys(hosts, 0)
        self._kept = KeptPorts()
        self._ports: dict[tuple[str, int], int] = {}

    def before(self, host: str) -> tuple[str, ...]:
        """Return the command that runs what follows it on a host."""
        return _DIE_WITH_PARENT

    def endpoint(self, host: str, index: int = 0) -> str:
        """Return where a shard on this host listens; several shards differ by `index`."""
        if (host, index) not in self._ports:
            self._ports[host, index] = self._kept.free()
        return f"tcp/127.0.0.1:{self._ports[host, index]}"

    def cut(self, source: str, target: str) -> None:
        """Refuse: there is nothing between two hosts here."""
        raise LinkError(f"{source} and {target} are one host; no network lies between them")

    def heal(self, source: str, target: str) -> None:
        """Refuse, as `cut` does."""
        self.cut(source, target)

    def lay(self, source: str, target: str, cable: Cable) -> None:
        """Refuse, as `cut` does."""
        self.cut(source, target)

    def close(self) -> None:
        """Give the ports back; processes end by themselves."""
        self._kept.close()


class Namespaces:
    """One set of namespaces per host, joined by a switch.

    Args:
        hosts: Their names.
        seed: What the network loses and delays by chance is drawn from it.

    Raises:
        LinkError: The system does not allow it; the message says which step.
    """

    def __init__(self, hosts: Sequence[str], *, seed: int = 0) -> None:
        self.missing: tuple[str, ...] = ()
        self._names = tuple(hosts)
        self._ahead_s = {h: (1 + i) * CLOCK_AHEAD_S for i, h in enumerate(hosts)}
        self.clock_ahead_ns = {host: ahead * 10**9 for host, ahead in self._ahead_s.items()}
        self._own_user = os.geteuid() != 0
        self._holders: dict[str, subprocess.Popen[bytes]] = {}
        self._pids: dict[str, int] = {}
        self._addresses = {host: f"198.18.77.{10 + index}" for index, host in enumerate(hosts)}
        self._log = os.memfd_create("switch.log")  # no file is left, however this process ends
        try:
            for tool in ("unshare", "nsenter", "setpriv", "ip"):
                if shutil.which(tool) is None:
                    raise LinkError(f"the program {tool} is not installed")
            self._hold("", [])
            for index, host in enumerate(hosts):
                self._add(index, host)
            before = (*self._enter(""), *_DIE_WITH_PARENT)
            words = (str(seed), str(len(hosts)))
            log = Path(f"/proc/{os.getpid()}/fd/{self._log}")
            self._switch = LineProcess(switch.MODULE, words, log, before=before)
            self._switch.expect("started")
        except BaseException:
            self.close()
            raise

    def _add(self, index: int, host: str) -> None:
        ahead_s = self._ahead_s[host]
        more = ["--mount", "--uts", "--time", f"--monotonic={ahead_s}", f"--boottime={ahead_s}"]
        self._hold(host, more)
        port = f"v{index}"
        self._ip(
            "",
            f"link add {port} type veth peer name eth0 netns {self._pids[host]}"
            f" address {switch.address(index)}",
            f"link set {port} addrgenmode none up",
        )
        self._ip(
            host,
            "link set lo up",
            "link set eth0 addrgenmode none gso_max_segs 1",  # or it hands over many frames as one
            f"addr add {self._addresses[host]}/24 dev eth0",
            "link set eth0 up",
        )

    def _hold(self, host: str, more: list[str]) -> None:
        """Start the child that keeps the namespaces of a host; "": those of the switch."""
        user = self._enter("") if self._pids else []
        if self._own_user and not self._pids:
            more = ["--user", "--map-root-user", *more]
        script = _MAKE_HOST if host else "echo $$ && exec cat >/dev/null"
        # The child of a fork is the first to have the clock.
        command = [*user, "unshare", "--net", *more, "--fork", "--kill-child"]
        holder = subprocess.Popen(
            [*command, "sh", "-c", script, "host", host, str(uuid.uuid4())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        self._holders[host] = holder
        assert holder.stdout is not None
        said = holder.stdout.readline().strip()
        if not said:
            _, errors = holder.communicate()
            what = errors.decode(errors="replace").strip()
            raise LinkError(f"no namespace can be made here: {what}")
        self._pids[host] = int(said)

    def _enter(self, host: str) -> list[str]:
        command = ["nsenter", "--target", str(self._pids[host]), "--net"]
        if self._own_user:
            command += ["--user", "--preserve-credentials"]
        if host:
            # In another mount namespace the working folder has to be found anew.
            command += ["--mount", "--uts", "--time", "env", f"--chdir={Path.cwd()}"]
        return command

    def _ip(self, host: str, *lines: str) -> None:
        self._run(self._enter(host), ["ip", "-batch", "-"], given="\n".join(lines) + "\n")

    def _run(self, enter: list[str], command: list[str], *, given: str = "") -> None:
        done = subprocess.run(
            [*enter, *command],
            input=given,
            capture_output=True,
            text=True,
            timeout=COMMAND_S,
            check=False,
        )
        if done.returncode:
            what = (done.stderr or done.stdout).strip()
            raise LinkError(f"{' '.join(command)} failed with {done.returncode}: {what}")

    # ---------------------------------------------------------------- use

    def before(self, host: str) -> tuple[str, ...]:
        """Return the command that runs what follows it on a host."""
        return (*self._enter(host), *_DIE_WITH_PARENT)

    def address(self, host: str) -> str:
        """Return the address of a host."""
        return self._addresses[host]

    def root(self, host: str) -> Path:
        """Return the root folder of a host as it is seen from outside."""
        return Path(f"/proc/{self._pids[host]}/root")

    def execute(self, host: str, *command: str) -> None:
        """Run a command on a host to its end.

        Raises:
            LinkError: It failed; the message has what it said.
        """
        self._run(self._enter(host), list(command))

    def endpoint(self, host: str, index: int = 0) -> str:
        """Return where a shard on this host listens; several shards differ by `index`."""
        return f"tcp/{self._addresses[host]}:{_PORT + index}"

    def cut(self, source: str, target: str) -> None:
        """Lose whatever goes from one host to the other."""
        self._change("cut", source, target)

    def heal(self, source: str, target: str) -> None:
        """End a cut."""
        self._change("heal", source, target)

    def lay(self, source: str, target: str, cable: Cable) -> None:
        """Let what goes from one host to the other go through this cable."""
        self._change("cable", source, target, *astuple(cable))

    def counts(self) -> Counts:
        """Return what became of all frames so far."""
        self._tell("count")
        return Counts(**json.loads(self._switch.expect("count")))

    def _change(self, word: str, source: str, target: str, *rest: float) -> None:
        self._tell(word, self._names.index(source), self._names.index(target), *rest)
        self._switch.expect("done")

    def _tell(self, *words: object) -> None:
        self._switch.tell(json.dumps(words))

    def close(self) -> None:
        """Let the children end, and with them the namespaces; twice is harmless."""
        if hasattr(self, "_switch"):
            self._switch.end()
        if self._log >= 0:
            os.close(self._log)
            self._log = -1
        for holder in self._holders.values():
            holder.kill()
            holder.wait()
            for pipe in (holder.stdin, holder.stdout, holder.stderr):
                if pipe is not None:
                    pipe.close()
        self._holders.clear()


def open_hosts(hosts: Sequence[str], *, seed: int = 0, required: bool = False) -> Hosts:
    """Return namespaces where the system allows them, else the loopback.

    Args:
        hosts: Names of the hosts.
        seed: What the network loses and delays by chance is drawn from it.
        required: Whether to fail where there are no namespaces.

    Raises:
        LinkError: `required`, and the system allows none.
    """
    try:
        return Namespaces(hosts, seed=seed)
    except LinkError as error:
        if required:
            raise
        return Loopback(hosts, why=str(error))
