"""The fingerprint of a datum type: equal in two processes exactly if they mean the same data.

Structural: names of dataclasses and fields and the shapes below them, as text, so that an error
can show both sides.  Modules do not count: a dataclass may move.
A field that has a default is marked with ``=``: such a field may be added to a type that is in
use (`core.protocol.datum_types`).
Rule to keep: catalogues store fingerprints, so one never changes, but for its marks, while its type
does not.
"""

from __future__ import annotations

import hashlib
from typing import Any, Final

from enact_dist.core.protocol.datum_types import DEFAULT_MARK
from enact_dist.wire.shapes import shape_of, text_of

UNCUT_CHARACTERS_MAX: Final = 2000
"""A longer fingerprint has no marks; if it is still longer, it is cut and ends in a digest of the
whole.  Fields cannot be added to such a type."""


def fingerprint(datum_type: Any) -> str:
    """Return the structure of a datum type as text, for example ``Surface{name:str=,at_m:list}``.

    Raises:
        DatumTypeError: The type cannot be a datum.
    """
    shape = shape_of(datum_type)
    text = text_of(shape, mark=DEFAULT_MARK)
    if len(text) <= UNCUT_CHARACTERS_MAX:
        return text
    text = text_of(shape)
    if len(text) <= UNCUT_CHARACTERS_MAX:
        return text
    digest = hashlib.sha256(text.encode()).hexdigest()
    return f"{text[:UNCUT_CHARACTERS_MAX]}…sha256:{digest}"
