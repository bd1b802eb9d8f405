"""The packages that recordings need beside those of the product, or an error that names them."""

from __future__ import annotations

from importlib.util import find_spec

from enact_dist.errors import ConfigError


def require_libraries() -> None:
    """Make sure that recordings can be written and read.

    Raises:
        ConfigError: A package is not installed; the message names the extra that brings it.
    """
    missing = [name for name in ("mcap", "foxglove_schemas_protobuf") if find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"recordings need {' and '.join(missing)}, which this Python does not have: install"
            " the extra 'record' (pip install -e '.[record]' in the clone of enact-dist)"
        )
