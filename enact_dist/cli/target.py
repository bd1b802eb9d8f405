"""The cell that a command names: by a `cell.toml` or an endpoint."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

from enact_dist.errors import ConfigError

if TYPE_CHECKING:
    import argparse

    from enact_dist.config.types import CellConfig
    from enact_dist.world.cell import Cell

CELL_VARIABLE: Final = "ENACT_CELL"
CELL_DEFAULT: Final = "cell.toml"
TIMEOUT_S: Final = 5.0
PROGRAM: Final = "enact"
"""How a cell sees the command line, unless an actor is named."""


def cell_target(options: argparse.Namespace) -> str:
    """Return the `cell.toml` or endpoint that the command names.

    Raises:
        ConfigError: None is named and none lies here.
    """
    named = options.cell or os.environ.get(CELL_VARIABLE)
    if named:
        return str(named)
    if not Path(CELL_DEFAULT).is_file():
        raise ConfigError(
            f"no cell: there is no {CELL_DEFAULT} in {Path.cwd()}; name one with --cell FILE or"
            f" --cell tcp/host:7447, or set {CELL_VARIABLE} (docs/cell.md explains the file)"
        )
    return CELL_DEFAULT


def is_endpoint(target: str) -> bool:
    """Say whether a cell is named by an endpoint instead of a file."""
    protocol, slash, address = target.partition("/")
    return bool(slash) and protocol in {"tcp", "tls", "quic", "udp", "ws"} and ":" in address


def cell_config(options: argparse.Namespace) -> CellConfig:
    """Return the configuration of the cell that the command names.

    Raises:
        ConfigError: It names an endpoint, or the file cannot be used.
    """
    from enact_dist.config.read import load_config

    target = cell_target(options)
    if is_endpoint(target):
        raise ConfigError(f"{target} is an endpoint; this command needs the cell.toml: --cell FILE")
    return load_config(target)


def open_cell(options: argparse.Namespace, *, observer: bool = True, actor: str = "") -> Cell:
    """Join the cell that the command names.

    Args:
        options: Of a verb with the option `--cell`.
        observer: Only look.
        actor: How others see this process; `enact` unless given.

    Raises:
        ConfigError: The cell is named wrongly.
        ShardUnreachableError: No shard answered in time.
    """
    from enact_dist.world.connecting import connect

    timeout_s = getattr(options, "timeout_s", TIMEOUT_S)
    return connect(
        cell_target(options),
        actor=actor or PROGRAM,
        timeout_s=timeout_s,
        request_timeout_s=timeout_s,
        observer=observer,
    )


def see_modules(cell_file: Path | None = None, *, runs_cell: bool = True) -> None:
    """Let ``MODULE:CLASS`` name a module beside the cell.toml, or of the working folder.

    The folder of a cell.toml whose program is to run comes first.  Any other folder comes last:
    no file in it hides an installed module.

    Args:
        cell_file: The cell.toml, if there is one.
        runs_cell: Whether the command runs the cell's program, and does not only look at the cell.
    """
    folders = [os.getcwd()]  # noqa: PTH109 (sys.path holds text)
    if cell_file is not None:
        beside = str(cell_file.absolute().parent)
        if runs_cell and sys.path[:1] != [beside]:
            sys.path.insert(0, beside)
        folders.insert(0, beside)
    sys.path.extend(folder for folder in dict.fromkeys(folders) if folder not in sys.path)
