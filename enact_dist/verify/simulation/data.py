"""What a simulated datum says: which lock wrote it, and its number or label."""

from __future__ import annotations

from enact_dist.core.protocol.datum import Datum

FILLED = 200
"""A datum says what it is in fewer bytes; from here on it is filled with dots."""


def datum_of(text: str, *, size: int = 0) -> Datum:
    """Return a datum that says who wrote it and what."""
    body = text.encode().ljust(size, b".")
    return Datum(b"text", body, len(body))


def writer_of(datum: Datum) -> str:
    """Return the lock that wrote a datum."""
    return bytes(datum.body[:FILLED]).decode().partition("|")[0]


def value_of(datum: Datum) -> int:
    """Return the number in a datum."""
    return int(bytes(datum.body[:FILLED]).decode().rstrip(".").partition("|")[2])


def label_of(datum: Datum) -> str:
    """Return the label in a datum."""
    return bytes(datum.body[:FILLED]).decode().rstrip(".").partition("|")[2]
