"""Keys and certificates, one folder for each credential, and the roster of those that hold.

Every certificate but the router's has an issuer of its own, whose key is forgotten as soon as it
has signed. The router trusts exactly the issuers on the roster, so a certificate that is taken off
it is refused at the door.

    FOLDER/authority/   key and certificate of the authority, roster.json; stays on this machine
    FOLDER/router/      key.pem, cert.pem, ca.pem, router.json5
    FOLDER/<name>/      key.pem, cert.pem, ca.pem: what one process needs
"""

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from services.security.kinds import Credential, check
from shared.errors import ConfigError
from shared.statefile import write_atomically

AUTHORITY_DAYS = 7300
EARLY = timedelta(days=1)
"""Certificates hold from a day ago: clocks of robots are not exact."""
HOSTS = ("localhost", "127.0.0.1", "::1")
ROUTER = "router"


@dataclass(frozen=True)
class Identity:
    """A certificate with its key."""

    key: ec.EllipticCurvePrivateKey
    certificate: x509.Certificate


def identity(
    name: str,
    issuer: Identity | None,
    until: datetime,
    *,
    hosts: Sequence[str] = (),
    signs: bool = False,
) -> Identity:
    """A new key and its certificate, signed by the issuer or, without one, by itself."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer.certificate.subject if issuer else subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(min(datetime.now(UTC), until) - EARLY)
        .not_valid_after(until)
        .add_extension(x509.BasicConstraints(ca=signs, path_length=0 if signs else None), True)
    )
    if not signs:
        uses = [ExtendedKeyUsageOID.CLIENT_AUTH]
        if hosts:
            uses.append(ExtendedKeyUsageOID.SERVER_AUTH)
            names = [_host(host) for host in hosts]
            builder = builder.add_extension(x509.SubjectAlternativeName(names), False)
        builder = builder.add_extension(x509.ExtendedKeyUsage(uses), False)
    return Identity(key, builder.sign(issuer.key if issuer else key, hashes.SHA256()))


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def pem(certificate: x509.Certificate) -> str:
    """A certificate as text."""
    return certificate.public_bytes(serialization.Encoding.PEM).decode()


class Authority:
    """The folder of an authority, and the roster of certificates that hold."""

    def __init__(self, folder: Path) -> None:
        """Raises ConfigError when there is none."""
        self.folder, self._home = folder, folder / "authority"
        try:
            self._roster: dict[str, Any] = json.loads((self._home / "roster.json").read_text())
            key = serialization.load_pem_private_key((self._home / "key.pem").read_bytes(), None)
            certificate = x509.load_pem_x509_certificate((self._home / "cert.pem").read_bytes())
        except FileNotFoundError as error:
            raise ConfigError(
                f"{folder}: has no authority; make one: corridor secure init {folder}"
            ) from error
        assert isinstance(key, ec.EllipticCurvePrivateKey)
        self._identity = Identity(key, certificate)

    @classmethod
    def create(cls, folder: Path) -> "Authority":
        """The authority of a folder; a new one if it has none."""
        home = folder / "authority"
        if not (home / "roster.json").exists():
            until = datetime.now(UTC) + timedelta(days=AUTHORITY_DAYS)
            made = identity("corridor authority", None, until, signs=True)
            _write_identity(home, made, made.certificate)
            write_private(home / "roster.json", b"{}")
        return cls(folder)

    @property
    def credentials(self) -> dict[str, Credential]:
        """Who may connect, by name."""
        return {
            name: Credential(entry["kind"], tuple(entry["names"]))
            for name, entry in self._roster.items()
            if name != ROUTER
        }

    @property
    def hosts(self) -> list[str]:
        """Names and addresses of the router; empty before it has a certificate."""
        return list(self._roster.get(ROUTER, {}).get("names", []))

    @property
    def trusted(self) -> str:
        """Certificates by which the router knows who may connect."""
        return "".join(entry["issuer"] for entry in self._roster.values())

    def ends(self, name: str) -> datetime:
        """When the certificate of this name ends; long ago if there is none."""
        until = self._roster.get(name, {}).get("until", "0001-01-01T00:00:00+00:00")
        return datetime.fromisoformat(until)

    def add(self, credential: Credential, until: datetime) -> Path:
        """Issue a key and a certificate; an older one no longer holds. Returns its folder."""
        check(credential)
        issuer = identity(f"issuer of {credential.name}", None, until, signs=True)
        made = identity(credential.name, issuer, until)
        return self._enter(credential.name, credential.kind, credential.names, issuer, made)

    def certify_router(self, hosts: Sequence[str], until: datetime) -> Path:
        """Issue the certificate of the router for these names and addresses; returns its folder."""
        hosts = sorted({*HOSTS, *hosts})
        made = identity(ROUTER, self._identity, until, hosts=hosts)
        return self._enter(ROUTER, ROUTER, hosts, self._identity, made)

    def revoke(self, credential: Credential) -> None:
        """Take a certificate off the roster, and its folder away. Raises ConfigError: none such."""
        if credential.name not in self.credentials:
            known = ", ".join(sorted(self.credentials)) or "none"
            raise ConfigError(f"{credential.name}: expected one of {known}")
        del self._roster[credential.name]
        self._save()
        shutil.rmtree(self.folder / credential.name, ignore_errors=True)

    def _enter(
        self, name: str, kind: str, names: Sequence[str], issuer: Identity, made: Identity
    ) -> Path:
        _write_identity(self.folder / name, made, self._identity.certificate)
        until = made.certificate.not_valid_after_utc.isoformat()
        entry = {"kind": kind, "names": names, "until": until, "issuer": pem(issuer.certificate)}
        self._roster[name] = entry
        self._save()
        return self.folder / name

    def _save(self) -> None:
        write_private(self._home / "roster.json", json.dumps(self._roster, indent=1).encode())


def _write_identity(folder: Path, made: Identity, authority: x509.Certificate) -> None:
    private = made.key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    write_private(folder / "key.pem", private)
    write_private(folder / "cert.pem", pem(made.certificate).encode())
    write_private(folder / "ca.pem", pem(authority).encode())


def write_private(path: Path, data: bytes) -> None:
    """Write a file that only its owner reads, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    write_atomically(path, data, 0o600)
