"""Messages of every class, made from the annotations: by hypothesis, or by a seeded generator."""

from __future__ import annotations

import types
import typing
from dataclasses import fields, is_dataclass
from functools import cache

from hypothesis import strategies as st

from enact_dist.core.protocol.datum import Datum
from enact_dist.wire.frames import CODES
from enact_dist.wire.limits import PAYLOAD_NAME
from enact_dist.wire.texts import is_safe

CLASSES = sorted(CODES, key=CODES.__getitem__)
INTEGERS = (0, 1, 127, 128, 255, 65_536, 1 << 31, 1_763_000_000_123_456_789, (1 << 63) - 1, -1)
TEXTS = ("", "a", "online", "tray/package/3", "größe", "名前", "x" * 200, "[bold]\u00a0\\n")


def annotated(cls):
    """Return (name, type) of each field."""
    hints = typing.get_type_hints(cls)
    names = [field.name for field in fields(cls)] if is_dataclass(cls) else cls._fields
    return [(name, hints[name]) for name in names]


def alternatives(kind):
    """Return what an annotation is one of, and whether that may be None; nothing for others."""
    if typing.get_origin(kind) not in (types.UnionType, typing.Union):
        return [], False
    kinds = typing.get_args(kind)
    return [one for one in kinds if one is not type(None)], type(None) in kinds


@cache
def messages(kind):
    """Return a strategy for values of an annotation of `core.protocol.messages`."""
    inner, may_be_none = alternatives(kind)
    if inner:
        return st.one_of(*[st.none()] * may_be_none, *map(messages, inner))
    if typing.get_origin(kind) is tuple:
        return st.lists(messages(typing.get_args(kind)[0]), max_size=3).map(tuple)
    if kind is Datum:
        bodies = st.binary(max_size=200) | st.sampled_from([b"", b"x" * 64, b"y" * 65_600])
        here = st.builds(
            lambda encoding, body, stamp_ns: Datum(encoding, body, len(body), stamp_ns),
            st.binary(max_size=100),
            bodies,
            st.integers(0, 2**63 - 1),
        )
        named = st.builds(
            Datum,
            st.binary(max_size=100),
            st.just(b""),
            st.integers(1, 1 << 30),
            st.integers(0, 2**63 - 1),
            st.from_regex(PAYLOAD_NAME, fullmatch=True),
        )
        return here | named
    if kind is int:
        return st.integers(-(2**63), 2**63 - 1) | st.sampled_from(INTEGERS)
    if kind is str:
        return st.text(max_size=20).filter(is_safe) | st.sampled_from(TEXTS)
    if kind is bytes:
        return st.binary(max_size=100)
    if kind is bool:
        return st.booleans()
    return st.builds(
        lambda values: kind(*values), st.tuples(*(messages(k) for _, k in annotated(kind)))
    )


def sample(kind, random):
    """Return a value of an annotation, of middle size, by a seeded generator."""
    inner, may_be_none = alternatives(kind)
    if inner:
        one = inner[0] if len(inner) == 1 else random.choice(inner)
        return None if may_be_none and random.random() >= 0.8 else sample(one, random)
    if typing.get_origin(kind) is tuple:
        kinds = typing.get_args(kind)
        if kinds[1:] == (...,):
            kinds = kinds[:1] * random.randint(1, 3)
        return tuple(sample(each, random) for each in kinds)
    if kind is Datum:
        if random.random() < 0.2:
            return Datum(random.randbytes(5), b"", 100_000, 7, f"{'5f' * 16}-1f")
        body = random.randbytes(random.choice((0, 1, 64, 100)))
        return Datum(random.randbytes(5), body, len(body), random.choice(INTEGERS[:-1]))
    if kind is bytes:
        return random.randbytes(8)
    if kind in (int, str, bool):
        return random.choice({int: INTEGERS, str: TEXTS, bool: (False, True)}[kind])
    return kind(*(sample(inner, random) for _, inner in annotated(kind)))


def damaged(raw, random):
    """Return bytes with one kind of damage: flipped bits, a piece cut, doubled or replaced."""
    raw = bytearray(raw)
    if not raw:
        return random.randbytes(random.randint(1, 20))
    at, length = random.randrange(len(raw)), random.randint(1, 8)
    kind = random.randrange(6)
    if kind == 0:
        raw[at] ^= 1 << random.randrange(8)
    elif kind == 1:
        del raw[at:]
    elif kind == 2:
        del raw[at : at + length]
    elif kind == 3:
        raw[at:at] = raw[at : at + length]
    elif kind == 4:
        raw[at : at + length] = random.randbytes(length)
    else:
        # The marks of msgpack that claim the most: arrays, maps, texts and extensions of 4 GiB.
        raw[at : at + 5] = (
            random.choice((b"\xdd", b"\xdf", b"\xdb", b"\xc6", b"\xc9")) + b"\xff" * 4
        )
    return bytes(raw)
