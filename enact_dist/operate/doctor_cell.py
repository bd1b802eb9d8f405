"""Compares a `cell.toml` with the cell that runs: what the shards say of themselves.

Clients go by what the shards say, so they work with an old file, too; a shard that is started with
another file than the rest does not.
"""

from __future__ import annotations

import enum
import os
import shutil
import socket
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from enact_dist.core.state.clock import is_kept

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping
    from pathlib import Path

    from enact_dist.config.types import CellConfig, ShardConfig
    from enact_dist.core.protocol.answers import Welcome
    from enact_dist.core.protocol.parts import PlacementMap
    from enact_dist.world.listings import ShardInfo

ACTOR: Final = "enact"
"""How the cell sees these checks."""
ASK_S: Final = 0.5
"""How long each place at which a shard is expected may take to say which daemon serves it."""
DISK_BYTES_WARN: Final = 1_000_000_000
DISK_BYTES_FAIL: Final = 50_000_000

_RESTART = (
    "take the file that the shards were started with; or stop them all, move entities with"
    " enact shard rebalance, and start all with this one"
)


class Level(enum.Enum):
    """How grave a finding is."""

    OK = "ok"
    WARN = "warn"
    FAIL = "FAIL"


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one check.

    Attributes:
        level: How grave it is.
        remedy: What to do; empty where nothing has to be done.
    """

    level: Level
    subject: str
    text: str
    remedy: str = ""


def ok(subject: str, text: str) -> Finding:
    """Return a finding that asks for nothing."""
    return Finding(Level.OK, subject, text)


def warn(subject: str, text: str, remedy: str) -> Finding:
    """Return a finding that may become a problem."""
    return Finding(Level.WARN, subject, text, remedy)


def fail(subject: str, text: str, remedy: str = "") -> Finding:
    """Return a finding with which the cell does not work."""
    return Finding(Level.FAIL, subject, text, remedy)


def differences(
    config: CellConfig | None, shards: Iterable[ShardInfo], welcomes: Mapping[str, Welcome]
) -> Iterator[Finding]:
    """Name what the running shards say otherwise than each other, or than the file."""
    placements = {name: welcome.placement for name, welcome in welcomes.items()}
    versions = {placement.version: name for name, placement in placements.items()}
    if len(versions) > 1:
        first, other = list(versions.values())[:2]
        yield fail(
            "placement",
            f"{first} and {other} were started with different shards or pins: {_shown(placements)}",
            "start all shards with the same cell.toml",
        )
    elif config is not None:
        for placement in list(placements.values())[:1]:
            yield from _placement(config, placement)
    if config is None:
        return
    running = {shard.name: shard for shard in shards if shard.reachable}
    for shard in config.shards:
        if shard.name in running:
            kept = is_kept(running[shard.name].epoch)
            if not config.store:
                yield from _folder(shard, kept=kept)
            elif not kept:
                yield fail(
                    f"store of {shard.name}",
                    "the running shard keeps its data in memory only, and this file names a store",
                    "save what is needed (enact world export), and start the shard with this file",
                )
    yield from _catalogue(config, welcomes)


def duplicate_daemons(
    cell: str, config: CellConfig | None, welcomes: Mapping[str, Welcome]
) -> Iterator[Finding]:
    """Name the shards that several daemons serve, at any endpoint known of them.

    Each shard is asked, too, at which further places others have named it.
    """
    from enact_dist.config.environment import security_of
    from enact_dist.link.client.duplicate_daemons import expected_places, serving, two_daemons
    from enact_dist.link.zenoh.tls import client_keys

    entries = [entry for welcome in welcomes.values() for entry in welcome.placement.shards]
    place = next((place for entry in entries for place in entry.endpoints), "")
    security = security_of(os.environ, place) if config is None else config.security
    keys = client_keys(security, ACTOR)
    if config is not None:
        entries += config.placement_map().shards
    for told in expected_places(cell, list(dict.fromkeys(entries)), timeout_s=ASK_S, keys=keys):
        entries += told
    places: dict[str, dict[str, None]] = {}
    for entry in entries:
        places.setdefault(entry.name, {}).update(dict.fromkeys(entry.endpoints))
    for shard, endpoints in places.items():
        if len(endpoints) < 2:
            continue
        found = serving(cell, shard, endpoints, timeout_s=ASK_S, keys=keys)
        if len(found) > 1:
            wrong, _, remedy = two_daemons(cell, shard, found).partition("; ")
            yield fail(f"shard {shard}", wrong, remedy)


def folders(config: CellConfig, kept: Collection[str]) -> Iterator[Finding]:
    """Check the disks of the shards that run with a folder, or may run, on this host."""
    host = socket.gethostname()
    for shard in config.shards:
        folder, running = shard.folder, shard.name in kept
        if folder is None:
            if not running:
                yield _without_folder(shard.name)
        elif running and not os.access(folder, os.W_OK | os.X_OK):
            text = f"{folder} is on another machine or another user's, where the shard runs"
            yield ok(f"disk of {shard.name}", text)
        elif shard.host in {"", host}:
            yield data_folder(shard.name, folder)


def _without_folder(shard: str) -> Finding:
    return warn(
        f"disk of {shard}",
        "no folder: everything is lost when the shard stops",
        f"write data_folder, or a folder in [shards.{shard}]",
    )


def data_folder(shard: str, folder: Path) -> Finding:
    """Check the disk on which a shard keeps, or will keep, its data."""
    subject = f"disk of {shard}"
    there = folder
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        user = os.environ.get("USER", str(os.getuid()))
        return fail(
            subject,
            f"{there} cannot be written by {user}",
            f"if shard {shard} is to run here, as {user}: sudo install -d -o {user} {folder}",
        )
    free = shutil.disk_usage(there).free
    text = f"{folder}: {free / 1e9:.1f} GB free"
    if free < DISK_BYTES_FAIL:
        return fail(subject, text, "free some space: a full disk stops the shard")
    if free < DISK_BYTES_WARN:
        return warn(subject, text, "free some space: a full disk stops the shard")
    return ok(subject, text)


def _placement(config: CellConfig, running: PlacementMap) -> Iterator[Finding]:
    """Compare which shards there are, and where entities live."""
    ours = config.placement_map()
    if running.version == ours.version:
        return
    names = sorted(shard.name for shard in running.shards)
    wanted = sorted(shard.name for shard in ours.shards)
    if names != wanted:
        text = f"shards {', '.join(wanted)}; the running cell has {', '.join(names)}"
    else:
        text = f"{_pins(ours)}; the running cell has {_pins(running)}"
    yield warn("cell.toml and cell", f"the file has {text}", _RESTART)


def _folder(shard: ShardConfig, *, kept: bool) -> Iterator[Finding]:
    """Compare whether a shard keeps what is committed."""
    subject = f"disk of {shard.name}"
    if shard.folder is None and kept:
        yield warn(
            subject,
            "the running shard keeps its data in a folder, this file names none: started with it,"
            " the shard would begin empty",
            f"write the folder into [shards.{shard.name}], or data_folder for all",
        )
    elif shard.folder is not None and not kept:
        yield warn(
            subject,
            f"the running shard has no folder, though this file names {shard.folder}: everything"
            " is lost when it stops",
            "save what is needed (enact world export), and start the shard with this file",
        )


def _catalogue(config: CellConfig, welcomes: Mapping[str, Welcome]) -> Iterator[Finding]:
    """Compare world contexts and what commits survive."""
    for name, welcome in welcomes.items():
        lacking = [world for world in config.worlds if world not in welcome.worlds]
        if lacking:
            yield warn(
                f"cell.toml and {name}",
                f"the shard has no world context {', '.join(lacking)} of this file",
                "restart it with this file, or: "
                + "; ".join(f"enact world create {world}" for world in lacking),
            )
        known = {entry.name: entry.durability for entry in welcome.aspects}
        for aspect in config.aspects:
            asked = aspect.durability.value if aspect.durability is not None else ""
            if asked and known.get(aspect.name, asked) != asked:
                yield warn(
                    f"cell.toml and {name}",
                    f"aspect {aspect.name} is {known[aspect.name]} there and {asked} in this file",
                    "start all shards with the same cell.toml",
                )


def _shown(placements: Mapping[str, PlacementMap]) -> str:
    return "; ".join(
        f"{name} has shards {', '.join(sorted(shard.name for shard in placement.shards))}"
        f" and {_pins(placement)}"
        for name, placement in placements.items()
    )


def _pins(placement: PlacementMap) -> str:
    return ", ".join(f"{pin.pattern} pinned to {pin.shard}" for pin in placement.pins) or "no pins"
