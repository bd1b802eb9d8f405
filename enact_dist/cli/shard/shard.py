"""`enact shard run|ls|check`; operations on shards' folders have their own modules."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Final

from enact_dist.cli.shard import backup as shard_backup
from enact_dist.cli.shard import forget as shard_forget
from enact_dist.cli.shard import rebalance as shard_rebalance
from enact_dist.cli.text.output import print_json, print_table, shown_bytes, shown_s
from enact_dist.cli.verbs import (
    DONE,
    FAILED,
    UNREACHABLE,
    add_cell,
    add_log,
    add_noun,
    add_reader,
    add_verb,
    address,
    cell_target,
    duration,
    endpoints,
    is_endpoint,
    open_cell,
    verbs_of,
)
from enact_dist.core.state.clock import state_of
from enact_dist.errors import ConfigError
from enact_dist.link.daemon.counters import BODIES, told

if TYPE_CHECKING:
    import argparse

    from enact_dist.cli.verbs import Verb
    from enact_dist.link.daemon.health import ShardHealth
    from enact_dist.world.listings import ShardInfo

CHECK_S: Final = 2.0
"""How long a health check waits: it is called every few seconds, and a local answer takes 1 ms."""


def add_to(nouns: argparse._SubParsersAction[Verb]) -> None:
    """Add the noun and its verbs."""
    verbs = verbs_of(add_noun(nouns, "shard"))
    _add_run(verbs)
    ls = add_verb(
        verbs,
        "ls",
        f"list the shards of the cell and how they are; data: bytes of {BODIES}",
        run=list_shards,
        example="enact shard ls --cell tcp/127.0.0.1:7447",
    )
    ls.add_argument(
        "--counters", action="store_true", help="list what each has counted, and what that means"
    )
    add_reader(ls)
    check = add_verb(
        verbs,
        "check",
        "ask shards whether they are ready, or alive; made to be called every few seconds",
        run=check_shards,
        example="enact shard check left --cell cell.toml --alive\n"
        "enact shard check --cell tcp/127.0.0.1:7447 --json",
    )
    check.add_argument(
        "name", metavar="NAME", nargs="?", help="name of the shard (default: each one of the cell)"
    )
    asks = check.add_mutually_exclusive_group()
    asks.add_argument(
        "--ready", action="store_true", help="it answers and grants locks (the default)"
    )
    asks.add_argument("--alive", action="store_true", help="it answers")
    add_reader(check)
    check.set_defaults(timeout_s=CHECK_S)
    shard_rebalance.add_to(verbs)
    shard_forget.add_to(verbs)
    shard_backup.add_to(verbs)


def _add_run(verbs: argparse._SubParsersAction[Verb]) -> None:
    run = add_verb(
        verbs,
        "run",
        "run one shard daemon of the cell until SIGTERM",
        run=run_shard,
        example="enact shard run left --cell cell.toml",
    )
    run.add_argument("name", metavar="NAME", help="name of the shard in cell.toml")
    add_cell(run, file_only=True)
    run.add_argument(
        "--listen",
        action="append",
        type=endpoints,
        metavar="ENDPOINT",
        help="replaces `listen` of cell.toml",
    )
    run.add_argument(
        "--advertise",
        action="append",
        type=endpoints,
        metavar="ENDPOINT",
        help="replaces `advertise`",
    )
    run.add_argument("--folder", metavar="DIR", help="replaces `folder` of cell.toml")
    run.add_argument(
        "--metrics",
        type=address,
        metavar="HOST:PORT",
        help="serve /metrics for Prometheus there; a port alone is one of the loopback",
    )
    add_log(run)
    run.add_argument(
        "--drain",
        dest="drain_s",
        type=duration,
        default=None,
        metavar="S",
        help="seconds that holders of locks may still finish after SIGTERM (default: `drain_s` of"
        " cell.toml, or 0.8)",
    )


def run_shard(arguments: argparse.Namespace) -> int:
    """Run one shard daemon in this process."""
    from enact_dist.config.environment import variable_of
    from enact_dist.config.read import load_config
    from enact_dist.link.daemon import daemon as shard_daemon

    target = cell_target(arguments)
    if is_endpoint(target):
        raise ConfigError(f"{target} is an endpoint; a shard needs the cell.toml: --cell FILE")
    environment = dict(os.environ)
    for key, found in (
        ("LISTEN", ",".join(arguments.listen or ())),
        ("ADVERTISE", ",".join(arguments.advertise or ())),
        ("FOLDER", arguments.folder),
        ("METRICS", arguments.metrics),
    ):
        if found:
            environment[variable_of(arguments.name, key)] = found
    # The name comes first: an override for a shard that is not there would blame the override.
    written = load_config(target).shard(arguments.name)
    config = load_config(target, environment=environment)
    shard = config.shard(arguments.name)
    drain_s = shard.drain_s if arguments.drain_s is None else arguments.drain_s
    return shard_daemon.run_shard(
        shard_daemon.DaemonSettings(
            cell=config.name,
            shard=config.shard_settings(shard.name),
            listen=shard.listen,
            folder=shard.folder,
            log=arguments.log,
            link_lease_s=config.ttl_s / 2,
            carrier=config.carrier,
            shared_bytes_max=config.shared_bytes_max,
            metrics=shard.metrics,
            written=written.advertise,
            drain_s=shard_daemon.DRAIN_S if drain_s is None else drain_s,
        )
    )


def list_shards(arguments: argparse.Namespace) -> int:
    """Print all shards, also those that cannot be reached; why, if it is known, on a line each."""
    with open_cell(arguments) as cell:
        shards = cell.shards()
    if arguments.json:
        print_json(shards)
    elif arguments.counters:
        print_table(
            ("shard", "counter", "value", "meaning", "what to do"),
            [(shard.name, *row) for shard in shards for row in told(shard.counters)],
            empty="no counters",
        )
    else:
        print_table(
            ("shard", "endpoint", "state", "epoch", "up", "slots", "data", "shared", "sessions",
             "locks", "rtt"),
            [_row(shard) for shard in shards],
            empty="no shards",
        )  # fmt: skip
    if not arguments.json:
        for shard in shards:
            if shard.problem:
                print(f"enact: shard {shard.name}: {shard.problem}", file=sys.stderr)
    return DONE if all(shard.reachable for shard in shards) else UNREACHABLE


def check_shards(arguments: argparse.Namespace) -> int:
    """Ask shards how they are; status 3 if one does not answer, 1 if one grants no locks.

    *Alive*: the shard's dispatcher answers a request that came over its endpoint; a supervisor
    should restart one that is not alive.  *Ready*: it grants locks as well, so it neither waits
    for leases of before its start to end nor drains before its end; both pass by themselves.
    """
    found = _health(arguments)
    if arguments.json:
        print_json(found)
    else:
        for shard in found:
            print(shard)
    if not all(shard.alive for shard in found):
        return UNREACHABLE
    return DONE if arguments.alive or all(shard.ready for shard in found) else FAILED


def _health(arguments: argparse.Namespace) -> list[ShardHealth]:
    from enact_dist.link.daemon import health as shard_health

    target = cell_target(arguments)
    if is_endpoint(target):
        return shard_health.of_endpoint(target, arguments.name, timeout_s=arguments.timeout_s)
    from enact_dist.config.read import load_config

    config = load_config(target)
    names = [arguments.name] if arguments.name else [shard.name for shard in config.shards]
    endpoints = {
        name: (*config.shard(name).advertise, *config.shard(name).listen) for name in names
    }
    return shard_health.of_shards(config.name, endpoints, timeout_s=arguments.timeout_s)


def _row(shard: ShardInfo) -> tuple[object, ...]:
    if not shard.reachable:
        return (shard.name, shard.endpoint, "UNREACHABLE", *["-"] * 8)
    return (
        shard.name,
        shard.endpoint,
        _state(shard),
        shard.epoch,
        shown_s(shard.uptime_s),
        shard.slots,
        shown_bytes(shard.size_bytes),
        _shared(shard),
        shard.sessions,
        shard.locks,
        shown_s(shard.round_trip_s),
    )


def _shared(shard: ShardInfo) -> str:
    """Return how much large data lies in shared memory, and of how much."""
    used, most = (shard.counters.get(f"payload_{name}", 0) for name in ("bytes", "bytes_max"))
    return f"{shown_bytes(used)} of {shown_bytes(most)}" if most else "-"


def _state(shard: ShardInfo) -> str:
    state = state_of(grants=shard.open, draining=bool(shard.counters.get("draining")))
    alarms, namesakes = (shard.counters.get(name, 0) for name in ("alarms", "namesakes"))
    state += f", ALARMS: {alarms} (enact lock audit)" if alarms else ""
    return f"{state}, SHARDS RUNNING TWICE: {namesakes} (enact doctor)" if namesakes else state
