"""First contact with a cell: finds a shard, then opens the session's carrier to all of them."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import ShardEntry, Welcome
from enact_dist.errors import LinkError
from enact_dist.link.client.duplicate_daemons import Doubts
from enact_dist.link.client.locks import CellClient
from enact_dist.link.socket.carrier import SocketCarrier
from enact_dist.link.zenoh.carrier import ZenohCarrier
from enact_dist.link.zenoh.config import OPEN_S
from enact_dist.link.zenoh.discovery import discover
from enact_dist.link.zenoh.queries import POLL_S
from enact_dist.wire.keys import identity_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from enact_dist.core.client.client import Client
    from enact_dist.link.carrier import Carrier
    from enact_dist.link.zenoh.tls import KeyFiles

HELLO_S: Final = 1.0
"""How long another shard may take to welcome us if the first one's socket is unusable."""


def join(
    name: str,
    endpoints: Sequence[str],
    client: Client,
    *,
    timeout_s: float,
    open_s: float = OPEN_S,
    carrier: str = "auto",
    expected: Sequence[ShardEntry] = (),
    keys: KeyFiles | None = None,
    secret: str = "",
) -> tuple[str, CellClient, Welcome]:
    """Return the cell's name, a client with an open carrier, and a shard's welcome.

    Args:
        name: The cell's name; empty if only an endpoint is known.
        endpoints: Endpoints of shards; one that answers is enough.
        client: The session that joins.
        timeout_s: How long to wait for a first answer.
        open_s: How long a shard has to answer a connection.
        carrier: How messages travel, one of `CARRIERS`.
        expected: The shards and endpoints of `cell.toml`.
        keys: The files by which this process proves its name, in a cell with keys.
        secret: Opens sockets for the session.

    Raises:
        LinkError: Another cell answers, or a socket is required and no shard has a usable one
            (raised only after `timeout_s` if the first shard has none and another does not answer).
        ShardUnreachableError: None answered; the message names the endpoints.
    """
    found, welcome = discover(endpoints, client.hello(""), timeout_s=timeout_s, keys=keys)
    if name and found != name:
        raise LinkError(
            f"a shard of cell {found!r} answers at {', '.join(endpoints)}, not one of {name!r};"
            " two cells use one endpoint, or cell.toml was renamed while shards run"
        )
    # The link's lease follows the session's, and the shard may have shortened that.
    client.ttl_ns = min(client.ttl_ns, welcome.ttl_ns)
    reachable = [e for entry in welcome.placement.shards for e in entry.endpoints]
    identity = identity_of(keys.name if keys else client.actor, client.host, client.pid)
    zenoh = ZenohCarrier(
        found,
        client.session,
        identity,
        tuple(dict.fromkeys((*endpoints, *reachable))),
        ttl_s=client.ttl_ns / 1e9,
        open_s=open_s,
        keys=keys,
    )
    way: Carrier = zenoh
    try:
        if carrier != "zenoh":
            way = sockets = SocketCarrier(
                zenoh, client.session, identity, secret, forced=carrier == "socket"
            )
            welcome = _first_usable(sockets, client, welcome, timeout_s)
        way.add_endpoints(welcome.placement.shards)
    except BaseException:
        way.close()
        raise
    return found, CellClient(way, client, doubts=Doubts(found, expected, keys)), welcome


def _first_usable(
    sockets: SocketCarrier, client: Client, welcome: Welcome, timeout_s: float
) -> Welcome:
    """Return the welcome of a shard with a usable transport: this one's unless refused.

    Raises:
        LinkError: A socket is required, and no shard with one answers within `timeout_s`.
    """
    try:
        sockets.learn(welcome)
    except LinkError:
        entries = welcome.placement.shards
        sockets.add_endpoints(entries)
        others = [entry.name for entry in entries if entry.name != welcome.shard]
        deadline_s = time.monotonic() + timeout_s
        while others and (left_s := deadline_s - time.monotonic()) > 0:
            for name in tuple(others):
                try:
                    wait_s = min(left_s, HELLO_S)
                    answer = sockets.request(name, client.hello(name), timeout_s=wait_s)
                except LinkError:
                    others.remove(name)
                    continue
                if isinstance(answer, Welcome):
                    return answer
            time.sleep(POLL_S)  # it may be connecting
        raise
    return welcome
