"""Names the place of a shard in a PostgreSQL database; loads no driver."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.config.types import without_password
from enact_dist.core.failover.lease import HolderRow
from enact_dist.errors import StoreError

if TYPE_CHECKING:
    import threading

    from enact_dist.link.store.gathering import Rows

LEASE_S_DEFAULT: Final = 2.0
"""How long a shard may answer after its last confirmed write, seconds."""


@dataclass(frozen=True, slots=True)
class StoreAddress:
    """The place of one shard in a database.

    Attributes:
        url: The database, with one host or several, as libpq reads it.
        lease_s: How long its daemon may answer after its last confirmed write, seconds.
    """

    url: str
    cell: str
    shard: str
    lease_s: float = LEASE_S_DEFAULT

    def __str__(self) -> str:
        """Return it for people, without a password."""
        return f"{without_password(self.url)} (shard {self.shard} of cell {self.cell})"


@dataclass(frozen=True, slots=True)
class FreeShard:
    """A shard that no process held when it was last seen.

    Attributes:
        seen: Its row.
        rows: What was read ahead of it, for this takeover or the next try; None: nothing.
        stopped: Breaks the takeover off.
    """

    address: StoreAddress
    seen: HolderRow
    rows: Rows | None = None
    stopped: threading.Event | None = None


class StandbyFigures(NamedTuple):
    """What a standby has counted since it began to stand by.

    Attributes:
        reloads: Times that it took keys, names and rights anew.
        reloads_refused: Times that it could not.
        slow_looks: Looks at the shard's row that took so long that the rest of them does not count.
    """

    reloads: int = 0
    reloads_refused: int = 0
    slow_looks: int = 0

    @property
    def in_words(self) -> str:
        """What an operator should know of them, with a blank before it."""
        return f" ({self.slow_looks} slow looks at its database)" if self.slow_looks else ""


_TO: Final = " > "


class NamedHolder(NamedTuple):
    """What `holder` of a shard's row says.

    Attributes:
        process: The process that serves the shard; "": none.
        to: The standby that the shard is to go to, or was given to; "": any.
    """

    process: str
    to: str = ""

    @classmethod
    def read(cls, text: str) -> NamedHolder:
        """Read it."""
        process, _, to = f" {text}".partition(_TO)
        return cls(process.strip(), to)

    @property
    def in_words(self) -> str:
        """Who has the shard, as a message says it."""
        if self.process or not self.to:
            return f"is served by process {self.process or 'unknown'}"
        return f"was given to process {self.to}"

    def __str__(self) -> str:
        """Return it as it is stored while a process serves."""
        return _TO.join(self) if self.to else self.process


class ShardHeldError(StoreError):
    """Another process serves the shard."""


def require_driver(url: str) -> None:
    """Refuse a database for which no driver is installed.

    Raises:
        StoreError: psycopg cannot be imported.
    """
    try:
        import psycopg  # noqa: F401 - whether it can be
    except ImportError as error:
        raise StoreError(
            f"the store {without_password(url)} needs psycopg, which cannot be imported ({error}):"
            " pip install -e '.[postgres]' in the clone of enact-dist"
        ) from error
