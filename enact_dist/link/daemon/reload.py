"""Lets a running shard take keys, names and rights anew: when asked, and near its key's end.

Zenoh reads the files and rules of a listener only when it opens.  So these are taken by closing and
opening the shard's Zenoh session, for which its clients wait 60 ms; sessions and locks stay.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable
from typing import Final

from enact_dist.errors import ConfigError, EnactError
from enact_dist.link.zenoh.tls import Certificate, KeyFiles, day_of, hosts_missing, own_certificate

LAST_PART: Final = 0.1
"""In the last tenth of its life a certificate is replaced as soon as there is a newer file."""
LOOKS: Final = 500
"""Looks for a newer file in the life of a certificate."""
LOOK_S_MIN, LOOK_S_MAX = 0.2, 60.0
JOIN_S: Final = 1.0

_log = logging.getLogger("enact.shard")


def checked_keys(keys: KeyFiles, hosts: Iterable[str]) -> Certificate:
    """Return the certificate of a shard if others will accept it now.

    Args:
        keys: Its files.
        hosts: Where it serves; one that the certificate does not name is only logged.

    Raises:
        ConfigError: They will not accept it; the message names the file.
    """
    certificate = own_certificate(keys)
    problem = certificate.problem(time.time())
    if problem:
        raise ConfigError(f"{keys.certificate} {problem}", path=str(keys.certificate))
    if missing := hosts_missing(certificate, hosts):
        _log.warning(
            "%s is not for %s: no client can connect to that endpoint of this shard; renew it:"
            " enact cell keys renew %s",
            keys.certificate,
            ", ".join(missing),
            keys.name,
            extra={"event": "shard.keys"},
        )
    return certificate


class Reload:
    """Takes the settings of a daemon anew: of a shard, or of a standby for one.  Thread-safe.

    What is asked between the two, during a takeover for example, is done by the next one.

    Args:
        keys: The shard's files, in a cell with keys.
    """

    def __init__(self, keys: KeyFiles | None) -> None:
        self._keys = keys
        self._take: Callable[[], Certificate | None] | None = None
        self._count: Callable[[str], None] = lambda _: None
        self._certificate: Certificate | None = None
        self._taken_ns = self._changed_ns()
        self._asked = False
        self._ended = threading.Event()
        self._mutex = threading.RLock()
        self._thread: threading.Thread | None = None
        if keys is not None:
            self._thread = threading.Thread(target=self._run, name="enact-keys", daemon=True)
            self._thread.start()

    def turn_to(
        self,
        take: Callable[[], Certificate | None],
        count: Callable[[str], None],
        certificate: Certificate | None,
    ) -> None:
        """Let something else take them from now on; at once if that was asked meanwhile.

        Args:
            take: Takes them and returns the certificate with which the daemon listens now, if it
                has one; raises `EnactError` and keeps the old ones if they cannot be used.
            count: Adds to a counter.
            certificate: The one with which the daemon listens now.
        """
        with self._mutex:
            self._take, self._count, self._certificate = take, count, certificate
            if self._asked:
                self()

    def pause(self) -> None:
        """Take nothing until the next `turn_to`; a reload that goes on is waited for."""
        with self._mutex:
            self._take = None

    def __call__(self) -> bool:
        """Take them as they are now; return whether that worked, and log it."""
        with self._mutex:
            self._asked = self._take is None
            if self._take is None:
                return False
            self._taken_ns = self._changed_ns()
            began_s = time.monotonic()
            try:
                self._certificate = self._take()
            except EnactError as error:
                self._count("reloads_refused")
                _log.error(
                    "not reloaded, so the old keys, names and rights stay: %s",
                    error,
                    extra={"event": "shard.reload_refused"},
                )
                return False
            until = self._certificate and day_of(self._certificate.ends_s)
            _log.info(
                "reloaded in %.0f ms%s",
                (time.monotonic() - began_s) * 1e3,
                f"; the certificate is valid until {until}" if until else "",
                extra={"event": "shard.reloaded"},
            )
            self._count("reloads")
            return True

    def _run(self) -> None:
        while not self._ended.wait(self._pause_s()):
            if self._is_due():
                self()

    def _pause_s(self) -> float:
        certificate = self._certificate
        life_s = certificate.ends_s - certificate.starts_s if certificate is not None else 0.0
        return min(LOOK_S_MAX, max(LOOK_S_MIN, life_s / LOOKS))

    def _is_due(self) -> bool:
        """Return whether the certificate ends soon and there is a file that was not tried."""
        now = self._certificate
        if now is None:
            return False
        left_s = now.ends_s - time.time()
        ends_soon = left_s < LAST_PART * (now.ends_s - now.starts_s)
        return ends_soon and self._changed_ns() > self._taken_ns

    def _changed_ns(self) -> int:
        """Return when the certificate's file was last changed; 0 if that cannot be read."""
        try:
            return self._keys.certificate.stat().st_mtime_ns if self._keys is not None else 0
        except OSError:
            return 0

    def close(self) -> None:
        """Look no more; idempotent."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join(JOIN_S)
