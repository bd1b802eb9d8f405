"""`enact shard run|ls|check`."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from typing import TYPE_CHECKING

from enact_dist.cli.target import PROGRAM, cell_target, is_endpoint, open_cell
from enact_dist.cli.text.output import print_table, shown_bytes
from enact_dist.cli.verbs import DONE, FAILED, UNREACHABLE, Output
from enact_dist.config.types import CellConfig, without_password
from enact_dist.core.state.clock import state_of
from enact_dist.errors import ConfigError, MisuseError, ShardUnreachableError
from enact_dist.link.daemon.counters import OF_A_CONNECTION, described
from enact_dist.world.trees import shown_s

if TYPE_CHECKING:
    import argparse
    from collections.abc import Collection, Mapping, Sequence
    from pathlib import Path

    from enact_dist.link.daemon.health import ShardHealth
    from enact_dist.link.postgres.address import StoreAddress
    from enact_dist.world.listings import ShardInfo


def run_shard(options: argparse.Namespace) -> int:
    """Run one shard daemon in this process."""
    from enact_dist.config.environment import variable_of
    from enact_dist.config.read import load_config
    from enact_dist.link.daemon.process import run_shard as run_shard_daemon
    from enact_dist.link.daemon.settings import DRAIN_S, DaemonSettings
    from enact_dist.link.zenoh.tls import shard_keys

    target = cell_target(options)
    if is_endpoint(target):
        raise ConfigError(f"{target} is an endpoint; a shard needs the cell.toml: --cell FILE")
    environment = dict(os.environ)
    for key, found in (
        ("LISTEN", ",".join(options.listen or ())),
        ("ADVERTISE", ",".join(options.advertise or ())),
        ("FOLDER", options.folder),
        ("METRICS", options.metrics),
    ):
        if found:
            environment[variable_of(options.name, key)] = found
    if options.store:
        refuse_password(options.store)
        environment["ENACT_STORE"] = options.store

    def settings() -> DaemonSettings:
        # The name comes first: an override for a shard that is not there would blame the override.
        written = load_config(target).shard(options.name)
        config = load_config(target, environment=environment)
        shard = config.shard(options.name)
        drain_s = shard.drain_s if options.drain_s is None else options.drain_s
        if options.standby and not config.store:
            raise ConfigError(
                f"{config.path}: --standby needs a database that both daemons reach: write"
                ' store = "postgresql://…", or set ENACT_STORE'
            )
        return DaemonSettings(
            cell=config.name,
            shard=config.shard_settings(shard.name),
            listen=shard.listen,
            folder=shard.folder,
            store=store_of(config, shard.name),
            standby=options.standby,
            log=options.log,
            link_lease_s=config.ttl_s / 2,
            carrier=config.carrier,
            shared_bytes_max=config.shared_bytes_max,
            metrics=shard.metrics,
            written=written.advertise,
            keys=shard_keys(config.security, shard.name),
            names=config.key_holders,
            again=settings,
            drain_s=DRAIN_S if drain_s is None else drain_s,
        )

    return run_shard_daemon(settings())


def refuse_password(url: str) -> None:
    """Refuse an address of a database that shows its password in a command.

    Raises:
        MisuseError: It has one.
    """
    if without_password(url) != url:
        raise MisuseError(
            f"--store {without_password(url)}: every user of this host can see the password of a"
            " command; put the address into ENACT_STORE, or the password into ~/.pgpass"
        )


def store_of(config: CellConfig, shard: str) -> StoreAddress | None:
    """Return the place of a shard in the database of a cell; None: the cell has none."""
    from enact_dist.link.postgres.address import StoreAddress

    return StoreAddress(config.store, config.name, shard, config.lease_s) if config.store else None


def whole_store(config: CellConfig, folders: Collection[str]) -> StoreAddress:
    """Return the database of a cell, for a command that works on all shards in it.

    Raises:
        ConfigError: Folders are named.
        StoreError: psycopg is not installed.
    """
    from enact_dist.link.postgres.address import StoreAddress, require_driver

    if folders:
        raise ConfigError(
            f"--store names folders ({', '.join(folders)}), and this cell keeps its data in"
            f" {without_password(config.store)}: leave it out, all shards are found there"
        )
    require_driver(config.store)
    return StoreAddress(config.store, config.name, "", config.lease_s)


def refuse_database(config: CellConfig, does: str, remedy: str) -> None:
    """Refuse a command that works on folders in a cell whose data are in a database.

    Raises:
        ConfigError: They are.
    """
    if config.store:
        raise ConfigError(
            f"{config.path}: {does}, and this cell keeps its data in"
            f" {without_password(config.store)}: {remedy}",
            path=str(config.path),
        )


def refuse_shared(folders: Mapping[str, Path]) -> None:
    """Refuse two shards with one folder.

    Raises:
        ConfigError: There are two.
    """
    if len({folder.resolve() for folder in folders.values()}) < len(folders):
        raise ConfigError("two shards have the same folder; give each its own with --store")


def list_shards(options: argparse.Namespace) -> Output:
    """List all shards, also those that cannot be reached; why, if it is known, on a line each."""
    try:
        with open_cell(options) as cell:
            shards, own = cell.shards(), cell.statistics()
    except ShardUnreachableError:
        _print_holders(options)
        raise
    status = DONE if all(shard.reachable for shard in shards) else UNREACHABLE

    def problems() -> None:
        _print_holders(options)
        for shard in shards:
            if shard.problem:
                print(f"enact: shard {shard.name}: {shard.problem}", file=sys.stderr)

    def counters() -> None:
        _print_counters(shards, own)
        problems()

    if options.counters:
        return Output(shards, counters, status=status)
    return Output(shards, problems, rows=[*map(_row, shards)], status=status)


def _print_holders(options: argparse.Namespace) -> None:
    """Print who serves, who stands by and how many copies there are, if a database has the data."""
    from enact_dist.config.read import load_config

    target = cell_target(options)
    config = None if is_endpoint(target) else load_config(target)
    if config is None or not config.store:
        return
    from enact_dist.operate.doctor_store import overview

    for line in overview(config):
        print(f"enact: {line}", file=sys.stderr)


def _print_counters(shards: Sequence[ShardInfo], own: Mapping[str, int]) -> None:
    rows = [(shard.name, *row) for shard in shards for row in described(shard.counters)]
    rows += [("(this command)", *row) for row in described(own, OF_A_CONNECTION)]
    print_table(("shard", "counter", "value", "meaning", "what to do"), rows, empty="no counters")


def check_shards(options: argparse.Namespace) -> Output:
    """Ask shards how they are; status 3 if one does not answer, 1 if one grants no locks.

    *Alive*: the shard's dispatcher answers a request that came over its endpoint; a supervisor
    should restart one that is not alive.  *Ready*: it grants locks as well, so it neither waits
    for leases of before its start to end nor drains before its end; both pass by themselves.
    """
    found = _health(options)
    status = DONE if options.alive or all(shard.ready for shard in found) else FAILED
    if not all(shard.alive for shard in found):
        status = UNREACHABLE
    return Output(found, "\n".join(map(str, found)), status=status)


def _health(options: argparse.Namespace) -> list[ShardHealth]:
    from enact_dist.config.environment import security_of
    from enact_dist.link.daemon import health as shard_health
    from enact_dist.link.zenoh.tls import client_keys

    target, wait_s = cell_target(options), options.timeout_s
    if is_endpoint(target):
        keys = client_keys(security_of(os.environ, target), PROGRAM)
        return shard_health.of_endpoint(target, options.name, timeout_s=wait_s, keys=keys)
    from enact_dist.config.read import load_config

    config = load_config(target)
    names = [options.name] if options.name else [shard.name for shard in config.shards]
    endpoints = {
        name: (*config.shard(name).advertise, *config.shard(name).listen) for name in names
    }
    keys = client_keys(config.security, PROGRAM)
    found = shard_health.of_shards(config.name, endpoints, timeout_s=wait_s, keys=keys)
    return _with_reasons(config, found)


def _with_reasons(config: CellConfig, found: list[ShardHealth]) -> list[ShardHealth]:
    """Return the shards with what the cell's database says of those that do not answer."""
    if not config.store or all(one.alive for one in found):
        return found
    from enact_dist.operate.doctor_store import holders

    held = holders(config)
    silent = {one.name: held(one.name) for one in found if not one.alive and not one.problem}
    return [replace(one, problem=silent.get(one.name, one.problem)) for one in found]


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
