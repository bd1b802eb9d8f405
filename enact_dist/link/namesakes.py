"""Two daemons under one name: who serves a shard at each of the places where it is said to be.

A shard that runs twice, from two folders at two places, is two shards: what one client reads
another never wrote.  Nobody sees that from one place alone, so whoever hears of a second place
asks at both.  A daemon is told from another by the random number of its start, not by its epoch:
two folders may be in the same one, and a restart at the same place is one daemon after another.
"""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from enact_dist.core.messages import ListPlaces, Ping, Places, Pong
from enact_dist.core.records import Served
from enact_dist.errors import ConfigError
from enact_dist.link.endpoints import PROTOCOLS, somebody_listens, split_endpoint
from enact_dist.link.zenoh_config import to_reach
from enact_dist.link.zenoh_discovery import FoundShard, ask_shards

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from enact_dist.core.messages import ShardEntry
    from enact_dist.core.records import Compare

_log = logging.getLogger("enact.link")


@dataclass(frozen=True, slots=True)
class Serving:
    """A daemon that serves a shard.

    Attributes:
        endpoint: Where it answers.
        start: The random number of its start.
        epoch: The epoch that it is in.
        uptime_s: For how long it has run.
    """

    endpoint: str
    start: int
    epoch: int
    uptime_s: float

    def __str__(self) -> str:
        return f"{self.endpoint} (epoch {self.epoch}, up {self.uptime_s:.0f} s)"


def serving(
    cell: str, shard: str, endpoints: Iterable[str], *, timeout_s: float
) -> tuple[Serving, ...]:
    """Ask place by place who serves a shard there; return each daemon once.

    A place that cannot be one, whoever has named it, is passed over: the others are asked.

    Args:
        cell: Name of the cell.
        shard: Name of the shard.
        endpoints: The places.
        timeout_s: How long each may take to answer.

    Raises:
        ProtocolError: An answer cannot be read.
    """
    found: dict[int, Serving] = {}
    wanted = FoundShard(cell, shard)
    for endpoint in dict.fromkeys(map(to_reach, endpoints)):
        if split_endpoint(endpoint)[0] not in PROTOCOLS or not somebody_listens(endpoint):
            continue
        try:
            answer = ask_shards([endpoint], [wanted], Ping(), timeout_s=timeout_s).get(wanted)
        except ConfigError as error:
            _log.warning("shard %s is said to be where nobody can be: %s", shard, error)
            continue
        if isinstance(answer, Pong):
            one = Serving(endpoint, answer.start, answer.epoch, answer.uptime_ns / 1e9)
            found.setdefault(answer.start, one)
    return tuple(found.values())


def told_places(
    cell: str, shards: Sequence[ShardEntry], *, timeout_s: float
) -> list[tuple[ShardEntry, ...]]:
    """Ask shards of a cell where they expect each shard; return what each of them says.

    Args:
        cell: Name of the cell.
        shards: Whom to ask, and where.
        timeout_s: How long they may take together; those that take longer are left out.

    Raises:
        ConfigError: An endpoint cannot be read.
        ProtocolError: An answer cannot be read.
    """
    endpoints = dict.fromkeys(to_reach(place) for entry in shards for place in entry.endpoints)
    listening = [endpoint for endpoint in endpoints if somebody_listens(endpoint)]
    asked = [FoundShard(cell, entry.name) for entry in shards]
    answers = ask_shards(listening, asked, ListPlaces(), timeout_s=timeout_s) if listening else {}
    return [one.shards for one in answers.values() if isinstance(one, Places)]


def moved_places(
    known: Mapping[str, Iterable[str]], told: Iterable[ShardEntry]
) -> dict[str, list[str]]:
    """Return the shards that somebody expects elsewhere than is known, with all their places.

    One that has a place in common is the same shard with another address beside.
    """
    moved: dict[str, dict[str, None]] = {}
    for shard, places in told:
        if known.get(shard) and places and not set(known[shard]) & set(places):
            those = moved.setdefault(shard, dict.fromkeys(known[shard]))
            those.update(dict.fromkeys(places))
    return {shard: list(places) for shard, places in moved.items()}


def two_daemons(cell: str, shard: str, found: Sequence[Serving]) -> str:
    """Return what is said of a shard that several daemons serve."""
    return (
        f"{len(found)} daemons serve shard {shard} of cell {cell}, each with its own data:"
        f" {' and '.join(map(str, found))}; stop all but the one whose data you want to keep, and"
        " name its endpoint in every cell.toml; a shard of another cell needs another cell name"
    )


class Comparing:
    """Asks which daemons serve a shard, for a shard that runs: on a thread of its own, in turn.

    A shard that several daemons serve is asked about again until one of them is gone, and from time
    to time after that: one that was stopped, slow or cut off comes back without a word.

    Args:
        cell: Name of the cell.
        tell: Takes what was found.
    """

    ASK_S: Final = 0.5
    """How long each place may take to answer."""
    AGAIN_S: Final = 5.0
    """After so long a shard that several daemons serve is asked about again."""
    LATER_S: Final = 30.0
    """And so long after that, once only one of them answers."""

    def __init__(self, cell: str, tell: Callable[[Served], None]) -> None:
        self._cell, self._tell = cell, tell
        self._asked: dict[str, Compare] = {}
        self._doubled: dict[str, Compare] = {}
        self._were_doubled: dict[str, Compare] = {}
        self._wake = threading.Condition(threading.Lock())
        self._thread: threading.Thread | None = None
        self._closed = False

    def submit(self, compare: Compare) -> None:
        """Ask soon; the newest question about a shard replaces one that waits."""
        with self._wake:
            if self._closed:
                return
            self._asked[compare.shard] = compare
            if self._thread is None:
                thread = threading.Thread(target=self._run, name="enact-compare", daemon=True)
                try:
                    thread.start()
                except RuntimeError as error:  # no thread is left: the next question tries again
                    _log.warning("the places of shard %s not compared: %s", compare.shard, error)
                    return
                self._thread = thread
            self._wake.notify()

    def _run(self) -> None:
        while (compare := self._next()) is not None:
            try:
                found = serving(self._cell, compare.shard, compare.places, timeout_s=self.ASK_S)
            except Exception as error:  # noqa: BLE001 - a place that somebody named may be anything
                if not self._closed:
                    _log.warning("the places of shard %s not compared: %s", compare.shard, error)
                continue
            with self._wake:
                self._doubled.pop(compare.shard, None)
                if len(found) > 1:
                    self._doubled[compare.shard] = compare
                if compare.shard in self._were_doubled or len(found) > 1:
                    self._were_doubled[compare.shard] = compare
                if self._closed:
                    return
            starts = tuple(sorted(one.start for one in found))
            text = two_daemons(self._cell, compare.shard, found) if len(found) > 1 else ""
            self._tell(Served(compare.shard, starts, text))

    def _next(self) -> Compare | None:
        """Wait for a question; return None at the end."""
        with self._wake:
            while not self._asked and not self._closed:
                again_s = self.AGAIN_S if self._doubled else self.LATER_S
                if not self._wake.wait(again_s if self._were_doubled else None):
                    self._asked = self._were_doubled | self._asked
            return None if self._closed else self._asked.pop(next(iter(self._asked)))

    def close(self, join_s: float = 0.5) -> None:
        """Ask no more; wait so long for a question under way.  Twice is harmless."""
        with self._wake:
            self._closed = True
            thread = self._thread
            self._wake.notify()
        if thread is not None:
            thread.join(join_s)


class Doubts:
    """The shards of one session that more than one daemon serves; neither is trusted.

    Args:
        cell: Name of the cell.
        expected: The shards as the session's user knows them, with their places.
    """

    ASK_S: Final = 0.5
    """How long each place may take to answer."""
    AGAIN_S: Final = 2.0
    """After so long it is asked again whether the doubt is over."""

    def __init__(self, cell: str, expected: Iterable[ShardEntry] = ()) -> None:
        self._cell = cell
        self._known = {entry.name: list(entry.endpoints) for entry in expected}
        self._doubted: dict[str, tuple[list[str], str, float]] = {}

    def hear(self, shards: Iterable[ShardEntry]) -> list[str]:
        """Take where a shard says that all are; return what is wrong with those found twice.

        Raises:
            EnactError: A place cannot be asked.
        """
        shards = tuple(shards)
        moved = moved_places(self._known, shards)
        wrong = [text for shard, places in moved.items() if (text := self._ask(shard, places))]
        for shard, told in shards:
            known = self._known.setdefault(shard, [])
            known += [place for place in told if place not in known]
        return wrong

    def _ask(self, shard: str, places: list[str]) -> str:
        found = serving(self._cell, shard, places, timeout_s=self.ASK_S)
        if len(found) < 2:
            self._doubted.pop(shard, None)
            return ""
        text = two_daemons(self._cell, shard, found)
        self._doubted[shard] = places, text, time.monotonic() + self.AGAIN_S
        return text

    def about(self, shard: str) -> str:
        """Return why a shard is not to be trusted now; empty where it is."""
        doubt = self._doubted.get(shard)
        if doubt is None:
            return ""
        places, text, until_s = doubt
        return text if time.monotonic() < until_s else self._ask(shard, places)
