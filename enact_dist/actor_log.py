"""Repeated events in an actor's log: the first is logged at once, the others as a count.

PURE, as `actor_triggers`: time arrives as an argument.  A dead camera leaves every set incomplete,
and a broken update fails at each trigger; logged one by one, such events hide everything else.  No
event is lost: the logger writes the counts of `left` when it ends.
"""

from __future__ import annotations

import re
import traceback
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Hashable

PAUSE_NS_MIN: Final = 5_000_000_000
PAUSE_NS_MAX: Final = 300_000_000_000
"""Between two lines of one kind; doubles while there is something to count."""
KINDS_MAX: Final = 64
"""Kinds that are counted separately at one time."""

_DIGITS: Final = re.compile(r"[0-9]+")


@dataclass(slots=True)
class _Kind:
    due_ns: int
    pause_ns: int = PAUSE_NS_MIN
    untold: int = 0
    newest: str = ""


class Repeated:
    """Decides when to log repeated events, kind by kind.  One thread at a time."""

    __slots__ = ("_kinds",)

    def __init__(self) -> None:
        self._kinds: dict[Hashable, _Kind] = {}

    def tell(self, kind: Hashable, text: str, now_ns: int) -> int | None:
        """Return the count to report: 0 for the first, None for not now.

        Args:
            kind: What is counted together; of very many kinds the later ones are.
            text: What happened, for `left`.
            now_ns: When.
        """
        known = self._kinds.get(kind)
        if known is None and len(self._kinds) >= KINDS_MAX:
            self._forget_quiet(now_ns)
            if len(self._kinds) >= KINDS_MAX:
                kind = None
                known = self._kinds.get(kind)
        if known is None:
            self._kinds[kind] = _Kind(now_ns + PAUSE_NS_MIN)
            return 0
        known.untold += 1
        known.newest = text
        if now_ns < known.due_ns:
            return None
        count, known.untold = known.untold, 0
        known.pause_ns = min(2 * known.pause_ns, PAUSE_NS_MAX) if count > 1 else PAUSE_NS_MIN
        known.due_ns = now_ns + known.pause_ns
        return count

    def left(self) -> list[tuple[int, str]]:
        """Return the unreported counts, each with the newest text of its kind; only once."""
        found = [(kind.untold, kind.newest) for kind in self._kinds.values() if kind.untold]
        for kind in self._kinds.values():
            kind.untold = 0
        return found

    def _forget_quiet(self, now_ns: int) -> None:
        for name, kind in list(self._kinds.items()):
            if not kind.untold and now_ns >= kind.due_ns + kind.pause_ns:
                del self._kinds[name]


def kind_of(error: BaseException) -> Hashable:
    """Return what errors that say the same have in common: class, text but for numbers, place."""
    places = [(frame.f_code, line) for frame, line in traceback.walk_tb(error.__traceback__)]
    return type(error), _DIGITS.sub("0", str(error)), tuple(places)
