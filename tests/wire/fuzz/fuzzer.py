"""A mutational fuzzer: valid inputs, spoilt in ways that reach deep, against the targets.

Two kinds of mutation: of bytes (flips, cuts, copies, boasting lengths), and of the tree where the
bytes are msgpack (a node replaced, moved, repeated, nested), so that what comes out is whole msgpack
that nobody should send.  `Finder` can also watch which lines of the decoders run: inputs that
reach new ones are kept and mutated further.
"""

from __future__ import annotations

import random
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import msgpack
from fuzz.targets import TARGETS

INPUT_BYTES_MAX = 64 << 10
SECONDS_MAX = 0.1
"""How much of its processor a decoder may take for one input; other load does not count."""
MEMORY_BYTES_MAX = 16 << 20
"""How much memory it may take at most while it does."""
WATCHED = (
    "enact_dist/wire/",
    "enact_dist/link/store/",
    "enact_dist/link/folder/",
    "enact_dist/actor/report",
)

NUMBERS = (
    0,
    1,
    -1,
    127,
    128,
    255,
    256,
    4096,
    1 << 31,
    1 << 32,
    (1 << 63) - 1,
    1 << 63,
    (1 << 64) - 1,
)
VALUES: tuple[Any, ...] = (
    *NUMBERS,
    -(1 << 63),
    None,
    True,
    0.0,
    float("nan"),
    float("inf"),
    1e300,
    "",
    "a",
    "größe",
    "C",
    "<f8",
    "|O",
    "V0",
    b"",
    b"\xff" * 300,
    (),
    (1, (2, (3,))),
    {},
    {"itemsize": 8, "fields": []},
    {1: 2, "a": None},
    msgpack.ExtType(1, b""),
    msgpack.ExtType(7, msgpack.packb([0, 1])),
    msgpack.Timestamp(0, 5),
)
BOASTS = (b"\xdd", b"\xdf", b"\xdb", b"\xc6", b"\xc9", b"\xdc", b"\xde", b"\xda", b"\xc5", b"\xc8")
TIMES = (b"\xd6\xff" + b"\xff" * 4, b"\xd7\xff" + b"\xff" * 8, b"\xc7\x0c\xff" + b"\xff" * 12)
"""Points in time as msgpack's own extension has them, some of them out of range."""


class Finding(Exception):
    """An input that a target should have refused, or taken, otherwise."""


# ---------------------------------------------------------------- mutation


def mutated(raw: bytes, pool: list[bytes], rng: random.Random) -> bytes:
    """Return an input with one to four mutations."""
    for _ in range(rng.choice((1, 1, 1, 2, 3, 4))):
        raw = _mutated_tree(raw, rng) if rng.random() < 0.5 else _mutated_bytes(raw, pool, rng)
    return raw[:INPUT_BYTES_MAX]


def _mutated_bytes(raw: bytes, pool: list[bytes], rng: random.Random) -> bytes:
    data = bytearray(raw or b"\0")
    at, length = rng.randrange(len(data)), rng.choice((1, 1, 2, 4, 8, 64))
    kind = rng.randrange(10)
    if kind == 9:
        data[at : at + 1] = rng.choice(TIMES)
    elif kind == 0:
        data[at] ^= 1 << rng.randrange(8)
    elif kind == 1:
        data[at] = rng.randrange(256)
    elif kind == 2:
        del data[at:]
    elif kind == 3:
        del data[at : at + length]
    elif kind == 4:
        data[at:at] = data[at : at + length] * rng.choice((1, 2, 1000))
    elif kind == 5:
        data[at : at + length] = rng.randbytes(length)
    elif kind == 6:
        data[at : at + 5] = rng.choice(BOASTS) + rng.choice((b"\xff", b"\0", b"\x01")) * 4
    elif kind == 7:
        data[at : at + 4] = (rng.choice(NUMBERS) & 0xFFFFFFFF).to_bytes(4, "little")
    else:
        other = rng.choice(pool)
        data[at:] = other[rng.randrange(len(other) + 1) :]
    return bytes(data)


def _mutated_tree(raw: bytes, rng: random.Random) -> bytes:
    """Mutate a node of a msgpack object that stands somewhere in the input."""
    starts = list(range(min(len(raw), 40)))
    rng.shuffle(starts)
    for at in starts[:12]:
        unpacker = msgpack.Unpacker(use_list=False, strict_map_key=False, ext_hook=msgpack.ExtType)
        try:
            unpacker.feed(raw[at:])
            tree = unpacker.unpack()
        except Exception:
            continue
        if unpacker.tell() < 2:
            continue
        try:
            packed = msgpack.packb(_changed(tree, rng))
        except (ValueError, TypeError, OverflowError, UnicodeError):
            continue
        grown = len(packed) - unpacker.tell()
        before = bytearray(raw[:at])
        if len(before) >= 4 and rng.random() < 0.8:
            # The length that stands before a part grows with it, or the rest would be cut off.
            place = rng.choice([p for p in (0, 1, 5) if p + 4 <= len(before)])
            length = int.from_bytes(before[place : place + 4], "little") + grown
            before[place : place + 4] = (length & 0xFFFFFFFF).to_bytes(4, "little")
        return bytes(before) + packed + raw[at + unpacker.tell() :]
    return raw


def _changed(tree: Any, rng: random.Random) -> Any:
    """Return a tree with one node changed."""
    if isinstance(tree, msgpack.ExtType) and rng.random() < 0.9:
        return _changed_extension(tree, rng)
    if isinstance(tree, tuple) and tree and rng.random() < 0.9:
        parts, at = list(tree), rng.randrange(len(tree))
        kind = rng.randrange(8)
        if kind == 0:
            del parts[at]
        elif kind == 1:
            parts[at:at] = [parts[at]] * rng.choice((1, 2, 300))
        elif kind == 2:
            parts[at] = rng.choice(parts)
        else:
            parts[at] = _changed(parts[at], rng)
        return tuple(parts)
    if isinstance(tree, dict) and tree and rng.random() < 0.9:
        name = rng.choice(list(tree))
        return {**tree, name: _changed(tree[name], rng)}
    if type(tree) is int and rng.random() < 0.5:
        return tree + rng.choice((-1, 1, 63, 64))
    if isinstance(tree, str | bytes) and tree and rng.random() < 0.3:
        return (tree * rng.choice((2, 100, 3000)))[:INPUT_BYTES_MAX] if len(tree) < 999 else tree
    kind = rng.randrange(8)
    if kind == 0:
        return (tree,)
    if kind == 1:
        nested = tree
        for _ in range(rng.choice((5, 40, 200))):
            nested = (nested,)
        return nested
    return rng.choice(VALUES)


def _changed_extension(tree: Any, rng: random.Random) -> Any:
    if rng.random() < 0.2:
        return msgpack.ExtType(rng.randrange(-2, 10), tree.data)
    try:
        content = msgpack.unpackb(
            tree.data, use_list=False, strict_map_key=False, ext_hook=msgpack.ExtType
        )
        return msgpack.ExtType(tree.code, msgpack.packb(_changed(content, rng)))
    except Exception:  # its content is no msgpack
        return msgpack.ExtType(tree.code, rng.randbytes(8))


# ---------------------------------------------------------------- one input


def tried(name: str, raw: bytes, *, watch_memory: bool = False) -> object:
    """Give an input to a target; return what it stands for, None where it is refused.

    Raises:
        Finding: Another exception left it, or it took too long or too much memory.
    """
    target = TARGETS[name]
    if watch_memory:
        tracemalloc.start()
    started_s = time.thread_time()
    try:
        found = target(raw)
    except Exception as error:
        raise Finding(f"{name}: {type(error).__name__}: {error} left for {raw[:200]!r}") from error
    finally:
        spent_s = time.thread_time() - started_s
        peak = tracemalloc.get_traced_memory()[1] if watch_memory else 0
        tracemalloc.stop()
    if peak > MEMORY_BYTES_MAX:
        raise Finding(f"{name}: {peak} bytes of memory for {len(raw)} bytes: {raw[:200]!r}")
    if spent_s > SECONDS_MAX and not watch_memory:
        # A cold cache may have been it: the best of five counts.
        spent_s = min(_spent_s(target, raw) for _ in range(5))
        if spent_s > SECONDS_MAX:
            raise Finding(f"{name}: {spent_s:.3f} s for {len(raw)} bytes: {raw[:200]!r}")
    return found


def _spent_s(target: Callable[[bytes], object], raw: bytes) -> float:
    started_s = time.thread_time()
    target(raw)
    return time.thread_time() - started_s


def lines_of(name: str, raw: bytes) -> frozenset[tuple[str, int, int]]:
    """Return which steps from line to line of the decoders an input makes."""
    steps: set[tuple[str, int, int]] = set()
    before = [0]

    def on_line(frame: FrameType, event: str, _: object) -> Any:
        if event == "line":
            steps.add((frame.f_code.co_filename, before[0], frame.f_lineno))
            before[0] = frame.f_lineno
        return on_line

    def on_call(frame: FrameType, event: str, _: object) -> Any:
        watched = any(part in frame.f_code.co_filename for part in WATCHED)
        return on_line if watched else None

    sys.settrace(on_call)
    try:
        TARGETS[name](raw)
    except Exception:
        pass
    finally:
        sys.settrace(None)
    return frozenset(steps)


# ---------------------------------------------------------------- a run


@dataclass
class Finder:
    """Fuzzes one target, from some inputs on.

    Attributes:
        pool: What is mutated: the inputs given, and with `grow` those that reached new lines.
        grow: Whether to watch lines (ten times slower).
        found: Findings and their inputs, one of each kind.
    """

    name: str
    pool: list[bytes]
    rng: random.Random
    grow: bool = False
    tries: int = 0
    taken: int = 0
    found: dict[str, tuple[bytes, Finding]] = field(default_factory=dict)
    seen: set[tuple[str, int, int]] = field(default_factory=set)
    kept: list[bytes] = field(default_factory=list)

    def run(self, seconds: float, *, at_least: int = 0) -> None:
        """Try mutated inputs for so long; on a slow machine until so many, and one taken, too."""
        end_s = time.monotonic() + seconds
        if self.grow:
            for raw in self.pool:
                self.seen |= lines_of(self.name, raw)
        while (
            time.monotonic() < end_s
            or self.tries < at_least
            or (not self.taken and self.tries < 100 * at_least)
        ):
            for raw in [
                mutated(self.rng.choice(self.pool), self.pool, self.rng) for _ in range(20)
            ]:
                self.one(raw)

    def one(self, raw: bytes) -> None:
        """Try one input."""
        self.tries += 1
        try:
            self.taken += tried(self.name, raw, watch_memory=self.tries % 50 == 0) is not None
        except Finding as finding:
            cause = finding.__cause__
            kind = type(cause).__name__ + str(_place(cause)) if cause else str(finding)[:30]
            self.found.setdefault(kind, (raw, finding))
            return
        if self.grow and len(raw) < 4096:
            steps = lines_of(self.name, raw)
            if not steps <= self.seen:
                self.seen |= steps
                self.pool.append(raw)
                self.kept.append(raw)


def _place(error: BaseException) -> tuple[str, int]:
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return (Path(trace.tb_frame.f_code.co_filename).name, trace.tb_lineno) if trace else ("", 0)


def minimised(name: str, inputs: list[bytes], bytes_max: int) -> Iterator[bytes]:
    """Yield few short inputs that together make every step that all of them make."""
    steps = {raw: lines_of(name, raw) for raw in set(inputs)}
    left = frozenset().union(*steps.values())
    spent = 0
    while left and spent < bytes_max:
        best = max(steps, key=lambda raw: (len(steps[raw] & left) / (len(raw) + 50), raw))
        if not steps[best] & left:
            return
        left -= steps.pop(best)
        spent += len(best)
        yield best
