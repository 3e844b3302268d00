"""Revocation of certificates: the authority's signed list, ``revoked.pem``.

The list is a CRL as OpenSSL reads it. It names certificates by their serial numbers, so issued certificates
are recorded beside it (``issued.jsonl``): revoking a name revokes each of its certificates, also those that
were renewed since and of which this machine has no copy.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

import msgspec
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from rce.tls.authority import CLOCK_SKEW, Issued
from rce.tls.faults import CertificateError


class Record(msgspec.Struct, frozen=True, omit_defaults=True):
    """One certificate that was issued."""

    name: str
    serial: str
    """In hex."""
    expires: datetime
    named: tuple[str, ...] | None = None
    """The hosts that an operator named; the others were found at the machine. None: all were named."""


@dataclass(frozen=True, slots=True)
class Revocation:
    """One certificate that was revoked."""

    serial: int
    since: datetime


def make_list(authority: Issued, revoked: list[Revocation]) -> bytes:
    """Make the signed list, as PEM.

    It is valid as long as the authority: with an expired list, all connections would be refused.

    Raises:
        CertificateError: The authority cannot be read.
    """
    try:
        signer = x509.load_pem_x509_certificate(authority.certificate)
        key = serialization.load_pem_private_key(authority.key, password=None)
    except ValueError as error:
        raise CertificateError(f"the authority cannot be read: {error}") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise CertificateError(
            "the authority's key is not an elliptic curve's, as rce certificate init makes it"
        )
    builder = (
        x509.CertificateRevocationListBuilder()
        .issuer_name(signer.subject)
        .last_update(min(datetime.now(UTC), signer.not_valid_after_utc) - CLOCK_SKEW)
        .next_update(signer.not_valid_after_utc)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(key.public_key()), critical=False)
    )
    number = x509.CRLNumber(int(datetime.now(UTC).timestamp()))
    builder = builder.add_extension(number, critical=False)
    for one in revoked:
        entry = x509.RevokedCertificateBuilder().serial_number(one.serial).revocation_date(one.since)
        builder = builder.add_revoked_certificate(entry.build())
    return builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)


def read_list(pem: bytes, authority: bytes) -> list[Revocation]:
    """Read a list, oldest first.

    Args:
        pem: The list.
        authority: The certificate of the authority that must have signed it.

    Raises:
        CertificateError: It cannot be read, or another authority signed it.
    """
    try:
        found = x509.load_pem_x509_crl(pem)
        signer = x509.load_pem_x509_certificate(authority).public_key()
    except ValueError as error:
        raise CertificateError(f"not a list of revoked certificates in PEM form: {error}") from error
    if not isinstance(signer, ec.EllipticCurvePublicKey) or not found.is_signature_valid(signer):
        raise CertificateError(
            "another authority signed it; copy the list of this engine's authority,"
            " or remove the file if nothing is to be revoked"
        )
    return [Revocation(one.serial_number, one.revocation_date_utc) for one in found]
