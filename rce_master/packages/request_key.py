"""Where a stand-by takes archives, and the header by which the leading master proves itself there. Pure."""

from __future__ import annotations

import hmac

PATH = "/archives"
SNAPSHOTS_PATH = "/snapshots"
"""The same for parts of snapshots of volumes."""
HEADER = "RCE-Master"
"""``TERM MAC``, of the method, the path and the term of the leader that asks."""
PURPOSE = "archives between masters"
"""Of the key that is derived from the engine's secret."""


class RequestKey:
    """Signs and checks the header.

    Who reads it on a connection without TLS can repeat the same request in the same term. It makes a stand-by
    take or remove the archive that the path names by its hash; the leader puts that right at its next look.

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
