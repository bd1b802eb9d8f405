"""The folders of a stopped cell, opened together and changed in steps.

Each step is durable before the next one, so a later run completes one that was killed anywhere.
While a folder is marked (`link.folder.moving_marks`), no shard starts from it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

from enact_dist.core.protocol.records import Persist, Record, Recovered
from enact_dist.errors import StoreError
from enact_dist.link.store.store import Store, open_store, read_store
from enact_dist.terms import Durability


class _Silent:
    """Ignores all reports."""

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *_facts: None


SILENT: Final[Any] = _Silent()
"""Takes the progress of a run whose caller wants none."""


@contextmanager
def opened(
    folders: Mapping[str, Path], act: Callable[[str], None] | None = None, *, unix_s: int = 0
) -> Iterator[tuple[dict[str, Store], dict[str, Recovered]]]:
    """Open the folder of each shard; yield the stores and what they have stored.

    Args:
        folders: The folder of each shard.
        act: Called before each is opened to be changed; None: all are only read, without stores.
        unix_s: The wall clock, seconds since 1970.

    Raises:
        StoreError: One is in use, damaged or not writable.
    """
    stores: dict[str, Store] = {}
    stored: dict[str, Recovered] = {}
    with ExitStack() as undo:
        for name, folder in folders.items():
            try:
                if act is None:
                    stored[name] = undo.enter_context(read_store(folder))
                else:
                    act(f"open {name}")
                    stores[name], stored[name] = open_store(folder, unix_s=unix_s, moving=True)
                    undo.callback(stores[name].close)
            except StoreError as error:
                raise StoreError(f"shard {name}: {error}", path=error.path) from error
        yield stores, stored


def write(store: Store, records: tuple[Record, ...]) -> None:
    """Store records in one durable batch."""
    store.write([Persist(0, records, Durability.DURABLE)])


def refuse_obstacles(nothing: str, obstacles: list[str]) -> None:
    """Refuse a run that something stands in the way of.

    Raises:
        StoreError: There are obstacles; it names the first ones.
    """
    if obstacles:
        more = f"; and {len(obstacles) - 3} more" if len(obstacles) > 3 else ""
        raise StoreError(f"{nothing}: {'; '.join(obstacles[:3])}{more}")
