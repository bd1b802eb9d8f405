"""Compares the rights of a cell with what its actors declare: stale, missing and unused ones."""

from __future__ import annotations

import itertools
from difflib import SequenceMatcher
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.actor.uses import ActorDeclaration, declared_rights
from enact_dist.config.rights import (
    DATA_LISTS,
    RIGHTS_FILE,
    AllowTable,
    array_of,
    compiled_rights,
    text_of_declared,
)
from enact_dist.core.rights.rules import Rights, data_path
from enact_dist.patterns import patterns_overlap

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from enact_dist.config.types import CellConfig

SIMILAR: Final = 0.7
"""From here on (0 to 1) the names of data are similar."""
_MEANS: Final = {key: "read" if key == "read" else "write" for key in DATA_LISTS}
"""What an actor has to declare for a key of a rule to be of use."""


class RightsFinding(NamedTuple):
    """A difference between rights and declarations.

    Attributes:
        kind: "rights stale", "right missing" or "right unused".
        actor: The actor concerned, "" where it is not one alone.
    """

    kind: str
    actor: str
    text: str


def differences(config: CellConfig, actors: Sequence[ActorDeclaration]) -> Iterator[RightsFinding]:
    """Yield where the rights of a cell differ from what its actors, all of them, declare."""
    if config.rights is None or not actors:
        return
    declared = declared_rights(actors)
    if config.rights.default == "declared":
        yield from _stale(config, declared)
    else:
        yield from _missing(config, declared)
    yield from _unused(config, declared)


def _stale(config: CellConfig, declared: Sequence[AllowTable]) -> Iterator[RightsFinding]:
    """Find a `rights.toml` that does not say what the actors declare."""
    file = config.path.parent / RIGHTS_FILE
    try:
        found = file.read_text("utf-8")
    except OSError:
        found = ""
    if found != text_of_declared(declared):
        what = "differs from what the actors declare" if found else "is missing"
        remedy = "write it with enact actor check --rights, then run enact shard reload --all"
        yield RightsFinding("rights stale", "", f"{file} {what}; {remedy}")


def _missing(config: CellConfig, declared: Sequence[AllowTable]) -> Iterator[RightsFinding]:
    """Find what actors declare and no rule gives."""
    assert config.rights is not None
    rights = compiled_rights(
        config.rights,
        config.path,
        actors=config.actor_names,
        operators=config.security.operators,
    )
    for needed in declared:
        (name,) = needed.who
        lacks = {
            key: [one for one in getattr(needed, key) if not rights.may(name, key, data_path(one))]
            for key in ("read", "write")
        }
        if any(lacks.values()):
            lines = [f"{key} = {array_of(found)}" for key, found in lacks.items() if found]
            near = _closest(config.rights.allow, rights, name, lacks)
            text = f'[[rights.allow]]\nwho = "{name}"\n' + "\n".join(lines)
            yield RightsFinding(
                "right missing",
                name,
                f"actor {name} declares data that no rule gives to it{near}; add to"
                f" {config.path.name}:\n{text}",
            )


def _closest(
    rules: Sequence[AllowTable], rights: Rights, name: str, lacks: Mapping[str, Sequence[str]]
) -> str:
    """Return which rule comes closest to giving an actor what it lacks; "" if none does.

    A rule for this actor that gives some of it comes before one for other names, and both before
    one for data of a similar name.
    """
    found = []
    for number, rule in enumerate(rules, 1):
        own = any(rights.means(who, name) for who in rule.who)
        for key, needs in _MEANS.items():
            for one, path in itertools.product(getattr(rule, key), lacks[needs]):
                near = patterns_overlap(data_path(one), data_path(path))
                alike = SequenceMatcher(None, one, path).ratio()
                if near or alike >= SIMILAR:
                    text = f"rule {number} gives {key} of {one} to {', '.join(rule.who)}"
                    found.append((near and own, near, own, alike, text))
    return f" ({max(found)[-1]})" if found else ""


def _unused(config: CellConfig, declared: Sequence[AllowTable]) -> Iterator[RightsFinding]:
    """Find rules for data that none of their actors declares.

    A rule for anything but actors, or with a star in a name, cannot be judged.
    """
    assert config.rights is not None
    of = {needed.who[0]: needed for needed in declared}
    for number, rule in enumerate(config.rights.allow, 1):
        who = [
            name
            for each in rule.who
            for name in (config.rights.members(each[1:]) if each.startswith("@") else (each,))
        ]
        if not who or any(name not in of for name in who):
            continue
        for key, needs in _MEANS.items():
            for one in getattr(rule, key):
                wanted = [data_path(path) for name in who for path in getattr(of[name], needs)]
                if not any(patterns_overlap(data_path(one), path) for path in wanted):
                    yield RightsFinding(
                        "right unused",
                        who[0] if len(who) == 1 else "",
                        f"rule {number} of [[rights.allow]] gives {key} of {one} to"
                        f" {', '.join(who)}, and none of them declares it; remove it, unless their"
                        " code asks for more than they declare",
                    )
