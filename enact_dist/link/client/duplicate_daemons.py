"""Detects two daemons with the same shard name, by asking at each known endpoint.

A shard that runs twice, from two folders at two endpoints, is two shards: clients of one never see
writes to the other.  No single place can see this, so a process that learns of a second endpoint
asks at both.  The random number of a start tells daemons apart, not the epoch: two folders may have
the same epoch, and a restart at the same endpoint is one daemon after another.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from enact_dist.core.protocol.messages import ListPlaces, Ping, Places, Pong, ShardEntry
from enact_dist.core.protocol.records import Compare, Served
from enact_dist.errors import ConfigError, ShardUnreachableError
from enact_dist.link.zenoh.config import to_reach
from enact_dist.link.zenoh.discovery import FoundShard, ask_shards
from enact_dist.link.zenoh.endpoints import PROTOCOLS, somebody_listens, split_endpoint
from enact_dist.link.zenoh.tls import KeyFiles

_log = logging.getLogger("enact.link")


@dataclass(frozen=True, slots=True)
class Serving:
    """A daemon that serves a shard, as it answered.

    Attributes:
        endpoint: Where it answers.
        start: The random number of its start.
        uptime_s: Time since its start.
    """

    endpoint: str
    start: int
    epoch: int
    uptime_s: float

    def __str__(self) -> str:
        return f"{self.endpoint} (epoch {self.epoch}, up {self.uptime_s:.0f} s)"


def serving(
    cell: str,
    shard: str,
    endpoints: Iterable[str],
    *,
    timeout_s: float,
    keys: KeyFiles | None = None,
) -> tuple[Serving, ...]:
    """Ask endpoint by endpoint which daemon serves a shard there; return each daemon once.

    Invalid endpoints are skipped.  Each of the others has `timeout_s` to answer.

    Raises:
        ProtocolError: An answer cannot be read.
    """
    found: dict[int, Serving] = {}
    for endpoint in dict.fromkeys(map(to_reach, endpoints)):
        if (one := _serving_at(cell, shard, endpoint, timeout_s, keys)) is not None:
            found.setdefault(one.start, one)
    if len(found) < 2:
        return tuple(found.values())
    # A daemon that restarted between two questions has answered as two; the earlier one is gone.
    again = (
        _serving_at(cell, shard, one.endpoint, timeout_s, keys) or one for one in found.values()
    )
    return tuple({one.start: one for one in again}.values())


def _serving_at(
    cell: str, shard: str, endpoint: str, timeout_s: float, keys: KeyFiles | None
) -> Serving | None:
    if split_endpoint(endpoint)[0] not in PROTOCOLS or not somebody_listens(endpoint):
        return None
    wanted = FoundShard(cell, shard)
    try:
        answers = ask_shards([endpoint], [wanted], Ping(), timeout_s=timeout_s, keys=keys)
    except (ConfigError, ShardUnreachableError) as error:  # or another shard answers in its name
        _log.warning("shard %s is announced at an invalid endpoint: %s", shard, error)
        return None
    answer = answers.get(wanted)
    if not isinstance(answer, Pong):
        return None
    return Serving(endpoint, answer.start, answer.epoch, answer.uptime_ns / 1e9)


def expected_places(
    cell: str, shards: Sequence[ShardEntry], *, timeout_s: float, keys: KeyFiles | None = None
) -> list[tuple[ShardEntry, ...]]:
    """Ask shards of a cell where they expect each shard; return their answers.

    All together have `timeout_s` to answer; slower shards are left out.

    Raises:
        ConfigError: An endpoint cannot be read.
        ProtocolError: An answer cannot be read.
    """
    endpoints = dict.fromkeys(to_reach(place) for entry in shards for place in entry.endpoints)
    listening = [endpoint for endpoint in endpoints if somebody_listens(endpoint)]
    asked = [FoundShard(cell, entry.name) for entry in shards]
    if not listening:
        return []
    answers = ask_shards(listening, asked, ListPlaces(), timeout_s=timeout_s, keys=keys)
    return [one.shards for one in answers.values() if isinstance(one, Places)]


def moved_places(
    known: Mapping[str, Iterable[str]], reported: Iterable[ShardEntry]
) -> dict[str, list[str]]:
    """Return the shards with an unknown endpoint in some answer, with all their endpoints.

    Two answers that share an endpoint mean the same shard with an additional address.
    """
    moved: dict[str, dict[str, None]] = {}
    for shard, places in reported:
        if known.get(shard) and places and not set(known[shard]) & set(places):
            those = moved.setdefault(shard, dict.fromkeys(known[shard]))
            those.update(dict.fromkeys(places))
    return {shard: list(places) for shard, places in moved.items()}


def two_daemons(cell: str, shard: str, found: Sequence[Serving]) -> str:
    """Return the message about a shard that several daemons serve."""
    return (
        f"{len(found)} daemons serve shard {shard} of cell {cell}, each with its own data:"
        f" {' and '.join(map(str, found))}; stop all but the one whose data you want to keep, and"
        " name its endpoint in every cell.toml; a shard of another cell needs another cell name"
    )


class Comparing:
    """Finds out which daemons serve a shard, for a running shard: in a thread, one by one.

    A shard with several daemons is checked again until only one answers, and occasionally after
    that: a stopped, slow or disconnected daemon may come back.

    Args:
        cell: Name of the cell.
        report: Receives the result.
        keys: The files by which this process proves its name, in a cell with keys.
    """

    ASK_S: Final = 0.5
    """How long each endpoint may take to answer."""
    AGAIN_S: Final = 5.0
    """Pause before a shard with several daemons is checked again."""
    LATER_S: Final = 30.0
    """Pause before the next check, once only one of them answers."""

    def __init__(
        self, cell: str, report: Callable[[Served], None], keys: KeyFiles | None = None
    ) -> None:
        self._cell, self._report, self._keys = cell, report, keys
        self._asked: dict[str, Compare] = {}
        self._doubled: set[str] = set()
        self._were_doubled: dict[str, Compare] = {}
        self._wake = threading.Condition(threading.Lock())
        self._thread: threading.Thread | None = None
        self._closed = False

    def submit(self, compare: Compare) -> None:
        """Check soon; a newer question about a shard replaces a waiting one."""
        with self._wake:
            if self._closed:
                return
            self._asked[compare.shard] = compare
            if self._thread is None:
                thread = threading.Thread(target=self._run, name="enact-compare", daemon=True)
                try:
                    thread.start()
                except RuntimeError as error:  # no thread available: the next question tries again
                    _log.warning(
                        "cannot compare the endpoints of shard %s: %s", compare.shard, error
                    )
                    return
                self._thread = thread
            self._wake.notify()

    def _run(self) -> None:
        while (compare := self._next()) is not None:
            try:
                found = serving(
                    self._cell,
                    compare.shard,
                    compare.places,
                    timeout_s=self.ASK_S,
                    keys=self._keys,
                )
            except Exception as error:  # noqa: BLE001 - a place from a configuration may be anything
                if not self._closed:
                    _log.warning(
                        "cannot compare the endpoints of shard %s: %s", compare.shard, error
                    )
                continue
            doubled = len(found) > 1
            with self._wake:
                (self._doubled.add if doubled else self._doubled.discard)(compare.shard)
                if doubled or compare.shard in self._were_doubled:
                    self._were_doubled[compare.shard] = compare
                if self._closed:
                    return
            starts = tuple(sorted(one.start for one in found))
            text = two_daemons(self._cell, compare.shard, found) if doubled else ""
            self._report(Served(compare.shard, starts, text))

    def _next(self) -> Compare | None:
        """Wait for a question; return None at the end."""
        with self._wake:
            while not self._asked and not self._closed:
                again_s = self.AGAIN_S if self._doubled else self.LATER_S
                if not self._wake.wait(again_s if self._were_doubled else None):
                    self._asked = self._were_doubled | self._asked
            return None if self._closed else self._asked.pop(next(iter(self._asked)))

    def close(self, join_s: float = 0.5) -> None:
        """Ask no more; wait up to `join_s` for a check in progress.  Idempotent."""
        with self._wake:
            self._closed = True
            thread = self._thread
            self._wake.notify()
        if thread is not None:
            thread.join(join_s)


class Doubts:
    """The shards of one session that several daemons serve; none of these is trusted.

    Args:
        cell: Name of the cell.
        expected: The shards and endpoints that the session's user configured.
        keys: The files by which this process proves its name, in a cell with keys.
    """

    ASK_S: Final = 0.5
    """How long each endpoint may take to answer."""
    AGAIN_S: Final = 2.0
    """Pause before checking whether the doubt is over."""

    def __init__(
        self, cell: str, expected: Iterable[ShardEntry] = (), keys: KeyFiles | None = None
    ) -> None:
        self._cell, self._keys = cell, keys
        self._known = {entry.name: list(entry.endpoints) for entry in expected}
        self.doubted: dict[str, tuple[list[str], str, float]] = {}

    def hear(self, shards: Iterable[ShardEntry]) -> list[str]:
        """Take a shard's list of all endpoints; return messages about shards found twice.

        Raises:
            EnactError: An endpoint cannot be asked.
        """
        shards = tuple(shards)
        moved = moved_places(self._known, shards)
        wrong = [text for shard, places in moved.items() if (text := self._ask(shard, places))]
        for shard, places in shards:
            known = self._known.setdefault(shard, [])
            known += [place for place in places if place not in known]
        return wrong

    def _ask(self, shard: str, places: list[str]) -> str:
        found = serving(self._cell, shard, places, timeout_s=self.ASK_S, keys=self._keys)
        if len(found) < 2:
            self.doubted.pop(shard, None)
            return ""
        text = two_daemons(self._cell, shard, found)
        self.doubted[shard] = places, text, time.monotonic() + self.AGAIN_S
        return text

    def about(self, shard: str) -> str:
        """Return why a shard cannot be trusted now; empty if it can."""
        doubt = self.doubted.get(shard)
        if doubt is None:
            return ""
        places, text, until_s = doubt
        return text if time.monotonic() < until_s else self._ask(shard, places)
