"""What a store needs of the medium that keeps its rows and large bodies.

`link.store.medium` keeps them in a folder, `link.postgres.medium` in a PostgreSQL database.  Both
hold the same rows, byte for byte.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from contextlib import AbstractContextManager
    from pathlib import Path

    from enact_dist.link.folder.blobs import Blob, Mapped
    from enact_dist.link.lease import Holding
    from enact_dist.link.store.database import DatabaseRow


class RowSource(Protocol):
    """Gives the rows of a store at its start."""

    def rows(self) -> Iterator[DatabaseRow]:
        """Yield all rows, oldest identity first."""


class BodySource(Protocol):
    """Gives the large bodies of a store at its start."""

    def place(self, name: str) -> Path | str:
        """Return where a body is, for people."""

    def map(self, blob: Blob, *, whole: bool) -> Mapped:
        """Return the bytes of a body; `whole` also checks their content.

        Raises:
            DamagedBlobError: It is missing, of another length, or (`whole`) its checksum differs.
        """


class Bodies(Protocol):
    """Takes the large bodies of a batch before the rows that name them."""

    def write(self, body: bytes | memoryview, *, durable: bool) -> Blob:
        """Take a body under a new name."""

    def force(self, blob: Blob) -> Blob:
        """Make a body durable that was written without."""

    def sync_names(self) -> None:
        """Make the names of all bodies taken so far durable."""


class Medium(Protocol):
    """Keeps the rows and bodies of one store.  Used by one thread at a time."""

    @property
    def name(self) -> str:
        """Where it is, for messages."""

    @property
    def holding(self) -> Holding | None:
        """For how long this process holds the shard; None: until `close`."""

    @property
    def bodies(self) -> Bodies:
        """Its large bodies."""

    def commit(
        self,
        batch: int,
        rows: Sequence[DatabaseRow],
        gone: Sequence[int],
        unnamed: Iterable[Blob] = (),
        *,
        forced: bool,
    ) -> None:
        """Put `rows` and delete those with an id in `gone`, atomically.

        Args:
            batch: Number of this batch, one more than that of the last.
            rows: With new bodies.
            gone: Ids of deleted rows.
            unnamed: Bodies that no row names any more.
            forced: Whether everything so far must survive a power cut when this returns.
        """

    @property
    def tired(self) -> bool:
        """Whether `rest` has something to do."""

    def rest(self) -> None:
        """Do what can wait until a batch is acknowledged."""

    def close(self) -> None:
        """Release what is held; idempotent."""

    def errors(self) -> AbstractContextManager[None]:
        """Return a context that raises a `StoreError` in place of the medium's own errors."""
