"""Bench `layers`: where each microsecond of an update or a fetch goes, layer by layer, as it runs.

In the process every layer is seen: its own time is what its calls take, less what the calls take
that it makes.  Over a carrier this process sees its own layers and how long the two calls take.
In those calls are, beside host and decisions: the wire (its rows are both sides together), twice
the carrier's floor, and what it costs to go on with cold caches after each wait.

Updates come back to back and 20 ms apart.  Of a fetch the datum is seen, too: how long it takes to
be here (fetched in slices, or mapped), to be decoded, and to be touched for the first time.  A
wake-up is a fetch that begins with a notice, 20 ms after the last one.
"""

from __future__ import annotations

import contextlib
import itertools
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final

from enact_dist.access import reads as reading
from enact_dist.bench.cases import payloads
from enact_dist.bench.cases.payloads import (
    ARRAY,
    LARGEST,
    SMALL,
    WAIT_S,
    Storer,
    entity,
    fetch,
    floats,
)
from enact_dist.bench.cases.updates import floor_of, slots, update
from enact_dist.bench.floors import PAUSED, SIZES, mapped, reply
from enact_dist.bench.place import EMBEDDED
from enact_dist.bench.rows import Case, Key
from enact_dist.bench.run import ROUNDS, Run
from enact_dist.bench.timing import COUNT_MAX, PAUSE_S, repeating
from enact_dist.core.protocol.messages import Message
from enact_dist.core.shard.shard import Shard
from enact_dist.errors import LinkError
from enact_dist.link.client.locks import CellClient
from enact_dist.link.daemon.embedded import EmbeddedCarrier
from enact_dist.wire.frames import decode_frame, encode_frame
from enact_dist.world.context import WorldContext

NAME: Final = "layers"
LOCK: Final = "lock and its data"
CLIENT: Final = "client"
CALLS: Final = "two calls"
HOST: Final = "host"
DECISIONS: Final = "decisions"
FETCHED: Final = "datum fetched or mapped"
DECODED: Final = "datum decoded"
TOUCHED: Final = "first and last element touched"
ORDERED: Final = "from the order to write to the notice of it"
LAYERS: Final = (LOCK, CLIENT, CALLS, HOST, DECISIONS, FETCHED, DECODED, TOUCHED)
"""From outside to inside, then what a fetch has beside them."""
WOKEN_SIZE: Final = "0.9 MB"


class LayerWatch:
    """Adds up how long the calls of each layer take in one thread, less the watched calls in them.

    Attributes:
        spent_ns: By layer.
        messages: What the calls of a carrier were asked and answered, in order.
    """

    def __init__(self) -> None:
        self.spent_ns: dict[str, int] = {}
        self.messages: list[Message] = []
        self._thread = threading.get_ident()
        self._inner_ns = 0

    def counted(self, layer: str, act: Callable[[], Any]) -> Any:
        """Act, and count it to a layer."""
        outer_ns, self._inner_ns = self._inner_ns, 0
        started_ns = time.perf_counter_ns()
        result = act()
        took_ns = time.perf_counter_ns() - started_ns
        self.spent_ns[layer] = self.spent_ns.get(layer, 0) + took_ns - self._inner_ns
        self._inner_ns = outer_ns + took_ns
        return result

    @contextlib.contextmanager
    def over(self, owner: Any, name: str, layer: str) -> Iterator[None]:
        """Count the calls of a method, or of a module's function, to a layer while it runs."""
        method = getattr(owner, name)

        def counted(*args: Any, **options: Any) -> Any:
            if threading.get_ident() != self._thread:
                return method(*args, **options)
            result = self.counted(layer, partial(method, *args, **options))
            if layer in (CALLS, HOST):
                self.messages += (args[2], result)
            return result

        setattr(owner, name, counted)
        try:
            yield
        finally:
            setattr(owner, name, method)


@dataclass(frozen=True, slots=True)
class Profile:
    """An act that is shown by layers.

    Attributes:
        what: What it is, and where.
        world: As its cell's client reaches it.
        act: One lock of `world`.
        floor: What it is divided by.
        before: Called before each act, not timed.
        of_datum: Whether the layers of a fetched datum are seen, too.
        ordered_us: Filled by `before`: how long the notice took, for which it waited.
    """

    what: str
    world: WorldContext
    act: Callable[[], object]
    floor: Key
    before: Callable[[], object] | None = None
    of_datum: bool = False
    ordered_us: list[float] = field(default_factory=list)


def run_layers(run: Run) -> None:
    """Measure each act with a watch at every layer, and what travels by itself."""
    with contextlib.ExitStack() as stack:
        profiles = [*_near_profiles(run)]
        if not run.place.embedded:
            profiles += _profiles_between(run, stack)
        run.measure([_whole(profile) for profile in profiles])
        messages: list[Message] = []
        for number, profile in itertools.product(range(ROUNDS), profiles):
            run.told(f"{NAME}: {profile.what} ({number + 1} of {ROUNDS})")
            own_us, said = layer_times_us(profile, seconds_s=run.seconds_s / ROUNDS)
            messages = messages or said
            for layer in filter(own_us.__contains__, LAYERS):
                run.add(_part(profile, layer), own_us[layer])
        for profile in profiles:
            if profile.ordered_us:
                run.add(_part(profile, ORDERED), profile.ordered_us)
    run.measure(_wire_cases(messages))


def _whole(profile: Profile) -> Case:
    measure = repeating(profile.act, before=profile.before)
    return Case(NAME, f"{profile.what}, whole", measure, profile.floor)


def _part(profile: Profile, part: str) -> Case:
    return Case(NAME, f"{profile.what}, {part}", lambda _seconds_s: (), profile.floor)


def _near_profiles(run: Run) -> Iterator[Profile]:
    """Give updates over each carrier, and fetches in the process."""
    for carrier in run.place.carriers:
        world, way = run.place.world(carrier), run.place.way(carrier)
        act = partial(update, slots(world, 1, entity="layers"))
        yield Profile(f"{carrier}, update", world, act, floor_of(way))
        what, floor = f"{carrier}, update{PAUSED}", floor_of(way, paused=True)
        yield Profile(what, world, act, floor, before=partial(time.sleep, PAUSE_S))
    if EMBEDDED in run.place.carriers:
        world = run.place.world(EMBEDDED)
        for size in (SMALL, LARGEST):
            payloads.store(world, entity(size), floats(SIZES[size]))
            what, fetching = f"{EMBEDDED}, fetch of {size}", partial(fetch, world, entity(size))
            yield Profile(what, world, fetching, mapped(size), of_datum=True)


def _profiles_between(run: Run, stack: contextlib.ExitStack) -> Iterator[Profile]:
    """Give a fetch of what another process has written, and a wake-up by it."""
    place = run.place
    fresh = Storer(stack.enter_context(place.worker("storer", carrier=place.carrier)))
    of, count = entity(WOKEN_SIZE), SIZES[WOKEN_SIZE]
    far = stack.enter_context(place.far_world())
    yield Profile(
        f"no common memory, fetch of {WOKEN_SIZE}",
        far,
        partial(fetch, far, of),
        reply(WOKEN_SIZE),
        partial(fresh.store, of, count),
        of_datum=True,
    )
    world, of = place.world(place.carrier), entity("wakeup")
    fresh.store(of, count)
    notices = stack.enter_context(world.watch(of, ARRAY))
    ordered_us: list[float] = []

    def be_woken() -> None:
        fresh.wait()
        while notices.next(timeout_s=0.0) is not None:
            pass
        time.sleep(PAUSE_S)
        started_s = time.perf_counter()
        fresh.order(of, count)
        if notices.next(timeout_s=WAIT_S) is None:
            raise LinkError(f"no notice of {of.name} within {WAIT_S:.0f} s of its change")
        ordered_us.append((time.perf_counter() - started_s) * 1e6)

    floor = floor_of(place.way(place.carrier), paused=True)
    what, act = f"{place.carrier}, wake-up by {WOKEN_SIZE}", partial(fetch, world, of)
    yield Profile(what, world, act, floor, be_woken, of_datum=True, ordered_us=ordered_us)


def layer_times_us(
    profile: Profile, *, seconds_s: float
) -> tuple[dict[str, list[float]], list[Message]]:
    """Repeat an act; return the own times of each layer, and the messages of the last act.

    Args:
        profile: The act.
        seconds_s: How long to go on.
    """
    watch = LayerWatch()
    carrier = type(profile.world.session.client.carrier)
    before = profile.before or (lambda: None)
    with contextlib.ExitStack() as stack:
        for owner, name, layer in _watched(carrier, of_datum=profile.of_datum):
            stack.enter_context(watch.over(owner, name, layer))
        before()
        profile.act()
        found: dict[str, list[float]] = {}
        end_s = time.perf_counter() + seconds_s
        for _ in range(COUNT_MAX):
            before()
            watch.spent_ns.clear()
            watch.messages.clear()
            watch.counted(LOCK, profile.act)
            for layer, own_ns in watch.spent_ns.items():
                found.setdefault(layer, []).append(own_ns / 1e3)
            if time.perf_counter() >= end_s:
                break
    return found, watch.messages


def _watched(carrier: type[Any], *, of_datum: bool) -> Iterator[tuple[Any, str, str]]:
    """Give what is watched, its method or function, and the layer that it stands for."""
    for name in ("acquire", "finish"):
        yield CellClient, name, CLIENT
    # In the process a call is the host's own work, but for the decisions in it.
    yield carrier, "request", HOST if carrier is EmbeddedCarrier else CALLS
    if carrier is EmbeddedCarrier:
        yield Shard, "handle", DECISIONS
    if of_datum:
        yield reading.Readings, "_fetched", FETCHED
        yield reading, "decode_datum", DECODED
        yield payloads, "touched", TOUCHED


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
        Case(NAME, f"wire, {len(frames)} frames written", repeating(write)),
        Case(NAME, f"wire, {len(frames)} frames read", repeating(read)),
    ]
