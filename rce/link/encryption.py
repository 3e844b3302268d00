"""TLS for links over TCP: both ends prove that they know the link's token; none needs a certificate's file.

The master gives a random token to the two ends of a link, and to nothing else. Each end derives from it two
key pairs, one for the dialing and one for the accepting end, with self-signed certificates. It shows its own
and trusts the other one only. So a TLS 1.3 handshake succeeds exactly between the two ends that the master
chose, a recorded link stays secret when the token becomes known later, and an end cannot be answered by
itself. A container's environment, which knows the tokens of its links, needs nothing of its machine's.

Since the token is needed before the handshake, the dialing end names the link in clear first (``SECURE``).
"""

from __future__ import annotations

import os
import ssl
from datetime import UTC, datetime

_SALT = b"rce link tls 1"
_BEGIN = datetime(1970, 1, 1, tzinfo=UTC)
_END = datetime(9999, 12, 31, tzinfo=UTC)
"""Certificates of a token are as good as the token, whatever the clocks of the two machines say."""
_ROLES = {True: "rce link dialing end", False: "rce link accepting end"}


def dialing_context(token: str) -> ssl.SSLContext:
    """Return the context of a link's dialing end. Blocks for milliseconds, the first time longer."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False  # the key identifies the peer
    return _prepare(context, token, dialing=True)


def accepting_context(token: str) -> ssl.SSLContext:
    """Return the context of a link's accepting end. Blocks for milliseconds, the first time longer."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.num_tickets = 0  # a link is dialed again with a whole handshake
    return _prepare(context, token, dialing=False)


def _prepare(context: ssl.SSLContext, token: str, *, dialing: bool) -> ssl.SSLContext:
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.verify_mode = ssl.CERT_REQUIRED
    certificate, key = _derive(token, dialing=dialing)
    trusted, _ = _derive(token, dialing=not dialing)
    context.load_verify_locations(cadata=trusted.decode())
    # OpenSSL takes keys from files only; this one exists in memory and in this process.
    descriptor = os.memfd_create("link", os.MFD_CLOEXEC)
    try:
        os.write(descriptor, certificate + key)
        context.load_cert_chain(f"/proc/self/fd/{descriptor}")
    finally:
        os.close(descriptor)
    return context


def _derive(token: str, *, dialing: bool) -> tuple[bytes, bytes]:
    """Return the certificate and the key of one end as PEM; the same for the same token, bit for bit."""
    from cryptography import x509  # 19 MB, which only processes with such links spend
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.hazmat.primitives.kdf.hkdf import HKDF
    from cryptography.x509.oid import NameOID

    role = _ROLES[dialing]
    seed = HKDF(hashes.SHA256(), length=32, salt=_SALT, info=role.encode()).derive(token.encode())
    key = Ed25519PrivateKey.from_private_bytes(seed)
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, role)])
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(_BEGIN)
        .not_valid_after(_END)
        .sign(key, None)
    )
    return (
        certificate.public_bytes(serialization.Encoding.PEM),
        key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        ),
    )
