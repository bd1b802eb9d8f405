"""The hosts of a cell under test: network namespaces on one bridge, or else the loopback.

::

    s0 ──┐            one namespace per shard, per group of clients and for the watcher, each
    s1 ──┤            with an address of 198.18.77.0/24; the bridge stands in one of its own.
    g0 ──┼── bridge   A cut from A to B lets B drop what comes from A: nobody is told.
    g1 ──┘

Each namespace lives as long as a child that waits for the end of its standard input: when this
process ends, however it ends, all of them are gone.  Without root they stand in a user namespace.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from typing import TYPE_CHECKING, Final, Protocol

from enact_dist.errors import LinkError
from enact_dist.verify.daemons import free_port

if TYPE_CHECKING:
    from collections.abc import Sequence

CLOCK_AHEAD_S: Final = 100_000
"""By how much the one host with a monotonic clock of its own is ahead."""
COMMAND_S: Final = 10.0
_PORT: Final = 7447
_DIE_WITH_PARENT: Final = ("setpriv", "--pdeathsig", "KILL")
_RULES: Final = """
table inet enact_chaos {
    set cut { type ipv4_addr; }
    chain arriving { type filter hook input priority 0; ip saddr @cut drop; }
}
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

    def endpoint(self, host: str) -> str:
        """Return where a shard on this host listens."""

    def cut(self, source: str, target: str) -> None:
        """Lose whatever goes from one host to the other."""

    def heal(self, source: str, target: str) -> None:
        """End a cut."""

    def close(self) -> None:
        """Remove everything."""


class Loopback:
    """All on this host: no partitions, no clocks of its own."""

    def __init__(self, hosts: Sequence[str], *, why: str) -> None:
        self.missing: tuple[str, ...] = (
            f"partitions ({why})",
            f"another monotonic clock ({why})",
        )
        self.clock_ahead_ns = dict.fromkeys(hosts, 0)
        self._ports = {host: free_port() for host in hosts}

    def before(self, host: str) -> tuple[str, ...]:
        """Return the command that runs what follows it on a host."""
        return _DIE_WITH_PARENT

    def endpoint(self, host: str) -> str:
        """Return where a shard on this host listens."""
        return f"tcp/127.0.0.1:{self._ports[host]}"

    def cut(self, source: str, target: str) -> None:
        """Refuse: there is nothing between two hosts here."""
        raise LinkError(f"{source} and {target} are one host; no network lies between them")

    def heal(self, source: str, target: str) -> None:
        """Refuse, as `cut` does."""
        self.cut(source, target)

    def close(self) -> None:
        """Do nothing: processes end by themselves."""


class Namespaces:
    """One network namespace per host, joined by a bridge.

    Args:
        hosts: Their names.
        other_clock: The host that gets a monotonic clock of its own.

    Raises:
        LinkError: The system does not allow it; the message says which step.
    """

    def __init__(self, hosts: Sequence[str], *, other_clock: str) -> None:
        self.missing: tuple[str, ...] = ()
        self.clock_ahead_ns = dict.fromkeys(hosts, 0)
        self.clock_ahead_ns[other_clock] = CLOCK_AHEAD_S * 10**9
        self._own_user = os.geteuid() != 0
        self._clocks = {other_clock}
        self._holders: dict[str, subprocess.Popen[bytes]] = {}
        self._pids: dict[str, int] = {}
        self._addresses = {host: f"198.18.77.{10 + index}" for index, host in enumerate(hosts)}
        try:
            for tool in ("unshare", "nsenter", "setpriv", "ip", "nft"):
                if shutil.which(tool) is None:
                    raise LinkError(f"the program {tool} is not installed")
            self._hold("", [])
            self._ip("", "link add bridge type bridge", "link set bridge up")
            for index, host in enumerate(hosts):
                self._add(index, host)
        except BaseException:
            self.close()
            raise

    def _add(self, index: int, host: str) -> None:
        time = ["--time", f"--monotonic={CLOCK_AHEAD_S}", f"--boottime={CLOCK_AHEAD_S}"]
        self._hold(host, time if host in self._clocks else [])
        self._ip(
            "",
            f"link add v{index} type veth peer name eth0 netns {self._pids[host]}",
            f"link set v{index} master bridge up",
        )
        address = self._addresses[host]
        self._ip(host, "link set lo up", f"addr add {address}/24 dev eth0", "link set eth0 up")
        self._run(self._enter(host), ["nft", "-f", "-"], given=_RULES)

    def _hold(self, host: str, more: list[str]) -> None:
        """Start the child that keeps a namespace."""
        user = self._enter("") if self._pids else []
        if self._own_user and not self._pids:
            more = ["--user", "--map-root-user", *more]
        # The child of a fork is the first to have the clock; both write their ids.
        command = [*user, "unshare", "--net", *more, "--fork", "--kill-child"]
        holder = subprocess.Popen(
            [*command, "sh", "-c", "echo $$; exec cat >/dev/null"],
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
        command = self._enter(host)
        if host in self._clocks:
            command.append("--time")
        return (*command, *_DIE_WITH_PARENT)

    def endpoint(self, host: str) -> str:
        """Return where a shard on this host listens."""
        return f"tcp/{self._addresses[host]}:{_PORT}"

    def cut(self, source: str, target: str) -> None:
        """Lose whatever goes from one host to the other."""
        self._change("add", source, target)

    def heal(self, source: str, target: str) -> None:
        """End a cut."""
        self._change("delete", source, target)

    def _change(self, verb: str, source: str, target: str) -> None:
        element = f"{{ {self._addresses[source]} }}"
        command = ["nft", verb, "element", "inet", "enact_chaos", "cut", element]
        self._run(self._enter(target), command)

    def close(self) -> None:
        """Let the children end, and with them the namespaces; twice is harmless."""
        for holder in self._holders.values():
            holder.kill()
            holder.wait()
            for pipe in (holder.stdin, holder.stdout, holder.stderr):
                if pipe is not None:
                    pipe.close()
        self._holders.clear()


def open_hosts(hosts: Sequence[str], *, other_clock: str, required: bool = False) -> Hosts:
    """Return namespaces where the system allows them, else the loopback.

    Args:
        hosts: Names of the hosts.
        other_clock: The host that gets a monotonic clock of its own.
        required: Whether to fail where there are no namespaces.

    Raises:
        LinkError: `required`, and the system allows none.
    """
    try:
        return Namespaces(hosts, other_clock=other_clock)
    except LinkError as error:
        if required:
            raise
        return Loopback(hosts, why=str(error))
