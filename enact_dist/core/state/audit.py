"""What operators have done at one shard by hand, and the alarms that await them."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import AuditEntry

if TYPE_CHECKING:
    from collections.abc import Iterable

    from enact_dist.core.protocol.records import AuditRecord

ENTRIES_MAX: Final = 1_000
"""Operators' acts that a shard remembers and lists, the newest ones; the store keeps all."""

BROKEN, FORCED, CONFIRMED, ALARM, SETTLED = "broken", "forced", "confirmed", "alarm", "settled"


class Audit:
    """The acts of operators here, newest last, and the number of unacknowledged alarms.

    Attributes:
        alarms: Number of alarms since an operator last settled them.
    """

    def __init__(self, recovered: Iterable[AuditRecord]) -> None:
        self._records: deque[AuditRecord] = deque(maxlen=ENTRIES_MAX)
        self._count = 0
        self._newest_alarm_ns = 0
        self.alarms = 0
        for record in sorted(recovered, key=lambda record: record.wall_ns):
            self.keep(record)

    def keep(self, record: AuditRecord) -> AuditRecord:
        """Remember a record and return it, for the store."""
        self._records.append(record)
        self._count += 1
        if record.kind == ALARM:
            self.alarms += 1
            self._newest_alarm_ns = max(self._newest_alarm_ns, record.wall_ns)
        elif record.kind == SETTLED:
            self.alarms = 0
        return record

    def may_settle(self, seen_ns: int) -> bool:
        """Whether there are alarms, none of them later than `seen_ns` (0: any time)."""
        return self.alarms > 0 and (not seen_ns or self._newest_alarm_ns <= seen_ns)

    def __len__(self) -> int:
        return self._count

    @property
    def left_out(self) -> int:
        """How many acts are too old to be listed."""
        return self._count - len(self._records)

    def entries(self) -> tuple[AuditEntry, ...]:
        """Return the newest records, for people."""
        return tuple(
            AuditEntry(record.wall_ns, record.kind, record.text, record.identity)
            for record in self._records
        )
