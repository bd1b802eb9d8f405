"""When announced commits may be recorded: once shards show all of them, and all were announced.

A commit over shards stands when one of them has decided; each other one shows its part when its
own disk has kept that, and announces it then.  So the recorder asks the shards whether they show
everything up to the newest announced stamp, and records what is announced until a rest after that.
While a recording goes on it does not wait for a shard that does not answer, or that is slower than
`SHOWN_S`: what has to be fetched is remembered for 2 s only.  At its begin and end it asks such a
shard again until the time is over, since a busy host may delay one answer.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from typing import TYPE_CHECKING, Final

from enact_dist.access.asking import present_ns
from enact_dist.core.protocol.messages import AwaitStamp, Reached
from enact_dist.errors import LinkError

if TYPE_CHECKING:
    from enact_dist.link.client.locks import CellClient

SHOWN_S: Final = 1.0
"""How long a commit waits for shards that do not show it yet."""
END_S: Final = 5.0
"""The same at the end of a recording, after which nothing records the rest of it."""
ASK_S: Final = 0.05
"""The pause between two questions, and how long a shard may take its time with the answer."""
ANSWER_S: Final = 0.25
"""How long a shard may leave a question unanswered."""


class Settling:
    """The announced commits that are settling.  Used by one thread."""

    def __init__(self, client: CellClient) -> None:
        self._client = client
        self._told: deque[tuple[float, int]] = deque()
        self._shown: deque[tuple[float, int]] = deque()
        self._asked_s = 0.0
        self._settled_ns = 0

    def told(self, stamp_ns: int) -> None:
        """Record that a shard has announced a commit."""
        self._told.append((time.monotonic(), stamp_ns))

    def settled_ns(self, rest_s: float) -> int:
        """Return up to which stamp commits have rested so long since all shards show them."""
        if self._told and time.monotonic() >= self._asked_s + ASK_S:
            self._look()
        rested_s = time.monotonic() - rest_s
        while self._shown and self._shown[0][0] <= rested_s:
            self._settled_ns = max(self._settled_ns, self._shown.popleft()[1])
        return self._settled_ns

    def _look(self) -> None:
        alone = len(self._client.shards()) == 1  # its notices come in the order of their stamps
        shown = alone or self._all_show(max(stamp_ns for _, stamp_ns in self._told))
        self._asked_s = now_s = time.monotonic()
        while self._told and (shown or self._told[0][0] <= now_s - SHOWN_S):
            told_s, stamp_ns = self._told.popleft()
            self._shown.append((now_s if shown and not alone else told_s, stamp_ns))

    def wait_shown(self, stamp_ns: int = 0, *, wait_s: float = SHOWN_S) -> None:
        """Wait until all that is committed up to a stamp (0: up to now) is shown."""
        if len(self._client.shards()) == 1:
            return
        gives_up_s = time.monotonic() + wait_s
        with contextlib.suppress(LinkError):  # a shard is away
            stamp_ns = stamp_ns or present_ns(self._client)
            while not self._all_show(stamp_ns, absent=False) and time.monotonic() < gives_up_s:
                time.sleep(ASK_S)  # the address of a shard that is away refuses at once

    def _all_show(self, stamp_ns: int, *, absent: bool = True) -> bool:
        """Whether every shard shows all up to a stamp; one that does not answer: `absent`."""
        session, wait_ns = self._client.core.session, int(ASK_S * 1e9)
        try:
            answers = self._client.ask_each(
                self._client.shards(),
                lambda _, epoch, __: AwaitStamp(stamp_ns, wait_ns, session, epoch),
                timeout_s=ANSWER_S,
            )
        except LinkError:
            return True
        return all(
            answer.reached if isinstance(answer, Reached) else absent for answer in answers.values()
        )
