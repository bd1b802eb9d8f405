"""Packages that only an extra brings: their absence is an error that names the extra."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from enact_dist.errors import ConfigError


def needs(what: str, package: str, extra: str) -> str:
    """Return the text of the error that `what` lacks a package of an extra."""
    return (
        f"{what} needs {package}, which is not installed: install the extra {extra!r}"
        f" (pip install -e '.[{extra}]' in the clone of enact-dist)"
    )


def require(what: str, extra: str, *modules: str) -> None:
    """Refuse to begin what needs modules that are not installed; loads none of them.

    Raises:
        ConfigError: A module is not there; the message names the extra that brings it.
    """
    missing = [name for name in modules if find_spec(name) is None]
    if missing:
        raise ConfigError(needs(what, " and ".join(missing), extra))


@contextmanager
def needing(what: str, extra: str, *modules: str) -> Iterator[None]:
    """Run a block or function that imports these modules of an extra.

    Raises:
        ConfigError: One of them, or a library below it, cannot be loaded; the message names what
            brings it.
    """
    try:
        yield
    except ImportError as error:
        if ".so" in str(error):
            raise ConfigError(
                f"{what} cannot load a shared library ({error}); enact doctor names the package"
            ) from error
        if (error.name or "").partition(".")[0] in modules:
            raise ConfigError(needs(what, str(error.name), extra)) from error
        raise
