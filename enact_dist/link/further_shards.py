"""Connects a session to the shards of a placement that it learns of on the way."""

from __future__ import annotations

import logging
import threading
from typing import TYPE_CHECKING, Final

from enact_dist.errors import ConfigError, LinkError

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.core.messages import PlacementMap
    from enact_dist.link.carrier import Carrier
    from enact_dist.link.namesakes import Doubts

PAUSE_NS: Final = 1_000_000_000
"""How long after a failure nothing is tried: each try may open a session."""

_log = logging.getLogger("enact.link")


class FurtherShards:
    """Follows the placement of one session.  Thread-safe.

    It is called with the answer to whatever was asked, which stands, so it raises nothing: who
    got an error for a commit would write twice.

    Args:
        carrier: Connects to them.
        linked: The placement whose shards need no connecting.
        now_ns: The session's clock.
        count: Called with the name of what is to be counted.
        doubts: Told where the shards of a placement are; None where there can be no doubt.
    """

    def __init__(
        self,
        carrier: Carrier,
        linked: PlacementMap,
        now_ns: Callable[[], int],
        count: Callable[[str], None],
        doubts: Doubts | None = None,
    ) -> None:
        self._carrier, self._linked = carrier, linked
        self._doubts = doubts
        self._now_ns, self._count = now_ns, count
        self._mutex = threading.Lock()
        self._not_before_ns: int | None = None

    def follow(self, placement: PlacementMap) -> None:
        """Connect to the shards of a placement, if that was just learned.

        Where that fails it is tried again after a pause, and where another thread is at it,
        whoever gets the next answer looks again.
        """
        if placement is self._linked or not self._mutex.acquire(blocking=False):
            return
        try:
            if self._not_before_ns is not None and self._now_ns() < self._not_before_ns:
                return
            if placement != self._linked:
                self._hear(placement)
                self._carrier.add_endpoints(placement.shards)
            self._linked, self._not_before_ns = placement, None
        except ConfigError as error:  # an endpoint that never can be reached is told once
            self._linked, self._not_before_ns = placement, None
            self._count("connects_failed")
            _log.error("not every shard of the cell can be reached: %s", error)
        except Exception as error:  # noqa: BLE001 - the answer that brought us here stands
            self._not_before_ns = self._now_ns() + PAUSE_NS
            self._count("connects_failed")
            _log.warning("not every shard of the cell is connected, trying again: %s", error)
        finally:
            self._mutex.release()

    def _hear(self, placement: PlacementMap) -> None:
        for text in self._doubts.hear(placement.shards) if self._doubts is not None else ():
            self._count("shards_doubted")
            _log.error("%s", text)

    def check(self, shard: str) -> None:
        """Raise if a shard is not to be trusted.

        Raises:
            LinkError: More than one daemon serves it; the message names them.
        """
        text = self._doubts.about(shard) if self._doubts is not None else ""
        if text:
            raise LinkError(text)
