"""The header by which the leading master proves itself to a stand-by. Pure."""

from __future__ import annotations

import hmac

HEADER = "RCE-Master"
"""``TERM MAC``, of the method, the path with its query, and the term of the leader that asks."""
PURPOSE = "archives between masters"
"""Of the key that is derived from the engine's secret; masters of several releases use the same."""


class RequestKey:
    """Signs and checks the header.

    Who reads it on a connection without TLS can repeat the same request in the same term. It makes a stand-by
    take or remove the archive that the path names by its hash, which the leader puts right at its next look,
    or give the same records of the audit log once more.

    Args:
        key: Known to the masters only.
    """

    def __init__(self, key: bytes) -> None:
        self._key = key

    def sign(self, method: str, path: str, term: int) -> str:
        """Return the header's value."""
        return f"{term} {self._mac(method, path, str(term))}"

    def read(self, value: str, method: str, path: str) -> int | None:
        """Return the term of the leader that asks, or None if no master wrote the value for this request."""
        term, _, mac = value.partition(" ")
        expected = self._mac(method, path, term)
        if not hmac.compare_digest(expected.encode(), mac.encode("utf-8", "surrogateescape")):
            return None
        return int(term)

    def _mac(self, method: str, path: str, term: str) -> str:
        text = f"{method} {path} {term}"
        return hmac.digest(self._key, text.encode("utf-8", "surrogateescape"), "sha256").hex()
