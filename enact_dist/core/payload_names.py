"""Which payloads the states of a shard name, and how many bytes would be free without history."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from enact_dist.core.datum import Datum


class PayloadNames:
    """How often each payload is named, by what stays and by what may go.

    Several states may name one payload: a fork shares the data of its source.

    Attributes:
        spare: Bytes of the payloads that only history names.
    """

    __slots__ = ("_named", "spare")

    def __init__(self) -> None:
        self._named: dict[str, tuple[int, int]] = {}
        self.spare = 0

    def count(self, datum: Datum | None, *, stays: int = 0, may_go: int = 0) -> None:
        """Count that more (or fewer) states name a datum's payload.

        Args:
            datum: The datum; nothing to be done where it is no payload.
            stays: So many more are newest states or kept ones.
            may_go: So many more are replaced states.
        """
        if datum is None or not datum.file:
            return
        before, going = self._named.get(datum.file, (0, 0))
        if going and not before:
            self.spare -= datum.size
        before, going = before + stays, going + may_go
        if going and not before:
            self.spare += datum.size
        if before or going:
            self._named[datum.file] = before, going
        else:
            del self._named[datum.file]

    def assert_counts(self, stay: Iterable[Datum | None], may_go: Iterable[Datum | None]) -> None:
        """Assert that exactly the data of these states are counted.  For tests and simulation."""
        right = PayloadNames()
        for datum in stay:
            right.count(datum, stays=1)
        for datum in may_go:
            right.count(datum, may_go=1)
        assert (right._named, right.spare) == (self._named, self.spare)
