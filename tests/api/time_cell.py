"""The cell of the state machine: its aspects and what they retain, its clock, its data, its steps."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from hypothesis import strategies as st
from reference_time import Rule

from enact_dist import Aspect, Durability, Retention

MS, S = 1_000_000, 1_000_000_000
LARGE = 70_400
"""Bytes that a view fetches apart."""
ASPECTS: dict[str, Aspect[Any]] = {
    "three": Aspect("three", int, Durability.DURABLE, retention=3),
    "aged": Aspect("aged", str, Durability.OS, Retention(age_s=5.0)),
    "sized": Aspect("sized", np.ndarray, Durability.DURABLE, Retention(size_bytes=3 * LARGE)),
    "bare": Aspect("bare", int, Durability.OS, retention=1),
    "frame": Aspect("frame", np.ndarray, Durability.VOLATILE, Retention(versions=4, age_s=10.0)),
    "plain": Aspect("plain", int),
}
RULES = {
    "three": Rule(versions=3),
    "aged": Rule(age_ns=5 * S),
    "sized": Rule(size=3 * LARGE),
    "bare": Rule(versions=1),
    "frame": Rule(versions=4, age_ns=10 * S, stored=False),
    "plain": Rule(versions=16, age_ns=600 * S, size=16 << 20),
}
FIRM = ("online", "training")
FORKS = ("what_if", "trial")
ENTITIES = ("piece", "bench")
LABELS = ("drop-17", "best")
PAUSES_NS = (700 * MS, 1700 * MS, 5500 * MS)
SIZES = (64, 6_400, LARGE)

PICK = st.integers(0, (1 << 30) - 1)
WORLD = st.sampled_from((*FIRM, FIRM[0], *FORKS))
WHERE = st.tuples(WORLD, st.sampled_from(ENTITIES), st.sampled_from(tuple(RULES)))
WRITES = st.lists(
    st.tuples(WHERE, st.one_of(st.none(), st.integers(0, 8)), st.integers(0, 4)),
    min_size=1,
    max_size=3,
    unique_by=lambda write: write[0],
)
"""Slots, what to write (None: null), and a capture stamp (0: none)."""


class WallClock:
    """The host's monotonic time, and a wall clock that the test sets."""

    def __init__(self) -> None:
        # Some way back, so that all of it is past for whoever reads a real clock.
        self.now_ns = time.time_ns() - 86_400 * S

    def monotonic_ns(self) -> int:
        """Return this host's monotonic time."""
        return time.monotonic_ns()

    def wall_ns(self) -> int:
        """Return what the test says."""
        return self.now_ns


def datum_of(aspect: str, number: int) -> Any:
    """Return a datum of an aspect; equal numbers give equal data."""
    if aspect in ("sized", "frame"):
        return np.full(SIZES[number % 3], number, np.uint8)
    return f"note {number}" if aspect == "aged" else number


def plain(datum: Any) -> Any:
    """Return a datum as the model holds it, which `==` compares."""
    return datum.tobytes() if isinstance(datum, np.ndarray) else datum
