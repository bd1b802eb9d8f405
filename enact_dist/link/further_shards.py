"""Connects a session to shards of a placement that it learns about later."""

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
"""Pause after a failure: each attempt may open a session."""

_log = logging.getLogger("enact.link")


class FurtherShards:
    """Follows the placement of one session.  Thread-safe.

    It runs after each answer, which stays valid, so it raises nothing: a caller that got an error
    for its commit would write twice.

    Args:
        carrier: Connects to the shards.
        linked: The placement whose shards are connected already.
        now_ns: The session's clock.
        count: Called with the name of a counter.
        doubts: Receives the endpoints in a placement; None: there can be no doubt.
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
        """Connect to the shards of a placement that was just received.

        After a failure it tries again after a pause; if another thread is connecting, the next
        answer triggers another look.
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
        except ConfigError as error:  # an endpoint that can never be reached is logged once
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
        """Raise if a shard is served by several daemons.

        Raises:
            LinkError: More than one daemon serves the shard; the message names them.
        """
        text = self._doubts.about(shard) if self._doubts is not None else ""
        if text:
            raise LinkError(text)
