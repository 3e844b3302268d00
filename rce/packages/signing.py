"""Keys and signatures: Ed25519, written in hex.

``cryptography`` takes 4 MB: it is loaded when a key is first made, read or checked.
"""

from __future__ import annotations

import hashlib
from binascii import unhexlify
from typing import TYPE_CHECKING

from rce.packages.exceptions import BadKeyError, BadSignatureError

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

KEY_BYTES = 32
SIGNATURE_BYTES = 64
_ID_LENGTH = 16


class SigningKey:
    """A user's private key; hidden in logs."""

    def __init__(self, key: Ed25519PrivateKey) -> None:
        self._key = key

    @classmethod
    def generate(cls) -> SigningKey:
        """Make a new one."""
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

        return cls(Ed25519PrivateKey.generate())

    @classmethod
    def from_pem(cls, text: bytes) -> SigningKey:
        """Read a key file.

        Raises:
            BadKeyError: It holds no Ed25519 key, or one that is locked by a password.
        """
        from cryptography.exceptions import UnsupportedAlgorithm
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

        try:
            key = serialization.load_pem_private_key(text, password=None)
        except (ValueError, TypeError, UnsupportedAlgorithm) as error:
            raise BadKeyError(f"it holds no key in PEM form without a password: {error}") from error
        if not isinstance(key, Ed25519PrivateKey):
            raise BadKeyError("its key is not an Ed25519 key")
        return cls(key)

    def to_pem(self) -> bytes:
        """Write it as a key file holds it."""
        from cryptography.hazmat.primitives import serialization

        return self._key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )

    @property
    def public(self) -> str:
        """The public key, in hex."""
        return self._key.public_key().public_bytes_raw().hex()

    def sign(self, statement: bytes) -> str:
        """Sign; returns the signature in hex."""
        return self._key.sign(statement).hex()


def statement(user: str, name: str, version: str, sha256: str) -> bytes:
    """Return the text to sign for a package: its owner, name and version, and the archive's SHA-256 in hex.

    None of them can hold a newline, so no two packages have the same statement.
    """
    return f"rce bundle 1\n{user}\n{name}\n{version}\n{sha256}\n".encode()


def verify(key: str, signature: str, signed: bytes) -> None:
    """Check a signature.

    Args:
        key: Public key, in hex.
        signature: In hex.
        signed: The statement.

    Raises:
        BadKeyError: It is not a public key.
        BadSignatureError: The key's owner did not sign this.
    """
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    public = Ed25519PublicKey.from_public_bytes(_key_bytes(key))
    try:
        public.verify(unhexlify(signature), signed)
    except (InvalidSignature, ValueError) as error:
        raise BadSignatureError(f"the signature does not fit the key {key_id(key)}") from error


def key_id(key: str) -> str:
    """Return the short name of a public key.

    Raises:
        BadKeyError: It is not a public key.
    """
    return hashlib.sha256(_key_bytes(key)).hexdigest()[:_ID_LENGTH]


def _key_bytes(key: str) -> bytes:
    try:
        found = unhexlify(key)
    except ValueError as error:
        raise BadKeyError(f"a public key is {2 * KEY_BYTES} hexadecimal digits") from error
    if len(found) != KEY_BYTES:
        raise BadKeyError(f"a public key is {2 * KEY_BYTES} hexadecimal digits")
    return found
