"""The keys of a process: its files, Zenoh's settings for them, and a look at another's certificate.

A key folder holds, for each name, a certificate `NAME.crt` and a private key `NAME.key`, and beside
them `ca.pem`, the certificate of the cell's authority.  A shard's name is `shard.NAME`.

Zenoh connects again and again where a certificate is refused, and its log names no cause.  So
`look` makes the handshake itself, with Python's `ssl` and the same files; it takes 5 ms, and up to
`ALERT_S` more until a shard has accepted ours.  This module loads neither Zenoh nor `cryptography`.
"""

from __future__ import annotations

import contextlib
import os
import queue
import socket
import ssl
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from enact_dist.core.shard.owners import SHARD_PREFIX, shard_identity
from enact_dist.errors import ConfigError
from enact_dist.link.zenoh.access import split_common_name
from enact_dist.link.zenoh.endpoints import split_endpoint
from enact_dist.wire.texts import shown

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from enact_dist.config.rights import SecurityConfig

IDENTITY_VARIABLE: Final = "ENACT_IDENTITY"
AUTHORITY: Final = "ca.pem"
AUTHORITY_KEY: Final = "ca.key"
DAY_S: Final = 86_400.0
RENEW_DAYS: Final = 30.0
"""A certificate that ends within this time should be renewed."""
LOOK_S: Final = 0.5
"""How long a look may take."""
ALERT_S: Final = 0.2
"""How long a shard may take to refuse our certificate: it does so after the handshake."""
_OTHERS: Final = 0o077
_ANY_TIME: Final = ssl.VerifyFlags(0x200000)
"""OpenSSL's X509_V_FLAG_NO_CHECK_TIME: read a certificate that has ended, too."""


@dataclass(frozen=True, slots=True)
class KeyFiles:
    """The files by which a process proves its name.

    Attributes:
        folder: The key folder of this host.
        name: The name: `shard.left`, or that of an actor or operator.
    """

    folder: Path
    name: str

    @property
    def authority(self) -> Path:
        """The certificate of the cell's authority, or of two during a change."""
        return self.folder / AUTHORITY

    @property
    def certificate(self) -> Path:
        """The certificate of this name."""
        return self.folder / f"{self.name}.crt"

    @property
    def private_key(self) -> Path:
        """The private key of this name."""
        return self.folder / f"{self.name}.key"

    def settings(self, *, listens: bool) -> dict[str, object]:
        """Return Zenoh's settings: both sides show certificates, and a link ends with one."""
        side = "listen" if listens else "connect"
        return {
            "root_ca_certificate": str(self.authority),
            f"{side}_certificate": str(self.certificate),
            f"{side}_private_key": str(self.private_key),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        }

    def check(self) -> None:
        """Check that the files can be used and that no other user can read the private key.

        Raises:
            ConfigError: A file is missing, unreadable, open to others, or does not fit the others.
        """
        for file in (self.authority, self.certificate, self.private_key):
            try:
                mode = file.stat().st_mode
                file.read_bytes()
            except OSError as error:
                remedy = "`enact cell keys make` makes it, on the host with the authority's key"
                raise ConfigError(
                    f"cannot read {file}: {error.strerror}; {remedy} (docs/security.md)",
                    path=str(file),
                ) from error
            if file == self.private_key and mode & _OTHERS:
                raise ConfigError(
                    f"other users may use the private key {file} (mode {mode & 0o777:04o}); run"
                    f" chmod 600 {file}, and make a new key if anybody else has had access",
                    path=str(file),
                )
        self.context()

    def context(self, side: int = ssl.PROTOCOL_TLS_CLIENT) -> ssl.SSLContext:
        """Return the settings of Python's `ssl` for these files.

        Raises:
            ConfigError: They cannot be used.
        """
        context = ssl.SSLContext(side)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        try:
            context.load_verify_locations(self.authority)
        except (OSError, ssl.SSLError) as error:
            raise self._unusable(self.authority, error) from error
        try:
            context.load_cert_chain(self.certificate, self.private_key)
        except (OSError, ssl.SSLError) as error:
            raise self._unusable(self.certificate, error) from error
        return context

    def _unusable(self, file: Path, error: OSError) -> ConfigError:
        mismatch = "KEY_VALUES_MISMATCH" in str(error)
        text = (
            f"{self.certificate} and {self.private_key} do not belong together: copy both"
            if mismatch
            else f"{file} is no file of the kind that `enact cell keys` writes: {error}"
        )
        return ConfigError(text, path=str(file))


@dataclass(frozen=True, slots=True)
class Certificate:
    """What a certificate says.

    Attributes:
        name: The name that it proves.
        hosts: The addresses and host names at which it may serve.
        starts_s: Since when it is valid, Unix time.
        ends_s: Until when it is valid, Unix time.
        revoked: How often keys of that name had been revoked before.
    """

    name: str
    hosts: tuple[str, ...] = ()
    starts_s: float = 0.0
    ends_s: float = 0.0
    revoked: int = 0

    def problem(self, now_s: float) -> str:
        """Return why it is not valid at a time; empty if it is."""
        if now_s > self.ends_s:
            return (
                f"ended on {day_of(self.ends_s)} (this host's clock says {day_of(now_s)}); renew"
                f" it: enact cell keys renew {self.name}"
            )
        if now_s < self.starts_s:
            return (
                f"is valid only from {day_of(self.starts_s)} on, and this host's clock says"
                f" {day_of(now_s)}: correct the clock of this host, or of the one that made it"
            )
        return ""

    def validity(self, now_s: float) -> str:
        """Return from when to when it is valid, and what this host's clock says."""
        times = f"valid from {day_of(self.starts_s)} to {day_of(self.ends_s)}"
        return f"{times}, and this host's clock says {day_of(now_s)}"


def day_of(unix_s: float) -> str:
    """Return a time for people."""
    return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(unix_s))


def own_certificate(keys: KeyFiles) -> Certificate:
    """Return the certificate in the files, after both sides of a handshake have accepted it.

    Its time may be over; see `Certificate.problem`.

    Raises:
        ConfigError: The files cannot be used, another authority made the certificate, or it proves
            another name or has another use.
    """
    keys.check()
    serves = keys.name.startswith(SHARD_PREFIX)
    server, client = keys.context(ssl.PROTOCOL_TLS_SERVER), keys.context()
    server.verify_mode = ssl.CERT_REQUIRED
    client.check_hostname = False
    client.verify_mode = ssl.CERT_REQUIRED if serves else ssl.CERT_NONE
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    for context in (server, client):
        context.verify_flags |= _ANY_TIME
    ends = [client.wrap_bio(back, there), server.wrap_bio(there, back, server_side=True)]
    try:
        for end in (*ends, *ends):
            with contextlib.suppress(ssl.SSLWantReadError):
                end.do_handshake()
    except ssl.SSLError as error:
        raise ConfigError(
            f"{keys.certificate} cannot be used with {keys.authority}: {_cause(error)}",
            path=str(keys.certificate),
        ) from error
    found = certificate_of(ends[1].getpeercert() or {})
    if found.name != keys.name:
        raise ConfigError(
            f"{keys.certificate} proves the name {shown(found.name)!r}, not {keys.name!r}; copy the"
            " right file",
            path=str(keys.certificate),
        )
    return found


def certificate_of(said: Mapping[str, Any]) -> Certificate:
    """Return the contents of a certificate that `ssl` has accepted."""
    names = [
        value for part in said.get("subject", ()) for key, value in part if key == "commonName"
    ]
    times = [
        ssl.cert_time_to_seconds(said[key]) for key in ("notBefore", "notAfter") if key in said
    ]
    starts_s, ends_s = times if len(times) == 2 else (0.0, 0.0)
    hosts = tuple(value for _, value in said.get("subjectAltName", ()))
    name, revoked = split_common_name(names[0] if names else "")
    return Certificate(name, hosts, starts_s, ends_s, revoked)


# ---------------------------------------------------------------- whose files


def shard_keys(security: SecurityConfig, shard: str) -> KeyFiles | None:
    """Return the files of a shard; None in a cell without keys."""
    return KeyFiles(security.keys, shard_identity(shard)) if security.keys else None


def client_keys(security: SecurityConfig, actor: str) -> KeyFiles | None:
    """Return the files by which a client proves its name; None in a cell without keys.

    The first of these that the key folder has: the actor's own, those that `ENACT_IDENTITY` names,
    those of the first of the cell's operators, the only ones that are no shard's, and a shard's.

    Raises:
        ConfigError: The folder has none, or several without a reason to prefer one.
    """
    folder = security.keys
    if folder is None:
        return None
    if actor and KeyFiles(folder, actor).certificate.exists():
        return KeyFiles(folder, actor)
    wanted = os.environ.get(IDENTITY_VARIABLE, "")
    if wanted:
        return KeyFiles(folder, wanted)
    names = sorted(file.stem for file in folder.glob("*.crt"))
    operators = [name for name in security.key_holders if name in names]
    others = [name for name in names if not name.startswith(SHARD_PREFIX)]
    if len(others) > 1 and not operators:
        raise ConfigError(
            f"{folder} has several certificates ({', '.join(others)}) and none for {actor!r}; name"
            f" one in {IDENTITY_VARIABLE}, or an operator in [security] operators of cell.toml"
        )
    if not names:
        raise ConfigError(
            f"{folder} has no certificate for {actor!r}; copy ca.pem and its two files from the"
            " host that makes the keys (docs/security.md)",
            path=str(folder),
        )
    return KeyFiles(folder, (operators or others or names)[0])


# ---------------------------------------------------------------- a look


@dataclass(frozen=True, slots=True)
class TlsLook:
    """What a handshake at an endpoint showed.

    Attributes:
        reason: Why a connection is refused, by either side; empty if none is.
        listens: Whether anything listens there.
    """

    endpoint: str
    reason: str = ""
    certificate: Certificate | None = None
    listens: bool = True


def look(endpoint: str, keys: KeyFiles, *, wait_s: float = LOOK_S) -> TlsLook:
    """Make a handshake at a ``tls/host:port`` endpoint, and say why it fails.

    Raises:
        ConfigError: The own files cannot be used.
    """
    own, context, end_s = own_certificate(keys), keys.context(), time.monotonic() + wait_s
    try:
        found, error = _shown(endpoint, context, end_s)
    except (OSError, ValueError):
        return TlsLook(endpoint, listens=False)
    if error is None:
        return TlsLook(endpoint, "", found)
    if found is None and _is_of_time(error):
        context.verify_flags |= _ANY_TIME
        with contextlib.suppress(OSError):
            found, _ = _shown(endpoint, context, end_s, for_alert=False)
    return TlsLook(endpoint, _reason(error, endpoint, keys, own, found), found)


def _shown(
    endpoint: str, context: ssl.SSLContext, end_s: float, *, for_alert: bool = True
) -> tuple[Certificate | None, OSError | None]:
    """Make a handshake; return the certificate that was shown, and why the handshake failed.

    With `for_alert` it waits until the shard has had time to refuse our certificate.

    Raises:
        OSError: Nothing answers in time.
        ValueError: The endpoint has no port.
    """
    _, host, port = split_endpoint(endpoint)
    host, found = host.strip("[]"), None

    def left_s() -> float:
        return max(0.01, end_s - time.monotonic())

    try:
        with socket.create_connection((host, int(port)), left_s()) as plain:
            plain.settimeout(left_s())
            with context.wrap_socket(plain, server_hostname=host) as line:
                found = certificate_of(line.getpeercert() or {})
                line.settimeout(min(ALERT_S, left_s()))
                with contextlib.suppress(TimeoutError):
                    _ = line.recv(1) if for_alert else b""
    except (ssl.SSLError, ConnectionResetError) as error:
        return found, error
    return found, None


def _cause(error: OSError) -> str:
    found = getattr(error, "verify_message", "") or getattr(error, "reason", "") or str(error)
    return str(found).lower().replace("_", " ").removeprefix("tlsv1 ").removeprefix("sslv3 ")


def _is_of_time(error: OSError) -> bool:
    """Whether a certificate is refused because it is not valid now."""
    return any(part in _cause(error) for part in ("expired", "not yet valid"))


def _reason(
    error: OSError, endpoint: str, keys: KeyFiles, own: Certificate, theirs: Certificate | None
) -> str:
    """Return why a handshake has failed, and what to do."""
    cause, now_s = _cause(error), time.time()
    if isinstance(error, ssl.SSLCertVerificationError):
        remedy = next((text for part, text in _THEIRS.items() if part in cause), "")
        if theirs is not None and _is_of_time(error):
            remedy = f"; it is {theirs.validity(now_s)}{remedy}"
        host = split_endpoint(endpoint)[1].strip("[]")
        return f"its certificate is refused here: {cause}{remedy.format(host=host)}"
    if "alert" in cause:
        remedy = ""
        if problem := own.problem(now_s):
            remedy = f"; it {problem}"
        elif _is_of_time(error):
            remedy = f"; it is {own.validity(now_s)}; correct the clock of the shard's host"
        if "unknown ca" in cause:
            remedy = "; the shard's ca.pem is of another authority than this certificate"
        return f"the shard refuses our certificate {keys.certificate}: {cause}{remedy}"
    return f"the handshake fails: {cause}; is it a TLS endpoint?"


_THEIRS: Final = {
    "mismatch": "; name {host} in `listen` or `advertise` of the shard and renew its certificate",
    "local issuer": "; another authority than that of our ca.pem has made it",
    "self-signed": "; another authority than that of our ca.pem has made it",
    "expired": "; renew it, and reload the shard (enact cell keys renew, enact shard reload), or"
    " correct the clock of this host",
    "not yet valid": "; correct the clock of this host, or of the one that made it",
    "purpose": "; it is not one of a shard",
}


def why_refused(endpoints: Iterable[str], keys: KeyFiles | None, shard: str = "") -> str:
    """Return why no connection comes about at TLS endpoints; empty if TLS is not the reason.

    See `refusals` for the arguments.
    """
    return "; ".join(f"{place}: {why}" for place, why in refusals(endpoints, keys, shard).items())


def refusals(endpoints: Iterable[str], keys: KeyFiles | None, shard: str = "") -> dict[str, str]:
    """Return the TLS endpoints where a certificate is refused, each with the reason.

    Without the name of a `shard` any may answer.  Takes at most `LOOK_S`, whatever a name server
    does.
    """
    places = [one for one in dict.fromkeys(endpoints) if one.startswith("tls/")]
    if keys is None:
        return {}
    found: queue.SimpleQueue[tuple[str, str]] = queue.SimpleQueue()

    def look_at(endpoint: str) -> None:
        try:
            seen = look(endpoint, keys)
            reason = seen.reason or wrong_name(seen.certificate, shard)
        except ConfigError as error:
            reason = str(error)
        found.put((endpoint, reason))

    for place in places:
        threading.Thread(target=look_at, args=(place,), name="tls-look", daemon=True).start()
    reasons: dict[str, str] = {}
    end_s = time.monotonic() + LOOK_S
    while len(reasons) < len(places) and (left_s := end_s - time.monotonic()) > 0:
        with contextlib.suppress(queue.Empty):
            place, reason = found.get(timeout=left_s)
            reasons[place] = reason
    return {place: reason for place, reason in reasons.items() if reason}


def wrong_name(found: Certificate | None, shard: str) -> str:
    """Return what is wrong with the name of the certificate at a shard's endpoint, if anything."""
    expected = shard_identity(shard)
    if found is None or not shard or found.name == expected:
        return ""
    return f"the certificate there is that of {shown(found.name)}, not of {expected}"


def hosts_missing(certificate: Certificate, hosts: Iterable[str]) -> list[str]:
    """Return the hosts for which a certificate is not."""
    named = {_plain(host) for host in certificate.hosts}
    return [host for host in hosts if _plain(host) not in named]


def _plain(host: str) -> str:
    """Return one form of a host: IPv6 addresses have several."""
    with contextlib.suppress(OSError):
        return socket.inet_ntop(socket.AF_INET6, socket.inet_pton(socket.AF_INET6, host))
    return host.lower()
