"""Makes the keys of a cell: its authority, and a certificate and private key for each name.

Needs the library `cryptography`, on the host that makes keys only.  A certificate says what its
owner may be: a shard serves at the hosts of its endpoints and calls others; anybody else only
calls.  Every file is replaced as a whole, and no private key is ever readable by others.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from enact_dist.core.shard.owners import SHARD_PREFIX, shard_identity
from enact_dist.errors import ConfigError, MisuseError
from enact_dist.link.folder.lock import replace_file
from enact_dist.link.zenoh.access import (
    REVOKED_FILE,
    common_name,
    read_revoked,
    split_common_name,
    text_of_revoked,
)
from enact_dist.link.zenoh.endpoints import split_endpoint
from enact_dist.link.zenoh.tls import (
    AUTHORITY,
    AUTHORITY_KEY,
    DAY_S,
    RENEW_DAYS,
    Certificate,
    KeyFiles,
    hosts_missing,
    own_certificate,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    from enact_dist.config.types import CellConfig

AUTHORITY_DAYS: Final = 3650
SHARD_DAYS: Final = 730
CLIENT_DAYS: Final = 365
EARLIER: Final = dt.timedelta(minutes=5)
"""Certificates are valid from a little before they are made: clocks differ."""
_FILE_MODE, _FOLDER_MODE = 0o600, 0o700
_LOOPBACKS: Final = {"0.0.0.0": "127.0.0.1", "::": "::1"}  # noqa: S104 - compared alone
"""How programs of the same host reach a shard that listens at every address."""


@dataclass(frozen=True, slots=True)
class KeyOwner:
    """A name of the cell that has a key.

    Attributes:
        name: `shard.left`, or the name of an actor or operator.
        hosts: Where it serves; a client has none.
        revoked: How often its keys were revoked.
    """

    name: str
    hosts: tuple[str, ...] = ()
    revoked: int = 0

    @property
    def is_shard(self) -> bool:
        """Whether it serves."""
        return self.name.startswith(SHARD_PREFIX)


def owners_of(config: CellConfig) -> tuple[KeyOwner, ...]:
    """Return the shards, actors and operators of a cell, in the order of its file.

    Raises:
        ConfigError: The list of revoked keys cannot be used.
    """
    revoked = read_revoked(config.security.keys) if config.security.keys is not None else {}
    shards = [
        KeyOwner(shard_identity(one.name), _hosts_of((*one.listen, *one.advertise)))
        for one in config.shards
    ]
    return (*shards, *(KeyOwner(name, revoked=revoked.get(name, 0)) for name in config.key_holders))


def _hosts_of(endpoints: Iterable[str]) -> tuple[str, ...]:
    hosts = dict.fromkeys(split_endpoint(endpoint)[1].strip("[]") for endpoint in endpoints)
    return tuple(dict.fromkeys(_LOOPBACKS.get(host, host) for host in hosts))


@dataclass(frozen=True, slots=True)
class Authority:
    """What makes certificates: the certificate of the authority and its private key."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey

    @classmethod
    def load(cls, folder: Path) -> Authority:
        """Read the authority's files.

        Raises:
            ConfigError: They are missing or cannot be read.
        """
        try:
            certificate = x509.load_pem_x509_certificate((folder / AUTHORITY).read_bytes())
            text = (folder / AUTHORITY_KEY).read_bytes()
            key = serialization.load_pem_private_key(text, None)
        except FileNotFoundError as error:
            raise ConfigError(
                f"there is no authority in {folder} ({error.filename} is missing); make it once, on"
                " this host: enact cell keys init; or name its folder with --authority",
                path=str(folder),
            ) from error
        except (OSError, ValueError, TypeError) as error:
            raise ConfigError(f"cannot read the authority in {folder}: {error}") from error
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise ConfigError(f"{folder / AUTHORITY_KEY} is no key of `enact cell keys init`")
        return cls(certificate, key)

    def issue(
        self, owner: KeyOwner, *, days: float | None = None, starts: dt.datetime | None = None
    ) -> tuple[bytes, bytes]:
        """Return a new certificate and its new private key, both in PEM.

        Args:
            owner: Whose it is.
            days: How long it is valid; None: two years for a shard, one for any other.
            starts: Since when; None: now.
        """
        key = ec.generate_private_key(ec.SECP256R1())
        begin = (starts or dt.datetime.now(dt.UTC)) - EARLIER
        lasts = dt.timedelta(days=days or (SHARD_DAYS if owner.is_shard else CLIENT_DAYS)) + EARLIER
        uses = [ExtendedKeyUsageOID.CLIENT_AUTH]
        if owner.is_shard:
            uses.insert(0, ExtendedKeyUsageOID.SERVER_AUTH)
        end = min(begin + lasts, self.certificate.not_valid_after_utc)
        draft = _draft(
            common_name(owner.name, owner.revoked), self.certificate.subject, key, begin, end
        )
        ours = self.certificate.extensions.get_extension_for_class(x509.SubjectKeyIdentifier).value
        made_by = x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(ours)
        draft = draft.add_extension(made_by, critical=False)
        draft = draft.add_extension(x509.ExtendedKeyUsage(uses), critical=False)
        if owner.hosts:
            names = x509.SubjectAlternativeName([*map(_general_name, owner.hosts)])
            draft = draft.add_extension(names, critical=False)
        return _pem(draft.sign(self.key, hashes.SHA256())), _key_pem(key)


def make_authority(cell: str, folder: Path) -> Path:
    """Make the authority of a cell; return its certificate's path.

    Raises:
        MisuseError: The folder has one already.
    """
    if (folder / AUTHORITY_KEY).exists() or (folder / AUTHORITY).exists():
        raise MisuseError(
            f"{folder} has an authority already; every key of the cell depends on it. To replace"
            " it, move that folder aside, and make all keys again"
        )
    key = ec.generate_private_key(ec.SECP256R1())
    now = dt.datetime.now(dt.UTC)
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"authority of {cell}"[:64])])
    end = now + dt.timedelta(days=AUTHORITY_DAYS)
    usage = x509.KeyUsage(
        digital_signature=False,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=True,
        crl_sign=True,
        encipher_only=False,
        decipher_only=False,
    )
    draft = _draft(subject, subject, key, now - EARLIER, end, authority=True)
    certificate = draft.add_extension(usage, critical=True).sign(key, hashes.SHA256())
    make_folder(folder)
    replace_file(folder / AUTHORITY_KEY, _key_pem(key), mode=_FILE_MODE)
    replace_file(folder / AUTHORITY, _pem(certificate), mode=_FILE_MODE)
    return folder / AUTHORITY


def write_keys(authority: Authority, owner: KeyOwner, folder: Path) -> KeyFiles:
    """Make a certificate and a private key, and put them into a key folder beside `ca.pem`."""
    certificate, key = authority.issue(owner)
    return put_keys(authority, owner, folder, certificate, key)


def put_keys(
    authority: Authority, owner: KeyOwner, folder: Path, certificate: bytes, key: bytes
) -> KeyFiles:
    """Put a certificate and a private key into a key folder beside `ca.pem`.

    If `ca.pem` has another authority, it holds both from now on: keys of either are accepted.
    """
    make_folder(folder)
    files = KeyFiles(folder, owner.name)
    # The key goes first: a process that reads both in between refuses the pair and keeps its own.
    replace_file(files.private_key, key, mode=_FILE_MODE)
    replace_file(files.certificate, certificate, mode=_FILE_MODE)
    known = files.authority.read_bytes() if files.authority.exists() else b""
    if _pem(authority.certificate) not in known:
        replace_file(files.authority, known + _pem(authority.certificate), mode=_FILE_MODE)
    return files


def make_folder(folder: Path) -> None:
    """Make a folder that only its owner can enter; one that is there stays as it is."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    if not folder.is_dir():
        folder.mkdir(mode=_FOLDER_MODE)


def read_certificate(file: Path) -> Certificate:
    """Read a certificate, whatever made it.

    Raises:
        ConfigError: The file is missing or no certificate.
    """
    try:
        found = x509.load_pem_x509_certificate(file.read_bytes())
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot read the certificate {file}: {error}", path=str(file)) from error
    names = found.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    hosts: tuple[str, ...] = ()
    try:
        said = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        hosts = tuple(str(one.value) for one in said)
    except x509.ExtensionNotFound:
        pass
    times = found.not_valid_before_utc.timestamp(), found.not_valid_after_utc.timestamp()
    name, revoked = split_common_name(str(names[0].value) if names else "")
    return Certificate(name, hosts, *times, revoked)


@dataclass(frozen=True, slots=True)
class KeyState:
    """A name and its files in a key folder.

    Attributes:
        owner: The name, as `cell.toml` has it.
        files: Its files, which may be missing.
        certificate: What its certificate says, if there is one.
        problem: What should be done; empty if nothing.
    """

    owner: KeyOwner
    files: KeyFiles
    certificate: Certificate | None
    problem: str


def key_states(folder: Path, owners: Iterable[KeyOwner], *, others: bool = False) -> list[KeyState]:
    """Return the state of each owner's key, and of those that belong to no owner (`others`).

    Raises:
        ConfigError: A file is no certificate.
    """
    known = {owner.name: owner for owner in owners}
    strange = {file.stem for file in folder.glob("*.crt")} - set(known) if others else set()
    found = []
    for owner in (*known.values(), *map(KeyOwner, sorted(strange))):
        files = KeyFiles(folder, owner.name)
        certificate = read_certificate(files.certificate) if files.certificate.exists() else None
        problem = "make it" if certificate is None else _problem(certificate, owner, files)
        if owner.name in strange:
            problem = "cell.toml has no such name: delete it"
        found.append(KeyState(owner, files, certificate, problem))
    return found


def _problem(found: Certificate, owner: KeyOwner, files: KeyFiles) -> str:
    """Return what should be done about a certificate."""
    now_s = time.time()
    if found.revoked < owner.revoked:
        return "revoked: renew it, or delete it"
    if problem := found.problem(now_s):
        return problem
    if missing := hosts_missing(found, owner.hosts):
        return f"it is not for {', '.join(missing)}: renew it"
    try:
        own_certificate(files)
    except ConfigError as error:
        return str(error)
    days = (found.ends_s - now_s) / DAY_S
    return f"ends in {days:.0f} days: renew it" if days < RENEW_DAYS else ""


def revoke(folder: Path, owners: Iterable[KeyOwner]) -> Path:
    """Note that all keys so far of these owners are worth nothing; return the list's path.

    Raises:
        ConfigError: One is a shard, or the list cannot be used.
    """
    revoked = read_revoked(folder)
    for owner in owners:
        if owner.is_shard:
            raise ConfigError(
                f"the key of {owner.name} cannot be revoked: clients compare a shard's name by"
                " themselves, with no list; replace the authority (docs/security.md)"
            )
        revoked[owner.name] = revoked.get(owner.name, 0) + 1
    make_folder(folder)
    file = folder / REVOKED_FILE
    replace_file(file, text_of_revoked(revoked).encode(), mode=_FILE_MODE)
    return file


def authority_folder(folder: Path, named: Path | None) -> Path:
    """Return where the authority's key lies: beside the key folder, unless another is named.

    Raises:
        ConfigError: It would be the key folder itself, which is copied to hosts.
    """
    there = named or folder.parent / "authority"
    if os.path.realpath(there) == os.path.realpath(folder):
        raise ConfigError(
            f"{there} is the key folder, which is copied to hosts; the authority's key must lie"
            " elsewhere: any program that has it can make keys for any name"
        )
    return there


# ---------------------------------------------------------------- certificates


def _draft(
    name: str | x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    begin: dt.datetime,
    end: dt.datetime,
    *,
    authority: bool = False,
) -> x509.CertificateBuilder:
    if isinstance(name, str):
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    constraints = x509.BasicConstraints(ca=authority, path_length=0 if authority else None)
    return (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(begin)
        .not_valid_after(end)
        .add_extension(constraints, critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    encoding, plain = serialization.Encoding.PEM, serialization.NoEncryption()
    return key.private_bytes(encoding, serialization.PrivateFormat.PKCS8, plain)
