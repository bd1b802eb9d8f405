"""The fingerprint of a datum type: equal in two processes exactly if they mean the same data.

Structural: names of dataclasses and fields and the shapes below them, as text, so that an error
can show both sides.  Modules do not count: a dataclass may move.
Rule to keep: catalogues store fingerprints, so one never changes while its type does not.
"""

from __future__ import annotations

import hashlib
from typing import Any, Final

from enact_dist.wire.shapes import shape_of, text_of

FINGERPRINT_CHARACTERS_MAX: Final = 2000
"""Longer ones are cut and end in a digest of the whole."""


def fingerprint(datum_type: Any) -> str:
    """Return the structure of a datum type as text, for example ``Surface{vertices_m:ndarray}``.

    Raises:
        DatumTypeError: The type cannot be a datum.
    """
    text = text_of(shape_of(datum_type))
    if len(text) <= FINGERPRINT_CHARACTERS_MAX:
        return text
    digest = hashlib.sha256(text.encode()).hexdigest()
    return f"{text[:FINGERPRINT_CHARACTERS_MAX]}…sha256:{digest}"
