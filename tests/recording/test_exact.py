"""A recorded version is the version, bit for bit, and damaged ones are refused."""

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_samples import data, recorded, same

from enact_dist.core.protocol.datum import Slot
from enact_dist.core.protocol.messages import DatumRead
from enact_dist.errors import ProtocolError
from enact_dist.recording.exact import Recorded, decode_recorded, encode_recorded

names = st.text("abc/", min_size=1, max_size=9)
stamps = st.integers(0, 2**63 - 1)
reads = st.builds(DatumRead, st.builds(Slot, names, names, names), stamps, stamps)
versions = st.builds(
    Recorded,
    slot=st.builds(Slot, names, names, names),
    version=st.integers(0, 2**63 - 1),
    stamp_ns=stamps,
    shard=names,
    commit=st.integers(0, 2**32),
    datum=data,
    actor=st.text(max_size=20),
    host=names,
    pid=st.integers(0, 2**22),
    kind=st.sampled_from(("", "commit", "fork")),
    held_ns=stamps,
    reads=st.lists(reads, max_size=3).map(tuple),
    left_out=st.integers(0, 2**32),
)


@given(versions)
def test_what_is_encoded_comes_back_bit_for_bit(version):
    """Every datum type, with its capture stamp and all that is known of its commit."""
    assert same(decode_recorded(encode_recorded(version)), version)


def test_null_comes_back_with_its_reason():
    """A datum that was deleted is a version, too."""
    version = recorded("piece", None, null="DELETED")
    assert same(decode_recorded(encode_recorded(version)), version)


def test_message_is_plain_msgpack():
    """Another language reads it with its msgpack library alone."""
    found = msgpack.unpackb(encode_recorded(recorded("piece", b"x" * 300, version=7)))
    assert (found["world"], found["entity"], found["version"]) == ("online", "piece", 7)
    assert found["body"] == b"x" * 300


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"v": 3}, "format 3"),
        ({"version": "1"}, "'version'"),
        ({"body": None}, "'body'"),
        ({"null": "BORED"}, "BORED"),
        ({"kind": "dream"}, "dream"),
        ({"reads": [["online", "piece", "value", 1]]}, "made of"),
        ({"reads": [["online", "piece", 3, 1, 1]]}, "made of"),
        ({"reads": [["online", "piece", "value", 1, 1]] * 1025}, "1025"),
        ({"left_out": None}, "'left_out'"),
    ],
)
def test_what_this_version_does_not_know_is_refused(change, said):
    """A later format and a wrong type are named."""
    message = msgpack.unpackb(encode_recorded(recorded("piece", 1))) | change
    with pytest.raises(ProtocolError, match=said):
        decode_recorded(msgpack.packb(message))


def test_a_version_of_the_first_format_comes_without_causes():
    """Recordings of before stay readable."""
    version = recorded("piece", 1)
    message = msgpack.unpackb(encode_recorded(version)) | {"v": 1}
    for key in ("kind", "held_ns", "reads", "left_out"):
        del message[key]
    found = decode_recorded(msgpack.packb(message))
    assert same(found, version)
    assert (found.kind, found.reads) == ("", ())


@given(st.binary(max_size=60))
def test_noise_is_refused(noise):
    """No bytes make anything but a version or a `ProtocolError`."""
    with pytest.raises(ProtocolError):
        decode_recorded(noise)
