"""Settings of Zenoh sessions, and the handling that they need.

Every session is a peer: a shard listens, a client connects to each shard it uses (Zenoh 1.10 does
not relay between peers).  Reasons for the settings, measured with 1.10 on a loopback:

- Multicast and gossip off: they make `open` take 0.5 s and let strangers join.
- Zenoh's shared memory off: it falls back silently, so measurements would mean nothing.
- Link lease = TTL / 2: the token of a stopped process must disappear before its lease ends.
- `wait_before_close`: a peer that does not read for the time of a link lease is disconnected,
  instead of after 5 s.  A client waits longer, since only its own thread does, and a busy shard
  must not lose it.  The kernel gives up on peers that acknowledge nothing before that
  (`link.zenoh.links`): for a shard after three quarters of a link lease or 3 s.  So with a TTL
  above 8 s, a cut of some seconds ends the link of a peer that was sent something meanwhile, though
  not its lease.
- `max_wait_before_drop_fragments` 2 s: slices of a large datum over a slow network are not
  dropped after 50 ms; only dedicated sender threads wait for it.
- Reconnection after 50 ms, then at increasing intervals up to a second: a shard that restarts
  quickly is back in use after 0.1 s, and an absent one costs its clients nothing.
- `link.zenoh.access`: a listener relays nothing, and silent connections lock no client out.
- `link.zenoh.links`: lost connections block no client, and are restored soon.

Sessions must be closed before the interpreter ends (it hangs otherwise), and must never be closed
or freed in a forked child (that hangs too): `close_session` and `keep_after_fork` see to both.
"""

from __future__ import annotations

import atexit
import ctypes
import json
import os
import random
import weakref
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

import zenoh

from enact_dist.errors import ConfigError, LinkError, MisuseError
from enact_dist.link.carrier import FORKED_REMEDY
from enact_dist.link.zenoh.access import access_rules
from enact_dist.link.zenoh.links import LinkWatch
from enact_dist.wire.limits import FRAME_BYTES_MAX

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from enact_dist.link.zenoh.tls import KeyFiles

QUEUED_MAX: Final = 65_536
"""Messages in a channel between Zenoh and Python: Zenoh's thread must not wait for Python."""
MESSAGE_BYTES_MAX: Final = FRAME_BYTES_MAX + (64 << 10)
"""Longest message: a frame with its key.  Zenoh drops longer ones."""
RETRY_MS, RETRY_MS_MAX, RETRY_FACTOR = 50, 1_000, 1.15
"""Pauses between attempts to connect to an endpoint without a listener: they grow from the first
to the second figure, or to a random part of it.
"""
CONNECT_WAIT_MS: Final = 50
"""How long `open` may wait for a connection; after that it continues in the background."""
OPEN_S: Final = 5.0
"""How long the accepting side of a connection may take to answer in Zenoh's protocol."""
CLIENT_BLOCK_S: Final = 3.0
"""How long a client waits for a shard that does not read before it closes the connection; no
shard waits longer for a client either."""
UNACKNOWLEDGED: Final = 0.75
"""How much of a link's lease a shard's bytes may stay unacknowledged: less than all of it, so
that the kernel gives up before anything closes the link.
"""
ACCEPT_PENDING: Final = 10_000
"""Connections that may be without a greeting at one time.  Zenoh's limit of 100 would let
three hundred silent ones lock everybody else out indefinitely.
"""
ACCEPT_S: Final = 1.0
"""How long a new connection may take for its greeting."""
TRANSPORTS_MAX: Final = 20_000
"""Connections of one shard: one for the calls and one for the large data of each session."""


def session_config(
    *,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    lease_s: float,
    open_s: float = OPEN_S,
    keys: KeyFiles | None = None,
    more: Mapping[str, object] = MappingProxyType({}),
) -> zenoh.Config:
    """Return the settings of a session.

    Args:
        listen: Endpoints to listen at ("tcp/0.0.0.0:7447"); clients have none.
        connect: Endpoints to connect to, and to reconnect to after each loss.
        lease_s: After this time without a sign of life from this process, a peer drops the link.
        open_s: How long a connected endpoint may take to answer in Zenoh's protocol.
        keys: The files by which this process proves its name, for TLS endpoints.
        more: Further settings; those of a shard come from `listening_settings`.

    Raises:
        ConfigError: Zenoh does not understand an endpoint, or the keys for one are missing or
            cannot be used.
    """
    retry = {
        "period_init_ms": RETRY_MS,
        "period_max_ms": round(RETRY_MS_MAX * (1 - random.random() / 2)),  # noqa: S311 - no secret
        "period_increase_factor": RETRY_FACTOR,
    }
    congestion = {
        "drop": {"wait_before_drop": 1_000, "max_wait_before_drop_fragments": 2_000_000},
        "block": {"wait_before_close": round(1e6 * (lease_s if listen else CLIENT_BLOCK_S))},
    }
    settings: dict[str, object] = {
        "mode": "peer",
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "connect/retry": retry,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": CONNECT_WAIT_MS,
        "transport/shared_memory/enabled": False,
        "transport/unicast/open_timeout": round(open_s * 1e3),
        "transport/unicast/max_sessions": TRANSPORTS_MAX,
        "transport/link/tx/lease": max(1, round(lease_s * 1e3)),
        "transport/link/tx/keep_alive": 4,
        "transport/link/tx/queue/congestion_control": congestion,
        "transport/link/rx/max_message_size": MESSAGE_BYTES_MAX,
        **more,
    }
    locked = [endpoint for endpoint in (*listen, *connect) if endpoint.startswith("tls/")]
    if keys is not None:
        keys.check()
        settings["transport/link/tls"] = keys.settings(listens=bool(listen))
    elif locked:
        raise ConfigError(
            f"{locked[0]} needs a key: name the cell.toml that has [security] keys, or the folder"
            " in ENACT_KEYS (docs/security.md)"
        )
    config = zenoh.Config()
    for key, value in settings.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError:
            raise ConfigError(
                f"{key} = {value!r} cannot be used; an endpoint looks like 'tcp/host:7447'"
            ) from None
    return config


def listening_settings(
    cell: str, shard: str, names: Mapping[str, str] | None = None, shards: Iterable[str] = ()
) -> dict[str, object]:
    """Return the settings of a shard's listening session; see `access_rules` for the arguments."""
    return {
        "access_control": access_rules(cell, shard, names, shards),
        "transport/unicast/accept_pending": ACCEPT_PENDING,
        "transport/unicast/accept_timeout": round(ACCEPT_S * 1e3),
    }


def to_reach(endpoint: str) -> str:
    """Return an endpoint for connecting on this host to a daemon that listens on every address."""
    return endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")


def open_session(
    *,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    lease_s: float,
    open_s: float = OPEN_S,
    keys: KeyFiles | None = None,
    more: Mapping[str, object] = MappingProxyType({}),
) -> zenoh.Session:
    """Open a session; the caller closes it.

    Raises:
        ConfigError: An endpoint cannot be read, or the keys for one cannot be used.
        LinkError: An endpoint to listen at is in use, or not of this host.
        MisuseError: This process was forked from one that has had a session.
    """
    check_not_forked()
    config = session_config(
        listen=listen, connect=connect, lease_s=lease_s, open_s=open_s, keys=keys, more=more
    )
    _used_in.add(os.getpid())
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        raise _open_error(error, listen) from None
    _open_sessions.append((os.getpid(), session))
    user_timeout_s = min(UNACKNOWLEDGED * lease_s, CLIENT_BLOCK_S) if listen else CLIENT_BLOCK_S
    try:
        _watches[session] = watch = LinkWatch(session, connect, user_timeout_s)
    except BaseException:  # the system has no more threads, for example
        close_session(session)
        raise
    keep_after_fork(watch)
    return session


def check_not_forked() -> None:
    """Raise unless Zenoh can be used in this process.

    Its threads are started once and do not exist in a forked child: `zenoh.open` would block there
    forever, even if the parent had closed every session before the fork.

    Raises:
        MisuseError: This process was forked from one that has had a session.
    """
    if _used_in - {os.getpid()}:
        raise MisuseError(
            f"this process was forked from process {min(_used_in - {os.getpid()})}, which had"
            f" connected to a cell, and Zenoh's threads do not survive that; {FORKED_REMEDY}"
        )


def _open_error(error: zenoh.ZError, listen: Sequence[str]) -> LinkError:
    text = str(error)
    endpoint = next((endpoint for endpoint in listen if endpoint in text), ", ".join(listen))
    if "in use" in text:
        return LinkError(
            f"endpoint {endpoint} is in use by another process of this host; stop it or listen"
            " elsewhere"
        )
    if "assign requested address" in text:
        return LinkError(f"endpoint {endpoint} is no address of this host; listen at one that is")
    return LinkError(f"cannot open {endpoint or 'a Zenoh session'}: {_reason(error)}")


def _reason(error: zenoh.ZError) -> str:
    """Return the reason without positions in Zenoh's source."""
    return str(error).split(" at /")[0].replace("[", "").strip()


_used_in: set[int] = set()
"""The processes that have opened sessions: this one, or ancestors that forked it."""
_open_sessions: list[tuple[int, zenoh.Session]] = []
_owners: weakref.WeakSet[object] = weakref.WeakSet()
_watches: dict[zenoh.Session, LinkWatch] = {}


def close_session(session: zenoh.Session) -> None:
    """Close a session of `open_session`; pending calls end without an answer."""
    mine = (os.getpid(), session)
    if mine in _open_sessions:
        _open_sessions.remove(mine)
        session.close()  # type: ignore[no-untyped-call]  # untyped in its stub
        watch = _watches.pop(session, None)
        if watch is not None:  # otherwise the session was closed while it was opened
            watch.join()


def keep_after_fork(owner: object) -> None:
    """Never free `owner` in a forked child: it holds a session or its declarations."""
    _owners.add(owner)


def _after_fork() -> None:
    """Make the parent's sessions immortal in a forked child: freeing one there never returns."""
    for kept in (*_open_sessions, *_owners):
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(kept))


def _at_exit() -> None:
    """Close sessions left open: the interpreter would wait for them forever.

    Carriers come first: they wait for the threads inside Zenoh, which must not return while the
    interpreter exits (that would abort the process).
    """
    for owner in (*_owners,):
        close = getattr(owner, "close", None)
        if close is not None:
            close()
    for _, session in (*_open_sessions,):
        close_session(session)


os.register_at_fork(after_in_child=_after_fork)
atexit.register(_at_exit)
