"""Frees the clients of a silent daemon whose shard another one may serve.

Cut off from the database alone, a daemon keeps its clients: they would ask it on and on and get no
answer.  So while it is silent it asks at the shard's other endpoints, as a client does, whether a
daemon of a later epoch answers there, and ends if one does.  A silent daemon answers no such
question itself.

If it reaches one of them as little as the database, it cannot know.  Then it takes no more requests
over Zenoh until its lease is renewed, so that clients find the one that serves.  Clients that share
its memory are on its host, and cut off with it.
"""

from __future__ import annotations

import logging
import threading
from typing import TYPE_CHECKING, Final

from enact_dist.errors import EnactError
from enact_dist.link.client.duplicate_daemons import serving
from enact_dist.link.lease import ShardTakenError
from enact_dist.link.zenoh.config import to_reach
from enact_dist.link.zenoh.endpoints import somebody_listens

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.link.daemon.settings import DaemonSettings
    from enact_dist.link.host import ShardHost
    from enact_dist.link.zenoh.service import ZenohService

ASK_S: Final = 0.5
"""How often a silent daemon asks, and how long an answer may take."""
_log = logging.getLogger("enact.shard")


class Successor:
    """Looks for the daemon that has taken a shard over, while this one is silent.

    Args:
        host: The shard.
        settings: Its settings, with the endpoints of all its daemons.
        found: Called once, from a thread, with what was found.
        service: Returns what takes the requests of clients over Zenoh.
    """

    def __init__(
        self,
        host: ShardHost,
        settings: DaemonSettings,
        found: Callable[[Exception], None],
        service: Callable[[], ZenohService],
    ) -> None:
        self._host = host
        self._settings = settings
        self._found = found
        self._service = service
        self._withdrawn = False
        host.each_tick(self._serve_again)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._look_on, name="enact-successor", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the look; idempotent."""
        self._stopped.set()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _withdraw(self) -> None:
        if self._service().withdraw():
            _log.warning(
                "shard %s reaches neither its database nor all places of its other daemons: it"
                " takes no requests, so that clients find who does",
                self._settings.shard.name,
            )
        self._withdrawn = True  # a tick that sees a renewed lease before this would serve too soon

    def _serve_again(self) -> None:
        silence = self._host.silence
        if self._withdrawn and silence is not None and silence.holds:
            self._withdrawn = False
            self._service().serve()

    def _look_on(self) -> None:
        shard, own = self._settings.shard, set(map(to_reach, self._settings.listen))
        mine = [entry.endpoints for entry in shard.placement.shards if entry.name == shard.name]
        places = [place for those in mine for place in map(to_reach, those) if place not in own]
        silence = self._host.silence
        while places and silence is not None and not self._stopped.wait(ASK_S):
            if silence.holds:
                continue
            if not all(map(somebody_listens, places)):
                self._withdraw()
            try:
                others = serving(
                    self._settings.cell,
                    shard.name,
                    places,
                    timeout_s=ASK_S,
                    keys=self._settings.keys,
                )
            except EnactError as error:
                _log.warning("shard %s cannot ask for a successor: %s", shard.name, error)
                continue
            for other in others:
                if other.epoch > self._host.epoch and not self._stopped.is_set():
                    text = f"shard {shard.name} has another holder: {other}"
                    self._found(ShardTakenError(text))
                    return
