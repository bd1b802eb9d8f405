"""The first contact with a cell: find a shard, then open the session's carrier to all of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from enact_dist.core.messages import Welcome
from enact_dist.errors import LinkError
from enact_dist.link.client import CellClient
from enact_dist.link.socket_carrier import SocketCarrier
from enact_dist.link.zenoh_carrier import ZenohCarrier
from enact_dist.link.zenoh_config import OPEN_S
from enact_dist.link.zenoh_discovery import discover

if TYPE_CHECKING:
    from collections.abc import Sequence

    from enact_dist.core.client import Client
    from enact_dist.link.carrier import Carrier


def join(
    name: str,
    endpoints: Sequence[str],
    client: Client,
    *,
    timeout_s: float,
    open_s: float = OPEN_S,
    carrier: str = "auto",
) -> tuple[str, CellClient, Welcome]:
    """Return the cell's name, a client with its carrier open, and a shard's welcome.

    Args:
        name: The cell's name; empty where only an endpoint is known.
        endpoints: Where shards listen; one that answers is enough.
        client: The session to bring in.
        timeout_s: How long to wait for a first answer.
        open_s: How long a shard has to answer a connection.
        carrier: How messages travel, one of `CARRIERS`.

    Raises:
        LinkError: Another cell answers, or the socket is asked for and cannot be used.
        ShardUnreachableError: None answered; the message names the endpoints.
    """
    found, welcome = discover(endpoints, client.hello(""), timeout_s=timeout_s)
    if name and found != name:
        raise LinkError(
            f"a shard of cell {found!r} answers at {', '.join(endpoints)}, not one of {name!r};"
            " two cells use one endpoint, or cell.toml was renamed while shards run"
        )
    # The link's lease follows the session's, which the shard may have shortened.
    client.ttl_ns = min(client.ttl_ns, welcome.ttl_ns)
    reachable = [e for entry in welcome.placement.shards for e in entry.endpoints]
    zenoh = ZenohCarrier(
        found,
        client.session,
        client.actor,
        tuple(dict.fromkeys((*endpoints, *reachable))),
        ttl_s=client.ttl_ns / 1e9,
        open_s=open_s,
    )
    way: Carrier = zenoh
    try:
        if carrier != "zenoh":
            way = sockets = SocketCarrier(zenoh, client.session, forced=carrier == "socket")
            sockets.learn(welcome)
        way.add_endpoints(welcome.placement.shards)
    except BaseException:
        way.close()
        raise
    return found, CellClient(way, client), welcome
