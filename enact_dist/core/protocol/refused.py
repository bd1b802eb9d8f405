"""Why a shard refuses a request: the answer, and its codes; the page on the protocol explains each.

Rule a change must keep: what an error has as an attribute travels as a fact.  The text is for
people, and may be reworded at any time.
"""

from __future__ import annotations

from typing import Final

from enact_dist.core.protocol.datum import message

CLOCK_SKEW: Final = "clock_skew"
DAMAGED: Final = "damaged"
DATUM_TYPE: Final = "datum_type"
HELD: Final = "held"
NEWER_TYPE: Final = "newer_type"
NO_PAYLOAD: Final = "no_payload"
NO_ROOM: Final = "no_room"
NOT_PROVEN: Final = "unproven"
OVERLOAD: Final = "overload"
PERMISSION: Final = "permission"
PROTOCOL: Final = "protocol"
TOO_LONG: Final = "too_long"
UNKNOWN_ASPECT: Final = "unknown_aspect"
UNKNOWN_WORLD: Final = "unknown_world"
VALUE: Final = "value"


@message
class Refused:
    """The request cannot be executed; `code` names the error class to raise.

    ==================  ===================================================================
    code                `facts`
    ==================  ===================================================================
    ``unknown_world``   the names of world contexts that exist, the first 100
    ``clock_skew``      how many seconds the timestamp is ahead
    ``permission``      identity, right and the place of the rule that would give it; then,
                        if a slot was asked for, its context, entity and aspect
    any other           none
    ==================  ===================================================================
    """

    code: str
    text: str
    facts: tuple[str, ...] = ()
