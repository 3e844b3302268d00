"""Make an authority for one engine, and certificates that it has signed (no I/O).

Keys are ECDSA on P-256: every TLS client speaks it, and a handshake costs a fraction of one with RSA. A
certificate serves both as a server's and as a client's, because task sets authenticate in both directions.
"""

from __future__ import annotations

import ipaddress
import secrets
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from rce.tls.faults import CertificateError

if TYPE_CHECKING:
    from collections.abc import Iterable

AUTHORITY_DAYS = 3650
"""How long an authority is valid."""
CERTIFICATE_DAYS = 397
"""How long a certificate is valid; browsers accept no more of public authorities."""
RENEWAL_DAYS = 30
"""A certificate with fewer days left is to be renewed."""
CLOCK_SKEW = timedelta(hours=1)
"""Robots' clocks may be late."""
_MAX_COMMON_NAME = 64
_NAME_SIGNS = str.maketrans("", "", "-._*")


@dataclass(frozen=True, slots=True)
class Issued:
    """A certificate with its key, both as PEM."""

    certificate: bytes
    key: bytes


@dataclass(frozen=True, slots=True)
class Details:
    """The contents of a certificate."""

    subject: str
    issuer: str
    hosts: tuple[str, ...]
    """Names and addresses that it is valid for."""
    expires: datetime
    is_authority: bool
    serial: int = 0
    """The serial number, by which it is revoked."""

    def days_left(self, now: datetime | None = None) -> float:
        """Return the days until it expires; negative afterwards."""
        return (self.expires - (now or datetime.now(UTC))) / timedelta(days=1)

    def covers(self, host: str) -> bool:
        """Return whether it is valid for a name or address, as clients check it."""
        wanted = host.strip("[]").lower()
        names = [name.lower() for name in self.hosts]
        return wanted in names or f"*.{wanted.partition('.')[2]}" in names


def make_authority(days: float = AUTHORITY_DAYS) -> Issued:
    """Make an authority.

    Args:
        days: How long it is valid.

    Raises:
        CertificateError: So many days end after the year 9999.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name(f"RCE engine authority {secrets.token_hex(4)}")
    builder = (
        _builder(name, name, key.public_key(), days)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(authority=True), critical=True)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(key.public_key()), critical=False)
    )
    return Issued(_pem(builder.sign(key, hashes.SHA256())), _key_pem(key))


def issue(authority: Issued, name: str, hosts: Iterable[str], days: float = CERTIFICATE_DAYS) -> Issued:
    """Make a certificate.

    Args:
        authority: The authority that signs it.
        name: Its owner.
        hosts: Names and IP addresses that it is good for; may be empty for a client.
        days: How long it is valid; it ends with the authority at the latest.

    Raises:
        CertificateError: The authority cannot be read or has expired, so many days end after the year 9999,
            or a host is neither a name nor an address.
    """
    try:
        signer = x509.load_pem_x509_certificate(authority.certificate)
        signing_key = serialization.load_pem_private_key(authority.key, password=None)
    except ValueError as error:
        raise CertificateError(f"the authority cannot be read: {error}") from error
    if not isinstance(signing_key, ec.EllipticCurvePrivateKey):
        raise CertificateError(
            "the authority's key is not an elliptic curve's, as rce certificate init makes it"
        )
    if signer.not_valid_after_utc <= datetime.now(UTC):
        raise CertificateError(
            f"the authority has expired on {signer.not_valid_after_utc:%Y-%m-%d}, and its certificates"
            " would be refused: make a new one (docs/how-to/tls.md)"
        )
    key = ec.generate_private_key(ec.SECP256R1())
    builder = (
        _builder(_name(name), signer.subject, key.public_key(), days, latest=signer.not_valid_after_utc)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(authority=False), critical=True)
        .add_extension(
            x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]),
            critical=False,
        )
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(signing_key.public_key()), critical=False
        )
    )
    if names := [_general_name(host) for host in dict.fromkeys(hosts)]:
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
    return Issued(_pem(builder.sign(signing_key, hashes.SHA256())), _key_pem(key))


def read_details(pem: bytes) -> Details:
    """Read the first certificate of a PEM text.

    Raises:
        CertificateError: The text holds no certificate.
    """
    try:
        found = x509.load_pem_x509_certificate(pem)
    except ValueError as error:
        raise CertificateError(f"no certificate in PEM form: {error}") from error
    hosts: list[str] = []
    is_authority = False
    for extension in found.extensions:
        if isinstance(extension.value, x509.SubjectAlternativeName):
            hosts += extension.value.get_values_for_type(x509.DNSName)
            hosts += map(str, extension.value.get_values_for_type(x509.IPAddress))
        elif isinstance(extension.value, x509.BasicConstraints):
            is_authority = extension.value.ca
    return Details(
        subject=_common_name(found.subject),
        issuer=_common_name(found.issuer),
        hosts=tuple(hosts),
        expires=found.not_valid_after_utc,
        is_authority=is_authority,
        serial=found.serial_number,
    )


def is_signed_by(certificate: bytes, authority: bytes) -> bool:
    """Return whether an authority has signed a certificate, both as PEM."""
    try:
        x509.load_pem_x509_certificate(certificate).verify_directly_issued_by(
            x509.load_pem_x509_certificate(authority)
        )
    except (ValueError, TypeError, InvalidSignature):
        return False
    return True


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePublicKey,
    days: float,
    latest: datetime | None = None,
) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    try:
        end = now + timedelta(days=days)
    except OverflowError as error:
        raise CertificateError(
            f"a certificate cannot be valid for {days:g} days: that ends after the year 9999; take fewer days"
        ) from error
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(min(now, end) - CLOCK_SKEW)
        .not_valid_after(end if latest is None else min(end, latest))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _usage(*, authority: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=True,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=authority,
        crl_sign=authority,
        encipher_only=False,
        decipher_only=False,
    )


def _name(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text[:_MAX_COMMON_NAME])])


def _common_name(name: x509.Name) -> str:
    found = name.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(found[0].value) if found else name.rfc4514_string()


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host.strip("[]")))
    except ValueError:
        pass
    if not host or not host.isascii() or not host.translate(_NAME_SIGNS).isalnum():
        raise CertificateError(
            f"{host!r} is neither a host name nor an IP address;"
            " write --host robots.example.org or --host 10.0.0.7"
        )
    return x509.DNSName(host.lower())


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
