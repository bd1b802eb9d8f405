"""The shard of the history machine: its aspects and what they retain, and what steps choose from."""

from __future__ import annotations

import sys
from pathlib import Path

from hypothesis import strategies as st
from shard_bench import MS, S

from enact_dist.core.protocol.messages import AspectEntry

sys.path.insert(0, str(Path(__file__).parents[1] / "api"))

from reference_time import Rule

RULES = {
    "three": Rule(versions=3),
    "aged": Rule(age_ns=5 * S),
    "sized": Rule(size=40),
    "bare": Rule(versions=1),
    "frame": Rule(versions=4, age_ns=10 * S, stored=False),
    "plain": Rule(versions=16, age_ns=600 * S, size=16 << 20),
}
ASPECTS = (
    AspectEntry("three", "int", "durable", 3),
    AspectEntry("aged", "int", "os", 0, 5 * S),
    AspectEntry("sized", "int", "durable", 0, 0, 40),
    AspectEntry("bare", "int", "os", 1),
    AspectEntry("frame", "int", "volatile", 4, 10 * S),
    AspectEntry("plain", "int", "durable"),
)
FIRM = ("online", "training")
FORKS = ("what_if", "trial")
WORLDS = st.sampled_from((*FIRM, *FIRM, *FORKS))
ENTITIES = ("piece", "bench")
LABELS = ("drop-17", "best")
PAUSES_NS = (700 * MS, 1700 * MS, 5500 * MS)
CAPTURES_MAX = 4
DOWN_NS = 400 * MS
"""A restart takes longer than any stamp here lies ahead of the wall clock: the stamps go on."""
KEPT, NOT_KEPT = "kept", "not kept"
"""In place of an answer: the shard has died, with what was asked for on its disk or without."""

FORK = st.sampled_from(FORKS)
PICK = st.integers(0, (1 << 30) - 1)
ASPECT = st.sampled_from(tuple(RULES))
WHERE = st.tuples(WORLDS, st.sampled_from(ENTITIES), ASPECT)
WRITES = st.lists(
    st.tuples(WHERE, st.one_of(st.none(), st.integers(0, 60)), st.integers(0, CAPTURES_MAX)),
    min_size=1,
    max_size=3,
    unique_by=lambda write: write[0],
)
"""Slots with the length of their new data (None: they are deleted) and a capture stamp."""
LOSSES = st.sampled_from((None, None, None, None, "before", "after"))
"""Whether the shard dies while a step's record is on its way to the disk, and which side of it."""
