"""An Ethernet switch in user space: what lies between two hosts is slow, lossy, narrow or cut.

``python -m …chaos.network.switch SEED PORTS`` forwards between the interfaces `v0`, `v1`
and so on of its network namespace, whose other ends have the addresses of `address`; it says
`started`, then takes one change per line (a JSON array) and says `done` once it holds:

=======  =========================================================================================
word     then
=======  =========================================================================================
cut      source, target: ports; whatever goes from one to the other is lost from now on
heal     source, target: ends a cut
cable    source, target, delay_s, jitter_s, loss, bytes_per_s: see `Cable`
count    nothing; says `count` and a JSON object of `Counts` in place of `done`
=======  =========================================================================================

It ends with its standard input.  A kernel need not have a queueing discipline for any of this
(many lack netem), and no host needs `/dev/net/tun`: the frames come through packet sockets.
"""

from __future__ import annotations

import heapq
import itertools
import json
import os
import random
import select
import socket
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, astuple, dataclass
from functools import partial
from typing import Final

from enact_dist.errors import MisuseError

MODULE: Final = "enact_dist.verify.chaos.network.switch"
QUEUE_S: Final = 0.25
"""What a narrow cable cannot carry within so long is dropped, as by a router."""
_ALL_PROTOCOLS: Final = 0x0003
_PACKET, _VNET_HEADER, _IGNORE_OUTGOING = 263, 15, 23  # of linux/if_packet.h
_HEADER_BYTES: Final = 10
"""In front of each frame: what the sender's kernel left to its network card, such as a checksum."""
_FRAME_BYTES_MAX: Final = 1 << 17
_BUFFER_BYTES: Final = 8 << 20
_AT_ONCE: Final = 64
"""Frames taken from one port before the others have their turn."""


@dataclass(frozen=True, slots=True)
class Cable:
    """How what one host sends gets to another; what is sent back has a cable of its own.

    Attributes:
        delay_s: How long each frame takes.
        jitter_s: By how much some take longer, evenly spread; they stay in order.
        loss: Part of the frames that is lost, from 0 to 1.
        bytes_per_s: Its bandwidth; 0: unlimited.
    """

    delay_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    bytes_per_s: float = 0.0

    def __post_init__(self) -> None:
        if min(astuple(self)) < 0.0 or self.loss > 1.0:
            raise MisuseError(f"{self} cannot be: a loss is a part of 1, nothing is negative")


@dataclass(slots=True)
class Counts:
    """What became of the frames.

    Attributes:
        cut: Lost by a cut; `lost`: by chance, as a cable says.
        crowded: Dropped since a narrow cable was full.
        refused: Not taken by the kernel of the target.
    """

    forwarded: int = 0
    cut: int = 0
    lost: int = 0
    crowded: int = 0
    refused: int = 0


def address(port: int) -> str:
    """Return the hardware address of the host at a port."""
    return f"02:00:00:00:00:{port:02x}"


class _Way:
    """One direction between two ports."""

    __slots__ = ("cable", "cut", "draw", "free_ns", "last_ns")

    def __init__(self, seed: str) -> None:
        self.cable = Cable()
        self.cut = False
        self.draw = random.Random(seed)
        self.free_ns = 0
        self.last_ns = 0

    def due_ns(self, now_ns: int, size: int, counts: Counts) -> int | None:
        """Return when a frame of so many bytes arrives; None if it never does."""
        if self.cut:
            counts.cut += 1
            return None
        cable = self.cable
        if cable.loss and self.draw.random() < cable.loss:
            counts.lost += 1
            return None
        due_ns = now_ns
        if cable.bytes_per_s:
            self.free_ns = max(self.free_ns, now_ns)
            if self.free_ns > now_ns + QUEUE_S * 1e9:
                counts.crowded += 1
                return None
            self.free_ns += int(size / cable.bytes_per_s * 1e9)
            due_ns = self.free_ns
        if cable.delay_s or cable.jitter_s:
            jitter_s = self.draw.uniform(0.0, cable.jitter_s) if cable.jitter_s else 0.0
            due_ns += int((cable.delay_s + jitter_s) * 1e9)
        self.last_ns = max(self.last_ns, due_ns)
        return self.last_ns


class Switch:
    """Forwards frames between ports; see the module.

    Args:
        seed: Losses and jitter are drawn from it, of each direction apart.
        ports: Packet sockets of the interfaces.
        control: Descriptor of the lines.
        say: Receives the messages.
    """

    def __init__(
        self,
        seed: int,
        ports: Sequence[socket.socket],
        control: int,
        *,
        say: Callable[[str], object],
    ) -> None:
        self._ports, self._control, self._say = ports, control, say
        self._ways = {
            (one, other): _Way(f"{seed} {one} {other}")
            for one in range(len(ports))
            for other in range(len(ports))
            if one != other
        }
        self._target_of = {
            bytes.fromhex(address(port).replace(":", "")): port for port in range(len(ports))
        }
        self._queue: list[tuple[int, int, int, bytes]] = []
        self._number = itertools.count()
        self._said = b""
        self.counts = Counts()

    def run(self) -> None:
        """Forward until the lines end."""
        index_of = {port.fileno(): index for index, port in enumerate(self._ports)}
        readers = [self._control, *index_of]
        while True:
            pause_s = max(0, self._queue[0][0] - time.monotonic_ns()) / 1e9 if self._queue else None
            ready, _, _ = select.select(readers, [], [], pause_s)
            for descriptor in ready:
                if descriptor != self._control:
                    self._take(index_of[descriptor])
                elif not self._listen():
                    return
            now_ns = time.monotonic_ns()
            while self._queue and self._queue[0][0] <= now_ns:
                _, _, target, frame = heapq.heappop(self._queue)
                self._put(target, frame)

    # ---------------------------------------------------------------- frames

    def _take(self, source: int) -> None:
        """Take what has come in at a port and send it on its way."""
        for _ in range(_AT_ONCE):
            try:
                frame = self._ports[source].recv(_FRAME_BYTES_MAX)
            except BlockingIOError:
                return
            target = self._target_of.get(frame[_HEADER_BYTES : _HEADER_BYTES + 6])
            if target is not None:
                if target != source:
                    self._send(source, target, frame)
            elif frame[_HEADER_BYTES] & 1:  # to a group
                for port in range(len(self._ports)):
                    if port != source:
                        self._send(source, port, frame)

    def _send(self, source: int, target: int, frame: bytes) -> None:
        now_ns = time.monotonic_ns()
        size = len(frame) - _HEADER_BYTES
        due_ns = self._ways[source, target].due_ns(now_ns, size, self.counts)
        if due_ns is None:
            return
        if due_ns <= now_ns:
            self._put(target, frame)
        else:
            heapq.heappush(self._queue, (due_ns, next(self._number), target, frame))

    def _put(self, target: int, frame: bytes) -> None:
        try:
            self._ports[target].send(frame)
            self.counts.forwarded += 1
        except OSError:  # its queue is full, or the interface is down
            self.counts.refused += 1

    # ---------------------------------------------------------------- lines

    def _listen(self) -> bool:
        """Carry out the lines that have come; say whether more may."""
        said = os.read(self._control, 1 << 16)
        *lines, self._said = (self._said + said).split(b"\n")
        for line in lines:
            self._obey(*json.loads(line))
        return bool(said)

    def _obey(self, word: str, *rest: float) -> None:
        if word == "count":
            self._say(f"count {json.dumps(asdict(self.counts))}")
            return
        source, target, *values = rest
        way = self._ways[int(source), int(target)]
        if word == "cable":
            way.cable = Cable(*values)
            way.free_ns = 0
        else:
            way.cut = word == "cut"
        self._say("done")


def open_port(interface: str) -> socket.socket:
    """Return a socket through which all frames of an interface come and go.

    Raises:
        OSError: There is no interface of that name, or the system does not allow it.
    """
    port = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    port.setsockopt(_PACKET, _VNET_HEADER, 1)
    port.setsockopt(_PACKET, _IGNORE_OUTGOING, 1)
    for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
        port.setsockopt(socket.SOL_SOCKET, option, _BUFFER_BYTES)
    port.bind((interface, _ALL_PROTOCOLS))
    port.setblocking(False)
    return port


def main() -> None:
    """Forward until standard input ends."""
    seed, count = map(int, sys.argv[1:])
    ports = [open_port(f"v{index}") for index in range(count)]
    print("started", flush=True)
    Switch(seed, ports, sys.stdin.fileno(), say=partial(print, flush=True)).run()


if __name__ == "__main__":
    main()
