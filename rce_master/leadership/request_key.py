"""The header by which the leading master proves itself to a stand-by. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rce.config import Secret

HEADER = "RCE-Master"
"""``TERM PROOF``, of the method, the path with its query, and the term of the leader that asks."""
PURPOSE = "archives between masters"
"""Of the proof; masters of several releases use the same."""


class RequestKey:
    """Signs and checks the header.

    Who reads it on a connection without TLS can repeat the same request in the same term. It makes a stand-by
    take or remove the archive that the path names by its hash, which the leader puts right at its next look,
    or give the same records of the audit log once more.

    Args:
        secret: The engine's, which may change.
    """

    def __init__(self, secret: Secret) -> None:
        self._secret = secret

    def sign(self, method: str, path: str, term: int) -> str:
        """Return the header's value."""
        return f"{term} {self._secret.sign(PURPOSE, _signed(method, path, str(term)))}"

    def read(self, value: str, method: str, path: str) -> int | None:
        """Return the term of the leader that asks, or None if no master wrote the value for this request."""
        term, _, proof = value.partition(" ")
        return int(term) if self._secret.has_signed(PURPOSE, _signed(method, path, term), proof) else None


def _signed(method: str, path: str, term: str) -> str:
    return f"{method} {path} {term}"
