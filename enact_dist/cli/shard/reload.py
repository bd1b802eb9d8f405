"""`enact shard reload`: lets daemons of this host take keys, names and rights anew.

A standby takes them, too.  It answers no client, so what it counts stands in its database.
"""

from __future__ import annotations

import os
import signal
import socket
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from enact_dist.cli.target import cell_config, open_cell
from enact_dist.cli.verbs import DONE, FAILED, UNREACHABLE, Output
from enact_dist.errors import ConfigError
from enact_dist.link.zenoh.endpoints import split_endpoint

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterator

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
        for status, text in _reload(config, shard, options):
            rows.append({"shard": shard.name, "status": status, "text": text})
    lines = [f"shard {row['shard']}: {row['text']}" for row in rows]
    return Output(rows, "\n".join(lines), status=max((row["status"] for row in rows), default=DONE))


def _reload(
    config: CellConfig, shard: ShardConfig, options: argparse.Namespace
) -> Iterator[tuple[int, str]]:
    """Yield status and text for each daemon of a shard on this host: one, or standbys beside it."""
    from enact_dist.link.daemon.reload import checked_keys
    from enact_dist.link.zenoh.tls import shard_keys

    keys = shard_keys(config.security, shard.name)
    try:
        if keys is not None:
            checked_keys(keys, ())
        config.shard_settings(shard.name)
    except ConfigError as error:
        yield FAILED, f"not told to reload, which it would refuse: {error}"
        return
    ports = {split_endpoint(one)[2]: one for one in (*shard.advertise, *shard.listen)}
    found = {
        process: at
        for port, at in ports.items()
        if port.isdecimal() and (process := listening_process(int(port))) is not None
    }
    if not found:
        where = f"no process of this user listens at {', '.join(ports.values())} on this host"
        yield UNREACHABLE, f"{where}; run this where the shard runs, as its user"
    stand_by = _standbys(config, shard.name)
    for process, endpoint in found.items():
        who = f"{socket.gethostname()} {process}"
        if not catches_hangup(process):
            text = f"process {process} at {endpoint} is no shard with keys or rights: not told"
            yield FAILED, text
        elif who in stand_by:
            status, text = _told(process, lambda who: _standbys(config, shard.name).get(who), who)
            yield status, f"{who}, which stands by, {text}"
        else:
            with open_cell(options) as cell:
                yield _told(process, partial(_counts, cell), shard.name)


def _told(
    process: int, counts: Callable[[str], tuple[int, int] | None], name: str
) -> tuple[int, str]:
    """Tell a daemon to reload; return what became of it, by what `counts` shows of its name."""
    before = counts(name)
    if before is None:
        return UNREACHABLE, "does not answer, so it was not told to reload"
    os.kill(process, signal.SIGHUP)
    end_s = time.monotonic() + RELOAD_S
    while time.monotonic() < end_s:
        now = counts(name) or before
        if now[1] > before[1]:
            return FAILED, "keeps its old keys, names and rights; its log says why"
        if now[0] > before[0]:
            return DONE, "reloaded"
        time.sleep(PAUSE_S)
    return FAILED, f"has not reloaded for {RELOAD_S:g} s; see its log"


def _standbys(config: CellConfig, shard: str) -> dict[str, tuple[int, int]]:
    """Return how often each standby of a shard has reloaded and how often it could not."""
    if not config.store:
        return {}
    from enact_dist.link.postgres.address import require_driver

    require_driver(config.store)
    from enact_dist.link.postgres.examine import standbys_of

    found = standbys_of(config.store, config.name, shard)
    return {who: (one.reloads, one.reloads_refused) for who, one in found.items()}


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
