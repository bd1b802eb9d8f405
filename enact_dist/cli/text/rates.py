"""How often data change, by how much: rates, periods, delays and bandwidths of slots.

Rates and periods are those of the commits' stamps, so a watch that a busy machine keeps waiting
shows the rate of the commits, not the rate at which it received them.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from enact_dist.core.protocol.datum import Slot

WINDOW_S: Final = 10.0
"""The span of time whose changes make the present figures."""


class Sample(NamedTuple):
    """One change of a slot.

    Attributes:
        missed: Versions before it that the watch did not see.
        captured_ns: When the datum was captured, 0 where its writer did not say.
    """

    stamp_ns: int
    missed: int
    size_bytes: int
    captured_ns: int = 0


@dataclass(slots=True)
class Tally:
    """The changes of one slot over a span of time, added up.

    Attributes:
        changes: How many were seen.
        missed: Versions that were not seen.
        period_min_s: The shortest time between two commits that follow one another.
        period_max_s: The longest one.
    """

    changes: int = 0
    missed: int = 0
    period_min_s: float = math.inf
    period_max_s: float = 0.0
    _first: Sample | None = None
    _last_ns: int = 0
    _followed: int = 0
    _sizes: int = 0
    _periods: int = 0
    _period_sum_s: float = 0.0
    _period_square_sum: float = 0.0
    _delays: int = 0
    _delay_sum_s: float = 0.0

    def add(self, sample: Sample) -> None:
        """Count one change more."""
        self.changes += 1
        self.missed += sample.missed
        self._sizes += sample.size_bytes
        if sample.captured_ns:
            self._delays += 1
            self._delay_sum_s += (sample.stamp_ns - sample.captured_ns) / 1e9
        if self._first is None:
            self._first = sample
        else:
            self._followed += 1 + sample.missed
            if not sample.missed:
                self._add_period((sample.stamp_ns - self._last_ns) / 1e9)
        self._last_ns = sample.stamp_ns

    def _add_period(self, period_s: float) -> None:
        self._periods += 1
        self._period_sum_s += period_s
        self._period_square_sum += period_s * period_s
        self.period_min_s = min(self.period_min_s, period_s)
        self.period_max_s = max(self.period_max_s, period_s)

    @property
    def rate_hz(self) -> float | None:
        """Versions per second, unseen ones too; None before there are two."""
        spanned_s = (self._last_ns - self._first.stamp_ns) / 1e9 if self._first else 0.0
        return self._followed / spanned_s if spanned_s > 0.0 else None

    @property
    def period_std_s(self) -> float | None:
        """Standard deviation of the time between two commits; None before there are two of it."""
        if self._periods < 2:
            return None
        mean_s = self._period_sum_s / self._periods
        return math.sqrt(max(0.0, self._period_square_sum / self._periods - mean_s * mean_s))

    @property
    def delay_s(self) -> float | None:
        """Mean time from capture to commit; None where no writer gave a capture stamp."""
        return self._delay_sum_s / self._delays if self._delays else None

    @property
    def size_bytes(self) -> float:
        """Mean size of the data."""
        return self._sizes / self.changes if self.changes else 0.0

    @property
    def bandwidth_bytes_s(self) -> float | None:
        """Bytes per second; None before there is a rate."""
        rate_hz = self.rate_hz
        return rate_hz * self.size_bytes if rate_hz is not None else None

    @property
    def last_ns(self) -> int:
        """Stamp of the last commit; 0 before the first."""
        return self._last_ns


@dataclass(slots=True)
class SlotRates:
    """The changes of one slot: all of them, and those of the last `WINDOW_S`."""

    whole: Tally = field(default_factory=Tally)
    _recent: deque[tuple[float, Sample]] = field(default_factory=deque)

    def add(self, sample: Sample, now_s: float) -> None:
        """Count one more change, received at `now_s`."""
        self.whole.add(sample)
        self._recent.append((now_s, sample))
        self._forget(now_s)

    def _forget(self, now_s: float) -> None:
        while self._recent and self._recent[0][0] < now_s - WINDOW_S:
            self._recent.popleft()

    def recent(self, now_s: float) -> Tally:
        """Return the tally of the changes received within the last `WINDOW_S`."""
        self._forget(now_s)
        tally = Tally()
        for _, sample in self._recent:
            tally.add(sample)
        return tally


class Rates:
    """The rates of all slots that a watch shows; times in seconds of any clock that only rises."""

    def __init__(self) -> None:
        self._slots: dict[Slot, SlotRates] = {}

    def there(self, slots: Iterable[Slot]) -> None:
        """Note slots whose data were there at the begin; that is no change of them."""
        for slot in slots:
            self._slots.setdefault(slot, SlotRates())

    def add(self, slot: Slot, sample: Sample, now_s: float) -> None:
        """Count one change more."""
        self._slots.setdefault(slot, SlotRates()).add(sample, now_s)

    def of(self, slot: Slot, now_s: float) -> Tally:
        """Return the figures of the last `WINDOW_S` of one slot."""
        rates = self._slots.get(slot)
        return rates.recent(now_s) if rates is not None else Tally()

    def recent(self, now_s: float) -> dict[Slot, Tally]:
        """Return the figures of the last `WINDOW_S`, by slot."""
        return {slot: self._slots[slot].recent(now_s) for slot in sorted(self._slots)}

    def whole(self) -> dict[Slot, Tally]:
        """Return the figures of the whole run, by slot."""
        return {slot: self._slots[slot].whole for slot in sorted(self._slots)}
