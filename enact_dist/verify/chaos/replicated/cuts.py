"""Cuts between hosts that several faults may make at once."""

from __future__ import annotations

import threading
from collections import Counter
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from enact_dist.verify.chaos.network.hosts import Hosts


class SharedCuts:
    """Cuts that several faults may make at once: each way opens again after the last of them.

    Thread-safe.
    """

    def __init__(self, hosts: Hosts) -> None:
        self._hosts = hosts
        self._counts: Counter[tuple[str, str]] = Counter()
        self._lock = threading.Lock()

    def cut(self, ways: Iterable[tuple[str, str]]) -> None:
        """Close these ways."""
        with self._lock:
            for way in ways:
                if not self._counts[way]:
                    self._hosts.cut(*way)
                self._counts[way] += 1

    def heal(self, ways: Iterable[tuple[str, str]]) -> None:
        """End one cut of each of these ways."""
        with self._lock:
            for way in ways:
                self._counts[way] -= 1
                if not self._counts[way]:
                    self._hosts.heal(*way)


def ways_between(
    one: str, others: Iterable[str], *, sends: bool = True, hears: bool = True
) -> list[tuple[str, str]]:
    """Return the ways between a host and others: those by which it sends, by which it hears."""
    others = tuple(others)
    return [
        *((one, other) for other in others if sends),
        *((other, one) for other in others if hears),
    ]
