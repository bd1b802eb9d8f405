"""Checks of a machine and of the way from it to a cell, each with what to do about it.

`examine` yields one finding per check, good ones too, as each check ends.  It changes nothing.
"""

from __future__ import annotations

import ctypes
import importlib
import importlib.util
import os
import re
import shutil
import socket
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

from enact_dist.config.read import load_config
from enact_dist.config.types import CellConfig, is_locked
from enact_dist.core.state.clock import is_kept, state_of
from enact_dist.errors import ConfigError, EnactError, ShardUnreachableError
from enact_dist.link.memory.shared_folder import MEMORY, SHARED_FOLDER_VARIABLE
from enact_dist.operate.doctor_cell import (
    Finding,
    differences,
    duplicate_daemons,
    fail,
    folders,
    ok,
    warn,
)
from enact_dist.operate.doctor_keys import keys
from enact_dist.operate.doctor_store import database

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator

    from enact_dist.world.cell import Cell
    from enact_dist.world.listings import ShardInfo

PYTHON_MIN: Final = (3, 11)
KNOCK_S: Final = 2.0

LIBRARIES: Final = {
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libudev.so.1": "libudev1",
    "libidn2.so.0": "libidn2-0",
    "libgomp.so.1": "libgomp1",
}
"""What Open3D loads beside the C library, and the Debian or Ubuntu package that has it."""

SKEW_S_WARN: Final = 0.1
SKEW_S_FAIL: Final = 1.0
"""Stamps further ahead than this are refused by the shards."""
SKEW_ROUNDS: Final = 5
"""Of several round trips the shortest tells the skew best."""
ROUND_TRIP_S_WARN: Final = 0.02

SHM_BYTES_WARN: Final = 256_000_000


def examine(target: str, *, timeout_s: float = 5.0) -> Iterator[Finding]:
    """Check this machine and, unless `target` is empty, the cell."""
    yield python_version(sys.version_info[:3])
    yield from _packages()
    yield from _open3d()
    named = os.environ.get(SHARED_FOLDER_VARIABLE)
    yield shared_memory(Path(named) if named else MEMORY, named=bool(named))
    if not target:
        yield warn("cell", "not checked: no cell.toml here", "name it: enact doctor --cell FILE")
        return
    config = None
    if Path(target).suffix == ".toml" or Path(target).exists():
        try:
            config = load_config(target)
        except ConfigError as error:
            yield fail("cell.toml", str(error), "correct the file")
            return
        counts = (
            f"{len(config.shards)} shards, {len(config.worlds)} world contexts,"
            f" {len(config.actors)} actors"
        )
        yield ok("cell.toml", f"{target}: cell {config.name}, {counts}")
        yield from keys(config)
    kept = yield from _cell(target, config, timeout_s)
    if config is not None:
        yield from database(config) if config.store else folders(config, kept)


# ---------------------------------------------------------------- this machine


def python_version(found: tuple[int, ...]) -> Finding:
    """Check a version of Python."""
    shown = ".".join(map(str, found))
    if found[:2] >= PYTHON_MIN:
        return ok("python", f"{shown} at {sys.executable}")
    return fail("python", f"{shown} is older than 3.11", "install a newer python3")


def _packages() -> Iterator[Finding]:
    for name, package in (("zenoh", "eclipse-zenoh"), ("msgpack", "msgpack"), ("numpy", "numpy")):
        try:
            importlib.import_module(name)
        except ImportError as error:
            yield fail(name, f"cannot be imported: {error}", f"pip install {package}")
        else:
            yield ok(name, _version(package))


def _version(package: str) -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(package)
    except PackageNotFoundError:
        return "imported, version unknown"


def _open3d() -> Iterator[Finding]:
    if importlib.util.find_spec("open3d") is None:
        yield warn(
            "open3d",
            "not installed; the core does without, the demo does not",
            "pip install -e '.[actors]' in the clone of enact-dist",
        )
        return
    missing = missing_libraries(LIBRARIES)
    if missing:
        yield fail(
            "open3d",
            f"cannot load {', '.join(missing)}",
            f"sudo apt-get install -y {' '.join(missing.values())}",
        )
        return
    yield _open3d_import()


def missing_libraries(wanted: dict[str, str]) -> dict[str, str]:
    """Return those of the shared libraries that this machine cannot load, with their packages."""
    missing = {}
    for library, package in wanted.items():
        try:
            ctypes.CDLL(library)
        except OSError:
            missing[library] = package
    return missing


def _open3d_import() -> Finding:
    """Import Open3D in a process of its own: it may need a library that the list does not have."""
    code = "import open3d; print(open3d.__version__)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120
    )
    if done.returncode == 0:
        version = done.stdout.strip().splitlines()[-1]
        return ok("open3d", f"{version}, all shared libraries found")
    last = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
    found = re.search(r"(\S+\.so[.\d]*): cannot open shared object", last)
    remedy = f"apt-file search {found[1]} names the package" if found else "reinstall open3d-cpu"
    return fail("open3d", f"cannot be imported: {last}", remedy)


def shared_memory(folder: Path, *, named: bool = False) -> Finding:
    """Check the folder in which processes of one host can share memory.

    Args:
        folder: Path of the folder, which may not exist yet.
        named: Whether the user has chosen it, in `SHARED_FOLDER_VARIABLE`.
    """
    if named and not os.path.lexists(folder):
        folder = next(parent for parent in folder.absolute().parents if parent.is_dir())
    if not folder.is_dir():
        return warn("shared memory", f"{folder} is no folder", f"mount a tmpfs at {folder}")
    if not os.access(folder, os.W_OK | os.X_OK):
        remedy = f"sudo chmod 1777 {folder}"
        if named:
            remedy = f"let this user write there, or name another in {SHARED_FOLDER_VARIABLE}"
        return warn("shared memory", f"{folder} is not writable", remedy)
    usage = shutil.disk_usage(folder)
    text = f"{folder}: {usage.free / 1e6:.0f} MB free of {usage.total / 1e6:.0f} MB"
    if usage.free < SHM_BYTES_WARN:
        how = "of a container: the tmpfs volume" if named else "docker run --shm-size=1g"
        remedy = f"enlarge it: mount -o remount,size=1G {folder} ({how})"
        return warn("shared memory", text, remedy)
    return ok("shared memory", text)


# ---------------------------------------------------------------- the cell


def _cell(
    target: str, config: CellConfig | None, timeout_s: float
) -> Generator[Finding, None, frozenset[str]]:
    """Check the cell; return the names of the shards that keep data in a folder now."""
    from enact_dist.world.connecting import connect
    from enact_dist.world.look import welcomes

    kept: frozenset[str] = frozenset()
    try:
        with connect(target, actor="enact", timeout_s=timeout_s, observer=True) as cell:
            shards = _best_rounds(cell)
            kept = frozenset(one.name for one in shards if one.reachable and is_kept(one.epoch))
            for shard in shards:
                yield from _shard(shard)
            answers = welcomes(cell)
            yield from duplicate_daemons(cell.name, config, answers)
            yield from differences(config, shards, answers)
    except ShardUnreachableError as error:
        if config is None:
            yield _unreachable("cell", target)
            return kept
        for known in config.shards:
            yield _unreachable(f"shard {known.name}", ", ".join(known.advertise))
        yield fail("cell", str(error), f"enact up {target}")
    except EnactError as error:
        yield fail("cell", f"{type(error).__name__}: {error}")
    return kept


def _best_rounds(cell: Cell) -> list[ShardInfo]:
    """Return each shard as seen by the shortest of several round trips."""
    best: dict[str, ShardInfo] = {}
    for _ in range(SKEW_ROUNDS):
        for shard in cell.shards():
            known = best.get(shard.name)
            better = known is None or not known.reachable
            if known is not None and shard.reachable and known.reachable:
                better = shard.round_trip_s < known.round_trip_s
            if better:
                best[shard.name] = shard
        if not all(shard.reachable for shard in best.values()):
            break  # each further round would wait for it again
    return list(best.values())


def _shard(shard: ShardInfo) -> Iterator[Finding]:
    subject = f"shard {shard.name}"
    if shard.problem:
        yield fail(subject, f"{shard.endpoint}: {shard.problem}")
        return
    if not shard.reachable:
        yield _unreachable(subject, shard.endpoint)
        return
    yield _connection(subject, shard)
    yield clock_skew(f"clock of {shard.name}", shard.clock_ahead_s)
    yield from shared_data(shard)
    stalls = shard.counters.get("disk_stalls", 0)
    if stalls:
        yield warn(
            f"disk of {shard.name}",
            f"stood still for more than a second {stalls} times since the shard started",
            "see the shard's log for when; look at what else uses the disk of its folder, or at its"
            " database",
        )
    alarms = shard.counters.get("alarms", 0)
    if alarms:
        yield fail(
            f"commits on {shard.name}",
            f"{alarms} locks that were aborted by hand had been committed elsewhere: they stand"
            " only in part",
            "read enact lock audit, mend the data, then enact lock audit --acknowledge TEXT"
            f" --shard {shard.name}",
        )


def shared_data(shard: ShardInfo) -> Iterator[Finding]:
    """Check how much large data lies in the memory that a shard shares, and what did not fit."""
    counters = shard.counters
    used, most = counters.get("payload_bytes", 0), counters.get("payload_bytes_max", 0)
    subject = f"shared memory of {shard.name}"
    if not most:
        if "payload_bytes_max" in counters:
            found = "none: its large data travel, on its own host too"
            remedy = "the shard's log gives the reason, unless shared_bytes_max = 0 asks for it"
            yield warn(subject, found, remedy)
        return
    text = f"{counters.get('payload_files', 0)} files, {used} of {most} bytes"
    refused = counters.get("payloads_refused", 0)
    fell_back = counters.get("payload_fallbacks", 0)
    if refused:
        remedy = "raise shared_bytes_max in cell.toml, or retain fewer versions"
        yield warn(subject, f"{text}; {refused} writes were refused", remedy)
    elif fell_back:
        remedy = "enlarge the file system of the shared folder (in a container: a tmpfs volume)"
        yield warn(subject, f"{text}; {fell_back} large data did not fit and travel", remedy)
    elif used:
        yield ok(subject, text)


def _connection(subject: str, shard: ShardInfo) -> Finding:
    draining = bool(shard.counters.get("draining"))
    state = "" if shard.open else f", {state_of(grants=False, draining=draining)}"
    took = f"{shard.round_trip_s * 1e3:.2f} ms over {shard.carrier}"
    text = f"{shard.endpoint} answers in {took}{state}"
    if shard.round_trip_s > ROUND_TRIP_S_WARN:
        remedy = "every lock takes two round trips: look for a busy host or a slow link"
        return warn(subject, text, remedy)
    return ok(subject, text)


def clock_skew(subject: str, ahead_s: float) -> Finding:
    """Check how far a shard's wall clock is ahead of ours."""
    text = f"{abs(ahead_s) * 1e3:.1f} ms {'ahead of' if ahead_s > 0 else 'behind'} this host"
    remedy = "synchronise both hosts' clocks: sudo apt-get install -y chrony"
    if abs(ahead_s) > SKEW_S_FAIL:
        return fail(subject, f"{text}; commits would be refused", remedy)
    if abs(ahead_s) > SKEW_S_WARN:
        return warn(subject, text, remedy)
    return ok(subject, text)


def _unreachable(subject: str, endpoint: str) -> Finding:
    """Say why a shard does not answer at any of its endpoints, which are comma separated."""
    knocked = {one: knock(one) for one in endpoint.split(", ")}
    found = [f"at {one}, {why}" if len(knocked) > 1 else why for one, (why, _) in knocked.items()]
    remedies = dict.fromkeys(remedy for _, remedy in knocked.values())
    return fail(subject, f"{endpoint} does not answer: {'; '.join(found)}", "; ".join(remedies))


def knock(endpoint: str) -> tuple[str, str]:
    """Say why an endpoint such as ``tcp/host:port`` may not answer, and what to do about it."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    host = host.strip("[]")
    try:
        socket.create_connection((host, int(port)), KNOCK_S).close()
    except socket.gaierror:
        return (
            f"the host name {host} is unknown",
            f"correct the endpoint, or add {host} to /etc/hosts",
        )
    except ConnectionRefusedError:
        return f"nothing listens at port {port}", "start the shard: enact up, or enact shard run"
    except TimeoutError:
        return "no packet comes back", f"look for a firewall in front of port {port} of {host}"
    except (OSError, ValueError) as error:
        return str(error), f"look at the network: ping {host}"
    if is_locked(endpoint):
        return "something listens, but no connection comes about", "see the check of its key"
    return (
        "something listens: another program, or a shard that is stopped or hangs",
        f"see what runs at port {port}; restart a shard that hangs",
    )
