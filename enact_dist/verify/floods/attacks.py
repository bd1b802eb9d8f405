"""The attacks of `enact verify --floods`: what is done, by whom, and how a shard refuses it.

Every attack is made of frames that any program can send which reaches the shard's port or socket.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from enact_dist.verify.floods import forgeries, overloads
from enact_dist.verify.floods.attacker import Attacker


@dataclass(frozen=True, slots=True)
class Attack:
    """One kind of flood.

    Attributes:
        name: Name in the table.
        round: Done again and again.
        expected: Names of refusals, at least one of which the attacker has to get; none: it gets
            no answer.
        shards: Number of shards in the cell.
        mode: Mode of the attacker's Zenoh session.
    """

    name: str
    round: Callable[[Attacker], None]
    expected: frozenset[str]
    shards: int = 1
    mode: str = "peer"


OVERLOAD: Final = frozenset(("overload",))
FORBIDDEN: Final = frozenset(("permission",))
ATTACKS: Final = (
    Attack("nothing", overloads.nothing, frozenset()),
    Attack("parked questions", overloads.parked, OVERLOAD),
    Attack("sessions", overloads.sessions, OVERLOAD),
    Attack("sessions of many names", overloads.nameless_sessions, frozenset()),
    Attack("socket sessions", overloads.socket_sessions, OVERLOAD | {"connection refused"}),
    Attack("reports", overloads.reports, OVERLOAD),
    Attack("registrations", overloads.registrations, OVERLOAD),
    Attack("patterns", overloads.patterns, frozenset(("protocol",))),
    Attack("long questions", overloads.long_questions, frozenset(("protocol", "overload"))),
    Attack("large frames", overloads.large_frames, frozenset(("protocol",))),
    Attack("socket frames", overloads.large_socket_frames, frozenset(("connection ended",))),
    Attack("silent connections", overloads.silent_tcp, frozenset()),
    Attack("silent sockets", overloads.silent_socket, frozenset()),
    Attack("forged sessions", forgeries.forged_sessions, FORBIDDEN),
    Attack("forged socket sessions", forgeries.forged_socket_sessions, FORBIDDEN),
    Attack(
        "forged decisions",
        forgeries.forged_decisions,
        frozenset(("permission", "clock_skew")),
        shards=2,
    ),
    Attack("stranger as a client", forgeries.stranger, frozenset(), mode="client"),
    Attack("stranger as a peer", forgeries.stranger, frozenset()),
    Attack("stranger as a router", forgeries.stranger, frozenset(), mode="router"),
)
