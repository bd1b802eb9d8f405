"""How much of each datum's history stays: `Retention`, as set by an aspect or a `cell.toml`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

VERSIONS_MAX: Final = 100_000
"""Most versions of one slot that a retention may ask for; a shard keeps no more of all slots."""
AGE_S_MAX: Final = 1e9
"""Longest age that a retention may ask for: some thirty years."""
SIZE_BYTES_MAX: Final = 1 << 50
"""Most bytes that a retention may ask for: 1 PiB, more than the disk of a shard has."""


@dataclass(frozen=True, slots=True)
class Retention:
    """How much of each datum's history stays; a limit of None does not apply.

    A replaced version stays as long as all three limits allow, and as its shard has room (256 MiB
    beside the payloads and 100,000 versions for all slots).  The newest version always stays.

    Args:
        versions: How many versions stay, the newest included; 1 keeps no history.
        age_s: How long a version stays after it was replaced, in seconds.
        size_bytes: How many bytes of replaced data stay, per datum.

    Raises:
        ValueError: A limit is out of range, or all three are missing.
    """

    versions: int | None = None
    age_s: float | None = None
    size_bytes: int | None = None

    def __post_init__(self) -> None:
        if self.versions is None and self.age_s is None and self.size_bytes is None:
            raise ValueError(
                "Retention() has no limit; give versions, age_s or size_bytes, or leave the"
                " retention out"
            )
        _check_count("versions", self.versions, VERSIONS_MAX)
        _check_count("size_bytes", self.size_bytes, SIZE_BYTES_MAX)
        age_s = self.age_s
        if age_s is None:
            return
        if isinstance(age_s, bool) or not isinstance(age_s, int | float) or math.isnan(age_s):
            raise ValueError(f"age_s of a retention is a number of seconds, not {age_s!r}")
        if not 0.001 <= age_s <= AGE_S_MAX:
            raise ValueError(
                f"age_s of a retention must lie between 0.001 and {AGE_S_MAX:g} s, not {age_s!r}"
            )


def _check_count(name: str, found: object, highest: int) -> None:
    if found is not None and (type(found) is not int or not 1 <= found <= highest):
        raise ValueError(f"{name} of a retention is a number from 1 to {highest}, not {found!r}")


DEFAULT_RETENTION: Final = Retention(versions=16, age_s=600.0, size_bytes=16 << 20)
"""Applies if neither the aspect nor `cell.toml` sets a retention."""


def checked_retention(retention: object) -> Retention | None:
    """Return a retention; a bare number is a number of versions.

    Raises:
        ValueError: It is neither a number of versions, nor a `Retention`, nor None.
    """
    if retention is None or isinstance(retention, Retention):
        return retention
    if type(retention) is not int:
        raise ValueError(
            f"a retention is a number of versions or Retention(versions, age_s, size_bytes),"
            f" not {retention!r}"
        )
    return Retention(versions=retention)
