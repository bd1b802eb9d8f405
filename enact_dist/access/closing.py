"""What is closed by its end: as a context manager, and as an iterator of what comes until then."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Generic, Self, TypeVar

if TYPE_CHECKING:
    from types import TracebackType

T = TypeVar("T")


class Closing(ABC):
    """A context manager that is closed at the end of its block."""

    @abstractmethod
    def close(self) -> None:
        """End it; twice is harmless."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


class Following(Closing, Generic[T]):
    """Also an iterator, of what `next` returns until it is closed."""

    @abstractmethod
    def next(self, timeout_s: float | None = None) -> T | None:
        """Return what comes next, or None when nothing does in time or it is closed."""

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> T:
        found = self.next()
        if found is None:
            raise StopIteration
        return found
