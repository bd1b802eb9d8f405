"""Bench `layers`: where each microsecond of an update goes, layer by layer, as it runs.

In the process every layer is seen: its own time is what its calls take, less what the calls take
that it makes.  Over a carrier this process sees its own layers and how long the two calls take.
In those calls are, beside host and decisions: the wire (its rows are both sides together), twice
the carrier's floor, and what it costs to go on with cold caches after each wait.
"""

from __future__ import annotations

import contextlib
import itertools
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from enact_dist.bench.rows import Case
from enact_dist.bench.run import ROUNDS
from enact_dist.bench.timing import COUNT_MAX, timed
from enact_dist.bench.updates import floor_of, slots, update
from enact_dist.core.shard import Shard
from enact_dist.link.client import CellClient
from enact_dist.link.embedded import EmbeddedCarrier
from enact_dist.wire.frames import decode_frame, encode_frame

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from enact_dist.bench.run import Run
    from enact_dist.core.messages import Message
    from enact_dist.world import WorldContext

NAME: Final = "layers"
LOCK: Final = "lock and its data"
CLIENT: Final = "client"
CALLS: Final = "two calls"
HOST: Final = "host"
DECISIONS: Final = "decisions"
INNER: Final = {LOCK: CLIENT, CLIENT: CALLS, HOST: DECISIONS}
"""Which layer's time is contained in which."""


class Watch:
    """Adds up how long the calls of each layer take in one thread, those that they make included.

    Attributes:
        spent_ns: By layer.
        messages: What the calls of a carrier were asked and answered, in order.
    """

    def __init__(self) -> None:
        self.spent_ns: dict[str, int] = {}
        self.messages: list[Message] = []
        self._thread = threading.get_ident()

    @contextlib.contextmanager
    def over(self, owner: type[Any], name: str, layer: str) -> Iterator[None]:
        """Count the calls of a method to a layer while the block runs."""
        method = getattr(owner, name)

        def counted(*args: Any, **options: Any) -> Any:
            if threading.get_ident() != self._thread:
                return method(*args, **options)
            started_ns = time.perf_counter_ns()
            result = method(*args, **options)
            self.spent_ns[layer] = self.spent_ns.get(layer, 0) + (
                time.perf_counter_ns() - started_ns
            )
            if layer == CALLS:
                self.messages += (args[2], result)
            return result

        setattr(owner, name, counted)
        try:
            yield
        finally:
            setattr(owner, name, method)


def run_layers(run: Run) -> None:
    """Measure updates with a watch at every layer, and what travels by itself."""
    acts = {carrier: _update_of(run.place.world(carrier)) for carrier in run.place.carriers}
    floors = {carrier: floor_of(run.place.way(carrier)) for carrier in acts}
    run.measure(
        [
            Case(NAME, f"{carrier}, whole update", partial(timed, act), floors[carrier])
            for carrier, act in acts.items()
        ]
    )
    messages: list[Message] = []
    for number, (carrier, act) in itertools.product(range(ROUNDS), acts.items()):
        run.told(f"{NAME}: {carrier} ({number + 1} of {ROUNDS})")
        own_us, messages = layer_times_us(
            act, run.place.world(carrier), seconds_s=run.seconds_s / ROUNDS
        )
        for layer, times_us in own_us.items():
            case = Case(NAME, f"{carrier}, {layer}", lambda _seconds_s: (), floors[carrier])
            run.add(case, times_us)
    run.measure(_wire_cases(messages))


def _update_of(world: WorldContext) -> Callable[[], None]:
    (write,) = slots(world, 1, entity="layers")
    return lambda: update((write,))


def layer_times_us(
    act: Callable[[], None], world: WorldContext, *, seconds_s: float
) -> tuple[dict[str, list[float]], list[Message]]:
    """Repeat an act; return the own times of each layer, and the messages of the last act.

    Args:
        act: One update of a slot of `world`.
        world: As its cell's client reaches it.
        seconds_s: How long to go on.
    """
    watch = Watch()
    carrier = type(world.session.client.carrier)
    with contextlib.ExitStack() as stack:
        for name in ("acquire", "finish"):
            stack.enter_context(watch.over(CellClient, name, CLIENT))
        stack.enter_context(watch.over(carrier, "request", CALLS))
        if carrier is EmbeddedCarrier:
            stack.enter_context(watch.over(Shard, "handle", DECISIONS))
        act()
        found: dict[str, list[float]] = {}
        end_s = time.perf_counter() + seconds_s
        for _ in range(COUNT_MAX):
            watch.spent_ns.clear()
            watch.messages.clear()
            started_ns = time.perf_counter_ns()
            act()
            watch.spent_ns[LOCK] = time.perf_counter_ns() - started_ns
            for layer, own_ns in _own_ns(watch.spent_ns).items():
                found.setdefault(layer, []).append(own_ns / 1e3)
            if time.perf_counter() >= end_s:
                break
    return found, watch.messages


def _own_ns(spent_ns: dict[str, int]) -> dict[str, int]:
    """Return what each layer took beside the one within it; a host is what calls it, where seen."""
    if DECISIONS in spent_ns:
        spent_ns = {HOST: spent_ns[CALLS], **spent_ns}
    return {
        layer: spent_ns[layer] - spent_ns.get(INNER.get(layer, ""), 0)
        for layer in (LOCK, CLIENT, *((HOST, DECISIONS) if HOST in spent_ns else (CALLS,)))
    }


def _wire_cases(messages: Sequence[Message]) -> list[Case]:
    """Return the cases of the frames of one update: all written, all read."""
    frames = [encode_frame(message) for message in messages]

    def write() -> None:
        for message in messages:
            encode_frame(message)

    def read() -> None:
        for header, payload in frames:
            decode_frame(header, payload or b"")

    return [
        Case(
            NAME, f"wire, {len(frames)} frames written", lambda seconds_s: timed(write, seconds_s)
        ),
        Case(NAME, f"wire, {len(frames)} frames read", lambda seconds_s: timed(read, seconds_s)),
    ]
