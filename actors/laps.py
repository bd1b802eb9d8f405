"""How long the steps of a run took."""

from __future__ import annotations

import time


class Laps:
    """A clock of laps.

    Attributes:
        seconds: How long each lap took, by its name.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._since_s = time.monotonic()

    def lap(self, name: str) -> None:
        """End a lap under this name."""
        now_s = time.monotonic()
        self.seconds[name] = round(now_s - self._since_s, 2)
        self._since_s = now_s

    def __str__(self) -> str:
        return ", ".join(f"{name} {seconds:.1f} s" for name, seconds in self.seconds.items())
