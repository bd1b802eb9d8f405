"""`enact shard reload`: lets running shards of this host take keys, names and rights anew."""

from __future__ import annotations

import os
import signal
import socket
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from enact_dist.cli.target import cell_config, open_cell
from enact_dist.cli.verbs import DONE, FAILED, UNREACHABLE, Output
from enact_dist.errors import ConfigError
from enact_dist.link.zenoh.endpoints import split_endpoint

if TYPE_CHECKING:
    import argparse

    from enact_dist.config.types import CellConfig, ShardConfig
    from enact_dist.world.cell import Cell

RELOAD_S: Final = 5.0
"""How long a shard may take for it."""
PAUSE_S: Final = 0.05
_LISTENS: Final = "0A"


def reload_shards(options: argparse.Namespace) -> Output:
    """Tell shards to read keys, names and rights again, and look whether they took them.

    Status 1 if one keeps the old ones, 3 if one does not run on this host.
    """
    config = cell_config(options)
    if config.security.keys is None and config.rights is None:
        raise ConfigError(f"{config.path} has neither [security] keys nor [rights] to read again")
    if options.all == bool(options.name):
        raise ConfigError("name one shard, or --all for those of this host")
    host = socket.gethostname()
    here = [one for one in config.shards if one.host in {"", host}]
    rows: list[dict[str, Any]] = []
    for shard in here if options.all else [config.shard(options.name)]:
        status, text = _reload(config, shard, options)
        rows.append({"shard": shard.name, "status": status, "text": text})
    lines = [f"shard {row['shard']}: {row['text']}" for row in rows]
    return Output(rows, "\n".join(lines), status=max((row["status"] for row in rows), default=DONE))


def _reload(config: CellConfig, shard: ShardConfig, options: argparse.Namespace) -> tuple[int, str]:
    from enact_dist.link.daemon.reload import checked_keys
    from enact_dist.link.zenoh.tls import shard_keys

    keys = shard_keys(config.security, shard.name)
    try:
        if keys is not None:
            checked_keys(keys, ())
        config.shard_settings(shard.name)
    except ConfigError as error:
        return FAILED, f"not told to reload, which it would refuse: {error}"
    endpoint = next((one for one in shard.listen if split_endpoint(one)[2].isdecimal()), "")
    process = listening_process(int(split_endpoint(endpoint)[2]))
    if process is None:
        where = f"no process of this user listens at {endpoint} on this host"
        return UNREACHABLE, f"{where}; run this where the shard runs, as its user"
    if not catches_hangup(process):
        return FAILED, f"process {process} at {endpoint} is no shard with keys or rights: not told"
    with open_cell(options) as cell:
        before = _counts(cell, shard.name)
        if before is None:
            return UNREACHABLE, "does not answer, so it was not told to reload"
        os.kill(process, signal.SIGHUP)
        end_s = time.monotonic() + RELOAD_S
        while time.monotonic() < end_s:
            now = _counts(cell, shard.name) or before
            if now[1] > before[1]:
                return FAILED, "keeps its old keys, names and rights; its log says why"
            if now[0] > before[0]:
                return DONE, "reloaded"
            time.sleep(PAUSE_S)
    return FAILED, f"has not reloaded for {RELOAD_S:g} s; see its log"


def _counts(cell: Cell, shard: str) -> tuple[int, int] | None:
    """Return how often a shard has reloaded and how often it could not; None if it is away."""
    found = next(one for one in cell.shards() if one.name == shard)
    if not found.reachable:
        return None
    return found.counters.get("reloads", 0), found.counters.get("reloads_refused", 0)


def listening_process(port: int) -> int | None:
    """Return a process of this host, and of a user that we may look at, that listens at a port."""
    wanted = set()
    for table in ("tcp", "tcp6"):
        try:
            rows = Path(f"/proc/net/{table}").read_text("ascii").splitlines()[1:]
        except OSError:  # not Linux, or no IPv6
            continue
        for row in map(str.split, rows):
            if row[3] == _LISTENS and int(row[1].rpartition(":")[2], 16) == port:
                wanted.add(f"socket:[{row[9]}]")
    for folder in Path("/proc").glob("[0-9]*/fd"):
        try:
            if any(str(entry.readlink()) in wanted for entry in folder.iterdir()):
                return int(folder.parent.name)
        except OSError:  # it has ended, or is another user's
            continue
    return None


def catches_hangup(process: int) -> bool:
    """Return whether a process has a handler for SIGHUP, which would end it otherwise."""
    try:
        lines = Path(f"/proc/{process}/status").read_text("ascii", "replace").splitlines()
    except OSError:
        return False
    caught = next((line.split()[1] for line in lines if line.startswith("SigCgt:")), "0")
    return bool(int(caught, 16) >> (signal.SIGHUP - 1) & 1)
