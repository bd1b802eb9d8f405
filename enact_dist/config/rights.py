"""The tables `[security]` and `[rights]` of a `cell.toml`: who may do what.

Example::

    [security]
    keys = "keys"
    operators = ["ada"]

    [rights]
    uids = { 1001 = "camera", 10001 = "@vision" }

    [rights.groups]
    vision = ["camera*", "reconstruction"]

    [[rights.allow]]
    who = ["@vision", "logger"]
    read = ["online:**", "training:view/*/cloud"]

With ``default = "declared"`` the rules that follow from the actors' declarations are added; they
stand in `rights.toml` beside the file, since a shard does not import the modules of actors.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Final

from enact_dist.config.table import TableKey
from enact_dist.core.rights.rules import (
    ALL,
    PLAIN_RIGHTS,
    WRITING,
    Rights,
    Rule,
    data_path,
    fork_path,
)
from enact_dist.errors import ConfigError
from enact_dist.patterns import checked_pattern
from enact_dist.terms import checked_name

DEFAULTS: Final = ("declared", "none")
RIGHTS_FILE: Final = "rights.toml"
"""Name of the file with what follows from the declarations, beside the `cell.toml`."""
NAME_MAX: Final = 60
"""X.509 has room for 64 characters of a name, of which `~N` takes some once keys were revoked, and
an identity has as much."""
_USER: Final = re.compile(r"uid:\d{1,10}\Z")
REMEDY: Final = "write it with enact actor check --rights"


def _data(text: str) -> str:
    for part in data_path(text).split("/", 2):
        checked_pattern(part)
    return text


def _fork(text: str) -> str:
    for part in fork_path(text).split("/"):
        _world(part)
    return text


def _world(text: str) -> str:
    if "/" in text or ALL in text:
        raise ValueError(f"{text!r} names no world context")
    return checked_pattern(text)


_DATA: Final = TableKey(make=_data, example='"online:plan/*/joints"')
_WORLD: Final = TableKey(make=_world, example='"what_if*"')


@dataclass(frozen=True, slots=True)
class AllowTable:
    """The keys of a rule.

    Attributes:
        who: Names of actors and programs, with stars, or groups ("@vision").
        read: Data that they may see.
        write: Data that they may change, initialise and delete.
        change: Data that they may replace.
        init: Data that they may write where there is none.
        delete: Data that they may replace with null.
        fork: Forks that they may make.
        drop: World contexts that they may drop.
        register: World contexts that they may make.
        keep: Labels under which they may pin versions.
        break_locks: Whether they may break locks.
        resolve: Whether they may abort prepared locks and settle alarms.
    """

    who: Annotated[tuple[str, ...], TableKey(example='"planner"')]
    read: Annotated[tuple[str, ...], _DATA] = ()
    write: Annotated[tuple[str, ...], _DATA] = ()
    change: Annotated[tuple[str, ...], _DATA] = ()
    init: Annotated[tuple[str, ...], _DATA] = ()
    delete: Annotated[tuple[str, ...], _DATA] = ()
    fork: Annotated[tuple[str, ...], TableKey(make=_fork, example='"online -> what_if*"')] = ()
    drop: Annotated[tuple[str, ...], _WORLD] = ()
    register: Annotated[tuple[str, ...], _WORLD] = ()
    keep: Annotated[tuple[str, ...], TableKey(make=checked_pattern, example='"day/*"')] = ()
    break_locks: Annotated[bool, TableKey("break")] = False
    resolve: bool = False

    def rule(self) -> Rule:
        """Return it as the core takes it."""
        gives = [("read", data_path(one)) for one in self.read]
        gives += [(right, data_path(one)) for right in WRITING for one in self.write]
        gives += [(right, data_path(one)) for right in WRITING for one in getattr(self, right)]
        gives += [("fork", fork_path(one)) for one in self.fork]
        gives += [(right, one) for right in NAMED_LISTS for one in getattr(self, right)]
        given = {"break": self.break_locks, "resolve": self.resolve}
        return Rule(self.who, (*gives, *((right, ALL) for right, has in given.items() if has)))


DATA_LISTS: Final = ("read", "write", *WRITING)
NAMED_LISTS: Final = ("drop", "register", "keep")


@dataclass(frozen=True, slots=True)
class RightsConfig:
    """The table `[rights]`.

    Attributes:
        default: "declared": actors have the rights that they declare; "none": only `allow` counts.
        uids: Whose rights the processes of a user of a host have, by the user's number.
        groups: Names, or names with stars, of each group.
        programs: Names, beside those of the actors, that rules may mention.
        observe: Who may list sessions, locks, causes and the audit.
    """

    default: Annotated[str, TableKey(choices=DEFAULTS)] = "declared"
    uids: Mapping[str, str] = field(default_factory=dict)
    groups: Mapping[str, object] = field(default_factory=dict)
    programs: Annotated[
        tuple[str, ...], TableKey(make=partial(checked_name, "program", slashes=False))
    ] = ()
    observe: tuple[str, ...] = ("*",)
    allow: Annotated[tuple[AllowTable, ...], TableKey(table=AllowTable)] = ()

    def members(self, group: str) -> tuple[str, ...]:
        """Return the names of a group; none if there is no such group."""
        found = self.groups.get(group)
        return tuple(map(str, found)) if isinstance(found, list) else ()

    def names(self, actors: Iterable[str], operators: Iterable[str]) -> frozenset[str]:
        """Return the names that rules may mention."""
        users = (name for name in self.uids.values() if not name.startswith("@"))
        return frozenset((*actors, *users, *self.programs, *operators))


def _operator(text: str) -> str:
    return text if _USER.match(text) else checked_name("operator", text, slashes=False)


@dataclass(frozen=True, slots=True)
class SecurityConfig:
    """The table `[security]`; without keys, any program that reaches a port can join.

    Attributes:
        keys: The folder with this host's certificates and private keys; ``None``: the cell has
            none.
        operators: Names of people and tools that have a key and every right, or users of a host
            such as "uid:1000", whose processes have every right at its sockets.
    """

    keys: Annotated[Path | None, TableKey(variable="KEYS")] = None
    operators: Annotated[tuple[str, ...], TableKey(make=_operator)] = ()

    @property
    def key_holders(self) -> tuple[str, ...]:
        """The operators that have a key."""
        return tuple(name for name in self.operators if not _USER.match(name))


# ---------------------------------------------------------------- what a shard gets


def compiled_rights(
    rights: RightsConfig, path: Path, *, actors: Collection[str], operators: Collection[str]
) -> Rights:
    """Return the rights of a cell for its shards.

    Raises:
        ConfigError: `rights.toml` is missing or cannot be read.
    """
    allow = rights.allow
    if rights.default == "declared" and actors:
        allow = (*allow, *read_declared(path.parent / RIGHTS_FILE))
    rules = [one.rule() for one in allow]
    rules.append(Rule(rights.observe, ((PLAIN_RIGHTS[-1], ALL),)))
    return Rights(
        rules,
        groups={name: rights.members(name) for name in rights.groups},
        operators=operators,
        users={int(uid): name for uid, name in rights.uids.items()},
        known=rights.names(actors, operators),
        hint=f"[rights] of {path.name}",
    )


def read_declared(file: Path) -> tuple[AllowTable, ...]:
    """Read `rights.toml`.

    Raises:
        ConfigError: It is missing or no such file.
    """
    import tomllib  # no client needs it

    try:
        tables = tomllib.loads(file.read_text("utf-8")).get("allow", [])
        return tuple(
            AllowTable(
                tuple(each["who"]), tuple(each.get("read", ())), tuple(each.get("write", ()))
            )
            for each in tables
        )
    except OSError as error:
        problem = f"cannot read {file}: {error.strerror}; {REMEDY}"
        raise ConfigError(problem, path=str(file)) from error
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ConfigError(f"{file} cannot be used: {error}; {REMEDY}", path=str(file)) from error


def text_of_declared(rules: Iterable[AllowTable]) -> str:
    """Return `rights.toml` with these rules."""
    lines = ["# Written by `enact actor check --rights` from what the actors declare; do not edit."]
    for rule in rules:
        lines += ["", "[[allow]]", f"who = {array_of(rule.who)}"]
        for key in ("read", "write"):
            if found := getattr(rule, key):
                lines.append(f"{key} = {array_of(found)}")
    return "\n".join((*lines, ""))


def array_of(texts: Iterable[str]) -> str:
    """Return an array as TOML writes it."""
    return "[" + ", ".join(f'"{text}"' for text in texts) + "]"
