"""`enact shard reload`: lets running shards of this host read their key files again."""

from __future__ import annotations

import os
import signal
import socket
import ssl
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from enact_dist.cli.target import cell_config
from enact_dist.cli.verbs import DONE, FAILED, UNREACHABLE, Output
from enact_dist.errors import ConfigError
from enact_dist.link.zenoh.endpoints import split_endpoint

if TYPE_CHECKING:
    import argparse

    from enact_dist.config.types import ShardConfig
    from enact_dist.link.zenoh.tls import KeyFiles

RELOAD_S: Final = 5.0
"""How long a shard may take to show its new certificate."""
PAUSE_S: Final = 0.05
_LISTENS: Final = "0A"


def reload_shards(options: argparse.Namespace) -> Output:
    """Tell shards to read their keys again, and look whether they show the new certificate.

    Status 1 if one keeps the old one, 3 if one does not run on this host.
    """
    from enact_dist.link.zenoh.tls import shard_keys

    config = cell_config(options)
    if config.security.keys is None:
        raise ConfigError(f"{config.path} has no [security] keys; there is nothing to read again")
    if options.all == bool(options.name):
        raise ConfigError("name one shard, or --all for those of this host")
    host = socket.gethostname()
    here = [one for one in config.shards if one.host in {"", host}]
    rows: list[dict[str, Any]] = []
    for shard in here if options.all else [config.shard(options.name)]:
        keys = shard_keys(config.security, shard.name)
        assert keys is not None
        status, text = _reload(shard, keys)
        rows.append({"shard": shard.name, "status": status, "text": text})
    lines = [f"shard {row['shard']}: {row['text']}" for row in rows]
    return Output(rows, "\n".join(lines), status=max((row["status"] for row in rows), default=DONE))


def _reload(shard: ShardConfig, keys: KeyFiles) -> tuple[int, str]:
    from enact_dist.link.daemon.key_watch import checked_keys
    from enact_dist.link.zenoh.config import to_reach
    from enact_dist.link.zenoh.tls import look

    try:
        checked_keys(keys, ())
    except ConfigError as error:
        return FAILED, f"not told to read its keys, which it would refuse: {error}"
    endpoint = next((one for one in shard.listen if split_endpoint(one)[2].isdecimal()), "")
    process = listening_process(int(split_endpoint(endpoint)[2]))
    if process is None:
        where = f"no process of this user listens at {endpoint} on this host"
        return UNREACHABLE, f"{where}; run this where the shard runs, as its user"
    if not catches_hangup(process):
        return FAILED, f"process {process} at {endpoint} is no shard with keys: not told anything"
    place, wanted = to_reach(endpoint), ssl.PEM_cert_to_DER_cert(keys.certificate.read_text())
    same = look(place, keys).encoded == wanted
    os.kill(process, signal.SIGHUP)
    end_s = time.monotonic() + RELOAD_S
    while time.monotonic() < end_s:
        time.sleep(PAUSE_S)
        if look(place, keys).encoded == wanted:
            again = "reads its keys again; its certificate was this one already"
            return DONE, again if same else "reloaded; it shows its new certificate"
    return FAILED, f"keeps its certificate for {RELOAD_S:g} s already; see its log"


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
