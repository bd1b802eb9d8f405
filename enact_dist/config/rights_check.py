"""Checks `[rights]` of a `cell.toml` against the actors, worlds and endpoints of the cell."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from enact_dist.config.rights import DATA_LISTS, NAME_MAX, NAMED_LISTS, AllowTable
from enact_dist.config.table import Table, suggestion
from enact_dist.core.rights.rules import fork_path
from enact_dist.core.shard.owners import SHARD_PREFIX

if TYPE_CHECKING:
    from enact_dist.config.types import CellConfig

_LOOPBACK: Final = re.compile(r"tcp/(127\.\d+\.\d+\.\d+|\[::1\]|localhost):\d+\Z")


def check_rights(root: Table, config: CellConfig) -> None:
    """Check both tables against the rest of the cell.

    Raises:
        ConfigError: A name is unknown, a rule stands twice, or names would be no more than words.
    """
    if config.rights is None:
        return
    table = root.table("rights")
    for group, members in config.rights.groups.items():
        if not isinstance(members, list) or not all(isinstance(one, str) for one in members):
            table.table("groups").refuse(group, f"group {group!r} is an array of names")
        for member in members:
            if member.startswith("@"):
                problem = f"group {group!r} contains {member!r}; a group contains names only"
                table.table("groups").refuse(group, problem)
            _check_name(table.table("groups"), group, member, config)
    for uid, name in config.rights.uids.items():
        if not uid.isdecimal() or name.startswith(SHARD_PREFIX) or "*" in name:
            problem = f'{uid!r} = {name!r} is no user with a name; write 1001 = "camera"'
            table.table("uids").refuse(uid, problem)
        if name.startswith("@"):
            _check_name(table.table("uids"), uid, name, config)
    for name in config.rights.observe:
        _check_name(table, "observe", name, config)
    seen: dict[AllowTable, int] = {}
    for number, (rule, one) in enumerate(
        zip(table.tables("allow"), config.rights.allow, strict=True), 1
    ):
        _check_rule(rule, one, config)
        if one in seen:
            rule.refuse("who", f"rule {number} of [[rights.allow]] repeats rule {seen[one]}")
        seen[one] = number


def check_clients(root: Table, config: CellConfig) -> None:
    """Refuse names of clients that could be taken for others, where names prove something.

    Raises:
        ConfigError: One is kept for shards or the authority, or is too long.
    """
    has_keys = config.security.keys is not None
    if not has_keys and config.rights is None:
        return
    cannot = f"cannot have {'a key' if has_keys else 'rights'}"
    for name in config.key_holders:
        problem = ""
        if name.startswith(SHARD_PREFIX) or name == "ca":
            problem = (
                f"{name!r} {cannot}: 'ca' and names that begin with {SHARD_PREFIX!r} belong to the"
                " authority and to shards; choose another name"
            )
        elif len(name) > NAME_MAX:
            problem = (
                f"{name!r} {cannot}: a certificate has room for {NAME_MAX} characters of a name;"
                " choose a shorter one"
            )
        if problem and name in config.actor_names:
            root.table("actors").refuse(name, problem)
        elif problem and name in config.security.operators:
            root.table("security").refuse("operators", problem)
        elif problem:
            root.table("rights").refuse("programs", problem)


def refuse_unproven_names(root: Table, config: CellConfig) -> None:
    """Refuse rights where a client's name would be its own word.

    Raises:
        ConfigError: There are no keys, and a shard listens beyond its host or clients need not
            use its socket.
    """
    if config.rights is None or config.security.keys is not None:
        return
    ends = [end for shard in config.shards for end in (*shard.listen, *shard.advertise)]
    far = next((end for end in ends if not _LOOPBACK.match(end)), "")
    if far or config.carrier != "socket":
        what = f"endpoint {far}" if far else f"carrier = {config.carrier!r}"
        root.refuse(
            "rights",
            f"[rights] with {what}: over Zenoh any program without a key can claim any"
            ' name; write [security] with keys = "keys", or keep all endpoints on the loopback and'
            ' write carrier = "socket"',
        )


def _check_rule(table: Table, rule: AllowTable, config: CellConfig) -> None:
    for name in rule.who:
        _check_name(table, "who", name, config)
    for key in (*DATA_LISTS, "fork", *NAMED_LISTS):
        found = getattr(rule, key)
        for index, one in enumerate(found):
            if one in found[:index]:
                table.refuse(key, f"{one!r} stands twice in {key!r} of a rule")
    for key in DATA_LISTS:
        for one in getattr(rule, key):
            _check_world(table, key, one.partition(":")[0], config)
    for one in rule.fork:
        _check_world(table, "fork", fork_path(one).partition("/")[0], config)


def _check_name(table: Table, key: str, name: str, config: CellConfig) -> None:
    """Refuse a name that nothing has; one with a star may have no bearer yet."""
    assert config.rights is not None
    if name.startswith("@"):
        groups = config.rights.groups
        if name[1:] not in groups:
            known = ", ".join(sorted(groups)) or "none"
            close = suggestion(name[1:], groups)
            table.refuse(key, f"unknown group {name!r}{close} (known: {known})")
        return
    known_names = config.rights.names(config.actor_names, config.security.operators)
    if "*" not in name and name not in known_names:
        known = ", ".join(sorted(known_names)) or "none"
        table.refuse(
            key,
            f"unknown actor {name!r}{suggestion(name, known_names)}; a program that is no actor"
            f" stands in `programs` of [rights] (known: {known})",
        )


def _check_world(table: Table, key: str, world: str, config: CellConfig) -> None:
    assert config.rights is not None
    made = {fork_path(one).partition("/")[2] for rule in config.rights.allow for one in rule.fork}
    made |= {one for rule in config.rights.allow for one in rule.register}
    known = {*config.worlds, *made}
    if "*" not in world and world not in known:
        table.refuse(
            key,
            f"unknown world context {world!r}{suggestion(world, known)}"
            f" (known: {', '.join(sorted(known)) or 'none'})",
        )
