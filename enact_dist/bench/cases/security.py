"""Bench `security`: what keys and rights cost, beside a plain cell in the same run.

Both cells have one daemon.  The secured one has keys, and rights with rules for `NAMES` names.
Both are reached over Zenoh, without memory in common; updates also over their Unix sockets.
"""

from __future__ import annotations

import contextlib
import itertools
from typing import TYPE_CHECKING, Final

from enact_dist.bench.cases.payloads import fetch, floats, store
from enact_dist.bench.cases.updates import slots, update
from enact_dist.bench.place import CARRIER_VARIABLE, WORLD, Place, environment, fresh_place
from enact_dist.bench.rows import Case, at_most, times
from enact_dist.bench.timing import repeating, timed
from enact_dist.core.protocol.messages import Ping
from enact_dist.core.rights.rules import Rights, Rule
from enact_dist.link.client.fetch import DatumCache
from enact_dist.terms import Entity
from enact_dist.world.connecting import connect

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from enact_dist.bench.run import Run
    from enact_dist.world.context import WorldContext

NAMES: Final = 61
RULES: Final = 1_000
LARGE: Final = Entity("s0/large")
NEAR: Final = "program1"
"""The name that asks over the socket, and the first segment of all that it may write."""
LARGE_BYTES: Final = 30_000_000
CALL_S: Final = 5.0
PLAIN, LOCKED = "plain", f"keys, rules for {NAMES} names"


def run_security(run: Run) -> None:
    """Calls, updates and large data with keys and rights and without; decisions about rights."""
    with contextlib.ExitStack() as stack:
        cases = []
        for what, names in ((PLAIN, 0), (LOCKED, NAMES)):
            place, _ = stack.enter_context(fresh_place("zenoh", names=names))
            cases += _cases(what, stack.enter_context(place.far_world()))
            cases.append(_near(what, stack.enter_context(_near_world(place))))
        run.measure([*cases, _known(), _new()])


@contextlib.contextmanager
def _near_world(place: Place) -> Iterator[WorldContext]:
    """Give the world context as a client with limited rights on the daemon's host has it."""
    with environment(**{CARRIER_VARIABLE: "socket"}):
        cell = connect(place.target, actor=NEAR)
    with cell:
        yield cell.world(WORLD)


def _near(what: str, world: WorldContext) -> Case:
    name = "update over a socket, volatile"
    writes = slots(world, 1, entity=f"{NEAR}/counter")
    plain = ("security", f"{name}, {PLAIN}")
    return Case(
        "security",
        f"{name}, {what}",
        repeating(lambda: update(writes)),
        plain if what == LOCKED else None,
        times(1.1, plain, "≤ 1.1 x plain") if what == LOCKED else None,
    )


def _cases(what: str, world: WorldContext) -> list[Case]:
    session = world.session
    writes = slots(world, 1, entity="s0/counter")
    store(world, LARGE, floats(LARGE_BYTES))

    def call() -> None:
        session.client.carrier.request("s0", Ping(), timeout_s=CALL_S)

    def fetch_anew() -> None:
        session.cache = DatumCache(0)  # what is known already would not travel
        fetch(world, LARGE)

    acts: dict[str, tuple[Callable[[], object], float | None, str]] = {
        "call": (call, 1.2, "≤ 1.2 x plain"),
        "update, volatile": (lambda: update(writes), None, ""),
        "30 MB read": (fetch_anew, 1 / 0.6, "≥ 0.6 of plain"),
    }
    return [
        Case(
            "security",
            f"{name}, {what}",
            repeating(act),
            ("security", f"{name}, {PLAIN}") if what == LOCKED else None,
            times(factor, ("security", f"{name}, {PLAIN}"), text)
            if factor is not None and what == LOCKED
            else None,
            bytes=LARGE_BYTES if act is fetch_anew else 0,
        )
        for name, (act, factor, text) in acts.items()
    ]


def _rights() -> Rights:
    """Return rights with `RULES` rules, each with stars, none of which gives what is asked for."""
    return Rights(
        Rule(("actor*",), (("read", f"{WORLD}{number}*/image/view/*/{number}"),))
        for number in range(RULES)
    )


def _known() -> Case:
    def measure(seconds_s: float) -> Sequence[float]:
        rights, path = _rights(), f"{WORLD}/image/view/7/left"
        rights.may("actor3", "read", path)
        return timed(lambda: rights.may("actor3", "read", path), seconds_s)

    return Case("security", "right, known", measure, goal=at_most(1.0, "≤ 1 µs"))


def _new() -> Case:
    def measure(seconds_s: float) -> Sequence[float]:
        rights, numbers = _rights(), itertools.count()
        rights.may("actor3", "read", f"{WORLD}/image/view/7/first")  # its rules are compiled then

        def decide() -> None:
            rights.may("actor3", "read", f"{WORLD}/image/view/a/{next(numbers)}")

        return timed(decide, seconds_s)

    text = "≤ 200 µs"
    return Case("security", f"right, new, {RULES:,} rules", measure, goal=at_most(200.0, text))
