"""`enact cell keys init|make|ls|renew|revoke`: the keys of a cell, on the host that makes them."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from enact_dist.cli.target import cell_config
from enact_dist.cli.verbs import DONE, FAILED, Output
from enact_dist.config.table import suggestion
from enact_dist.errors import ConfigError
from enact_dist.extras import require

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from enact_dist.config.types import CellConfig
    from enact_dist.operate.keys import KeyOwner, KeyState


def init(options: argparse.Namespace) -> Output:
    """Make the authority."""
    config, folder = _cell(options)
    from enact_dist.operate.keys import authority_folder, make_authority

    there = authority_folder(folder, options.authority)
    made = make_authority(config.name, there)
    text = (
        f"the authority of cell {config.name} is in {there}, valid for 10 years\n"
        f"never copy {there} to another host: any program that has its private key can make a key"
        " for any name. Keep a copy of it offline\n"
        "next: enact cell keys make"
    )
    return Output({"authority": made}, text)


def make(options: argparse.Namespace) -> Output:
    """Make the keys that are missing."""
    config, folder = _cell(options)
    from enact_dist.operate.keys import key_states

    chosen = _chosen(config, options.names)
    missing = [one for one in key_states(folder, chosen) if one.certificate is None]
    return _made(
        missing,
        folder,
        options,
        nothing="each of these names has a key; enact cell keys renew replaces it",
    )


def renew(options: argparse.Namespace) -> Output:
    """Replace keys by new ones."""
    config, folder = _cell(options)
    from enact_dist.operate.keys import key_states

    states = key_states(folder, _chosen(config, options.names))
    due = [one for one in states if options.names or (one.certificate and one.problem)]
    return _made(due, folder, options, nothing="no key is due; name one to renew it all the same")


def revoke(options: argparse.Namespace) -> Output:
    """Bar all keys so far of some names."""
    config, folder = _cell(options)
    from enact_dist.operate.keys import revoke as note

    file = note(folder, _chosen(config, options.names))
    names = ", ".join(options.names)
    text = (
        f"the keys so far of {names} are on the list {file}\n"
        "next: copy the list to the key folder of each shard's host, and there: enact shard reload"
        " --all\n"
        f"for new keys: enact cell keys renew {' '.join(options.names)}"
    )
    return Output({"revoked": options.names, "list": file}, text)


def list_keys(options: argparse.Namespace) -> Output:
    """List what the key folder has; status 1 if there is something to do."""
    config, folder = _cell(options)
    from enact_dist.operate.keys import key_states, owners_of

    states = key_states(folder, owners_of(config), others=True)
    rows = [_row(one) for one in states]
    status = FAILED if any(one.problem for one in states) else DONE
    return Output([_facts(one) for one in states], rows=rows, status=status)


def _made(
    states: Sequence[KeyState], folder: Path, options: argparse.Namespace, *, nothing: str
) -> Output:
    """Make keys; return what was made and where it has to go."""
    from enact_dist.operate.keys import Authority, authority_folder, key_states, write_keys

    if not states:
        return Output([], nothing)
    authority = Authority.load(authority_folder(folder, options.authority))
    for one in states:
        write_keys(authority, one.owner, folder)
    made = key_states(folder, [one.owner for one in states])
    lines = [f"made {one.owner.name}.crt and {one.owner.name}.key, {_until(one)}" for one in made]
    lines.append(
        f"they are in {folder}: copy ca.pem and the two files of each name to the key folder of the"
        " host where it runs (mode 0600), and a shard's to no other"
    )
    if any(one.owner.is_shard for one in made):
        lines.append("a running shard takes new files with: enact shard reload NAME")
    return Output([_facts(one) for one in made], "\n".join(lines))


def _cell(options: argparse.Namespace) -> tuple[CellConfig, Path]:
    """Return the cell and its key folder.

    Raises:
        ConfigError: The cell has no keys, or this Python cannot make any.
    """
    config = cell_config(options)
    if config.security.keys is None:
        raise ConfigError(
            f'{config.path} names no key folder: write [security] with keys = "keys", and tls/'
            " endpoints (docs/security.md)",
            path=str(config.path),
        )
    require("the making of keys", "keys", "cryptography")
    return config, config.security.keys


def _chosen(config: CellConfig, names: Iterable[str]) -> list[KeyOwner]:
    """Return the owners with these names; all without any.

    Raises:
        ConfigError: The cell has no such name.
    """
    from enact_dist.operate.keys import owners_of

    known = {owner.name: owner for owner in owners_of(config)}
    for name in names:
        if name not in known:
            raise ConfigError(
                f"{config.path} has no {name!r}{suggestion(name, known)} (it has"
                f" {', '.join(known)}); add it to [security] operators to give it a key"
            )
    return [known[name] for name in dict.fromkeys(names)] or list(known.values())


def _row(state: KeyState) -> tuple[object, ...]:
    found = state.certificate
    return (
        state.owner.name,
        "shard" if state.owner.is_shard else "client",
        _until(state) if found else "-",
        ", ".join(found.hosts) if found and found.hosts else "-",
        state.problem or "-",
    )


def _until(state: KeyState) -> str:
    assert state.certificate is not None
    end_s = state.certificate.ends_s
    days = (end_s - time.time()) / 86_400
    return f"{time.strftime('%Y-%m-%d', time.gmtime(end_s))} ({days:.0f} days)"


def _facts(state: KeyState) -> dict[str, Any]:
    found = state.certificate
    return {
        "name": state.owner.name,
        "use": "shard" if state.owner.is_shard else "client",
        "starts_s": found.starts_s if found else None,
        "ends_s": found.ends_s if found else None,
        "hosts": found.hosts if found else (),
        "certificate": state.files.certificate,
        "private_key": state.files.private_key,
        "problem": state.problem,
    }
