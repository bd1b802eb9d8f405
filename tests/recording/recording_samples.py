"""Data of all types, and recordings of them, for the tests of this folder."""

import itertools
from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as nps

from enact_dist.config.shows import GUESSED
from enact_dist.core.protocol.datum import Datum, Slot
from enact_dist.core.protocol.messages import AspectEntry
from enact_dist.recording.exact import Recorded
from enact_dist.recording.file import RecordingFile
from enact_dist.wire.payload import encode_datum

BEGIN_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True, eq=False)
class Cloud:
    points_m: np.ndarray
    colours: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Mesh:
    vertices_m: np.ndarray
    triangles: np.ndarray


plain = st.one_of(
    st.integers(-(2**63), 2**63 - 1),
    st.floats(),
    st.booleans(),
    st.text(max_size=300),
    st.binary(max_size=300),
)
arrays = nps.arrays(
    dtype=st.one_of(
        nps.scalar_dtypes(),
        nps.byte_string_dtypes(max_len=5),
        nps.array_dtypes(max_size=3),
    ).filter(lambda dtype: not dtype.hasobject),
    shape=nps.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
)
values = st.one_of(
    st.tuples(plain, st.just(object)).map(lambda pair: (pair[0], type(pair[0]))),
    st.lists(plain, max_size=4).map(lambda value: (value, list)),
    st.dictionaries(st.text(max_size=5), plain, max_size=4).map(lambda value: (value, dict)),
    arrays.map(lambda value: (value, np.ndarray)),
    st.tuples(arrays, arrays).map(lambda pair: (Mesh(*pair), Mesh)),
)
"""Values with their types."""

data = st.builds(
    lambda pair, stamp_ns: encode_datum(pair[0], pair[1], stamp_ns=stamp_ns),
    values,
    st.one_of(st.just(0), st.integers(1, 2**62)),
)


def datum(value, stamp_ns=0):
    return encode_datum(value, type(value), stamp_ns=stamp_ns)


def recorded(name, value, *, version=1, commit=1, stamp_ns=0, null=""):
    """Return a version of `online:<name>/value`, or of the slot that `name` is."""
    slot = name if isinstance(name, Slot) else Slot("online", name, "value")
    held = value if value is None or isinstance(value, Datum) else datum(value)
    stamp_ns = stamp_ns or BEGIN_NS + 1_000_000 * commit
    return Recorded(
        slot, version, stamp_ns, "left", commit, held, null or ("" if held else "DELETED"), "eye"
    )


def file(path, *, shows=lambda _: GUESSED, worlds="online", **options):
    """Begin a recording."""
    return RecordingFile(
        path,
        {"cell": "test", "worlds": worlds, "entities": "**", "begin_ns": str(BEGIN_NS)},
        aspects=lambda name: AspectEntry(name, "int", "os"),
        shows=shows,
        **options,
    )


def counting(path, commits, *, per_chunk=1, size=0, **options):
    """Write a recording of commits of two slots each, so many in a chunk; it is not ended."""
    recording = file(path, chunk_bytes=1 << 40, **options)
    filler = np.full(size, 7, np.uint8)
    for number in range(1, commits + 1):
        pair = [
            recorded(name, [number, filler] if size else number, version=number, commit=number)
            for name in ("bench", "piece")
        ]
        recording.add_commit(pair, pair[0].stamp_ns)
        if number % per_chunk == 0:
            recording.end_chunk()
    return recording


def same(one, other):
    """Say whether two recorded versions are equal in every bit."""
    if (one.datum is None) != (other.datum is None):
        return False
    if one.datum is not None:
        parts = [(d.encoding, bytes(d.body), d.size, d.stamp_ns) for d in (one.datum, other.datum)]
        if parts[0] != parts[1]:
            return False
    names = (
        "slot",
        "version",
        "stamp_ns",
        "shard",
        "commit",
        "null_reason",
        "actor",
        "host",
        "pid",
        "kind",
        "held_ns",
        "reads",
        "left_out",
    )
    return all(getattr(one, name) == getattr(other, name) for name in names)


def all_same(ones, others):
    return all(same(*pair) for pair in itertools.zip_longest(ones, others))
