"""The longest of everything that `wire` reads or writes, each with its reason.

A limit is checked before memory is taken: what a peer claims is compared with what it sent.
Rule to keep: raising a limit is compatible, lowering one makes stored data unreadable.
"""

from __future__ import annotations

import re
from typing import Final

from enact_dist.core.protocol import parts
from enact_dist.terms import NAME_LENGTH_MAX

FRAME_VERSION: Final = 12
"""Version of the frames; both ends must speak the same.  2: commits over shards; 3: a WELCOME
names shared memory; 5: a datum may name a payload in place of its bytes; 7: an identity stands in
the key of each request and token, and where a socket is opened; an aspect names the types that its
own has succeeded; listings come in pages; whether a shard is there is asked by a ping, whose answer
names the start of its daemon; a request that waits for a stamp names its session; 8: a session may
keep a grant, whose token a later commit names; 9: a lock may wait for news before it enters the
queue; 10: a payload may ask for files of the next ones; 11: a notice may carry data, and a refusal
has `facts` for the attributes of its error; 12: a grant may stay with a session of another host,
whose signs of life ask for recalls."""
DATUM_VERSION: Final = 1
"""Version of the encoding of data; these are stored, so old versions stay readable."""

ALIGNMENT: Final = 64
"""Bodies and buffers start at multiples of this: a cache line, and the widest vector register."""

HEADER_BYTES_MAX: Final = 16 << 20
"""Longest frame header: 100,000 surveyed slots, or 4096 writes with whole encodings."""
BODY_BYTES_MAX: Final = 1 << 30
"""Largest body of one datum."""
FRAME_BYTES_MAX: Final = 24 << 20
"""Longest frame: what one client can make a shard hold by one message.  Larger data travel in
slices of at most 4 MiB."""
PAYLOAD_BYTES_MAX: Final = 16 << 20
"""Longest frame payload: a grant carries small data of 8 MiB together."""
COMMIT_BYTES_MAX: Final = 2 << 20
"""Most bytes of data that travel with their commit; a client sends what is more ahead of it, in
slices, from 1 MiB on."""

PAYLOAD_NAME: Final = re.compile(r"[0-9A-Za-z_]{1,64}-[0-9a-f]{1,16}\Z")
"""What a payload is called at its shard: the session that made it and a number, never used again;
both ends check it, since it becomes the name of a file."""
DRAFT_NAME: Final = re.compile(r"(draft-[0-9a-f]{32})?\Z")
"""What a payload may be called before its commit, where its own name could be guessed."""
PAYLOAD_BYTES_MIN: Final = parts.INLINE_BYTES_MAX
"""Data up to this size are never a payload."""
NAME_CHARACTERS_MAX: Final = NAME_LENGTH_MAX
"""Longest name of a context, entity, aspect, shard, session, actor or host."""
REASON_CHARACTERS_MAX: Final = 500
"""Longest reason of a manual action: it is stored permanently and printed in one table line."""
TEXT_BYTES_MAX: Final = 64 << 10
"""Longest string of a header that is no name: causes, endpoints, fingerprints, reasons."""
REPORT_FIELD_BYTES_MAX: Final = 64 << 10
"""Longest `report` that a keep-alive can have; a shard keeps one of at most
`core.protocol.parts.REPORT_BYTES_MAX`, and counts longer ones."""
ITEMS_MAX: Final = parts.ITEMS_MAX
KEPT_VERSIONS_MAX: Final = 1 << 14
"""Most versions that one request pins; a shard pins at most 10,000 in all."""
ENTRIES_MAX: Final = 1 << 18
"""Most entries of any other list of a header; the header's length bounds them earlier."""
REQUEST_VALUES_MAX: Final = 1 << 18
"""Most values in the header of a request, those of all lists together: twice as many as 16,384
versions to keep have, and a tenth of a second to read."""
INTEGER_MAX: Final = (1 << 63) - 1
"""Largest integer of a header: what a signed 64-bit column of a store holds."""

ENCODING_BYTES_MAX: Final = 4096
"""Longest tree that stays in a datum's encoding; a longer one moves into its body."""
TREE_BYTES_MAX: Final = 16 << 20
"""Longest tree of a datum: what is larger belongs into arrays."""
LEAF_BYTES_MAX: Final = 256
"""Longest text or bytes inside a tree; longer ones become buffers of the body."""
DEPTH_MAX: Final = 32
"""Deepest nesting of a datum."""
DIMENSIONS_MAX: Final = 32
"""Most dimensions of an array (numpy 1 has 32, numpy 2 has 64)."""
FIELDS_MAX: Final = 1024
"""Most fields of a structured dtype, nested ones counted."""

SMALL_BODY_BYTES: Final = 64 << 10
"""Bodies below this, or below half of a received payload, are copied out of it, so that they do not
keep it alive."""


def aligned(length: int) -> int:
    """Return the next multiple of `ALIGNMENT` from `length` on."""
    return -(-length // ALIGNMENT) * ALIGNMENT
