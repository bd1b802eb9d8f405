"""Checks the keys of a cell: the files of this host, and the certificates that shards show."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from enact_dist.core.shard.owners import SHARD_PREFIX
from enact_dist.errors import ConfigError
from enact_dist.link.zenoh.endpoints import split_endpoint
from enact_dist.link.zenoh.tls import (
    AUTHORITY_KEY,
    DAY_S,
    RENEW_DAYS,
    KeyFiles,
    client_keys,
    day_of,
    hosts_missing,
    look,
    own_certificate,
    wrong_name,
)
from enact_dist.operate.doctor_cell import ACTOR, Finding, fail, ok, warn

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from enact_dist.config.types import CellConfig
    from enact_dist.link.zenoh.tls import Certificate

_RENEW = "renew it on the host that makes the keys: enact cell keys renew {name}"


def keys(config: CellConfig) -> Iterator[Finding]:
    """Check the key folder of this host, then each endpoint of the shards; no keys, no findings."""
    folder = config.security.keys
    if folder is None:
        return
    yield from _files(config, folder)
    try:
        files = client_keys(config.security, ACTOR)
        assert files is not None
        files.check()
    except ConfigError as error:
        yield fail("keys", str(error), "see docs/security.md")
        return
    yield ok("keys", f"this program uses the key of {files.name} in {folder}")
    for shard in config.shards:
        for endpoint in shard.advertise:
            yield from _shown(shard.name, endpoint, files)


def _files(config: CellConfig, folder: Path) -> Iterator[Finding]:
    """Check the files in a key folder, each name once."""
    names = sorted(file.stem for file in folder.glob("*.crt"))
    if (folder / AUTHORITY_KEY).exists():
        yield fail(
            "authority",
            f"{folder / AUTHORITY_KEY} is the authority's private key, beside keys of this host:"
            " any program that has it can make a key for any name",
            "keep it on the host that makes the keys alone, and delete it here",
        )
    good: list[Certificate] = []
    for name in names:
        subject = f"key of {name}"
        try:
            found = own_certificate(KeyFiles(folder, name))
        except ConfigError as error:
            yield fail(subject, str(error), "copy the files of this name again")
            continue
        endpoints = _endpoints(config, name)
        hosts = (split_endpoint(endpoint)[1].strip("[]") for endpoint in endpoints)
        if problem := found.problem(time.time()):
            yield fail(subject, f"it {problem}", _RENEW.format(name=name))
        elif missing := hosts_missing(found, hosts):
            text = f"it is not for {', '.join(missing)}, where cell.toml has the shard"
            yield fail(subject, text, _RENEW.format(name=name))
        elif ending := _ending(found):
            yield warn(subject, ending, _RENEW.format(name=name))
        else:
            good.append(found)
    if good:
        first = min(good, key=lambda one: one.ends_s)
        end = f"valid, the first of them ({first.name}) until {day_of(first.ends_s)}"
        yield ok("key files", f"{len(good)} of {len(names)} in {folder} are {end}")


def _endpoints(config: CellConfig, name: str) -> tuple[str, ...]:
    shard = name.removeprefix(SHARD_PREFIX)
    known = [one for one in config.shards if name != shard and one.name == shard]
    return known[0].advertise if known else ()


def _ending(found: Certificate) -> str:
    """Return how soon a certificate ends, if it does soon."""
    days = (found.ends_s - time.time()) / DAY_S
    return f"it ends in {days:.0f} days, on {day_of(found.ends_s)}" if days < RENEW_DAYS else ""


def _shown(shard: str, endpoint: str, files: KeyFiles) -> Iterator[Finding]:
    """Check the certificate at an endpoint; yield nothing where nothing listens."""
    subject = f"key at {shard}"
    seen = look(endpoint, files)
    if not seen.listens:
        return
    if reason := seen.reason or wrong_name(seen.certificate, shard):
        yield fail(subject, f"{endpoint}: {reason}", "see docs/security.md")
    elif seen.certificate is not None:
        if ending := _ending(seen.certificate):
            name = seen.certificate.name
            remedy = f"{_RENEW.format(name=name)}, copy it, and enact shard reload {shard}"
            yield warn(subject, f"{endpoint}: {ending}", remedy)
        else:
            until = day_of(seen.certificate.ends_s)
            yield ok(subject, f"{endpoint} shows {seen.certificate.name}, valid until {until}")
