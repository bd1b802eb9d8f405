"""Feedback: tells the user what was found."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from actors.palletizing.vocabulary import DEVIATIONS, NOTICES, SYSTEM, USER, Deviation, Notice
from enact_dist import Actor, View, World, Write

if TYPE_CHECKING:
    from enact_dist import Lock


class Feedback(Actor):
    """Notify the user of every judged place, deviating or not, once (ENACT 4.2)."""

    online = World("online")
    flags = View(online, SYSTEM, DEVIATIONS)
    notices = Write(online, USER, NOTICES)
    triggers = (flags,)

    def update(self, lock: Lock) -> None:
        """Notify the user of verdicts that have not been reported yet."""
        before: dict[str, Notice] = lock.get(self.notices, {})
        told = dict(before)
        for place, flag in lock[self.flags].items():
            if place not in told or flag.captured_ns != told[place].captured_ns:
                text = sentence(place, flag)
                print(text, flush=True)
                latency_ms = (time.time_ns() - flag.captured_ns) / 1e6
                told[place] = Notice(text, flag.captured_ns, latency_ms)
        lock[self.notices] = told


def sentence(place: str, flag: Deviation) -> str:
    """Return what a person should read about a place."""
    said = {
        "ok": f"{flag.product} stands as planned",
        "missing": f"{flag.product} did not arrive",
        "extra": f"something {flag.deviation_mm:.0f} mm high lies beside {flag.product}",
        "moved": f"{flag.product} stands {flag.deviation_mm:.0f} mm beside its place,"
        f" turned by {flag.turn_deg:.0f} degrees",
        "deformed": f"{flag.product} is deformed by {flag.deviation_mm:.1f} mm"
        f" over {flag.area_mm2 / 100.0:.0f} cm2",
    }
    return f"{place}: {said[flag.verdict]}"
