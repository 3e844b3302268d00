"""The header by which a stand-by tells the leading master who sent a request that it forwards. Pure."""

from __future__ import annotations

import hmac

HEADER = "RCE-Forwarded"
"""``ADDRESS TERM MAC``, of the client and of the leader to whom the request is sent."""
PURPOSE = "forwarded requests"
"""Of the key that is derived from the engine's secret."""


class ForwardingKey:
    """Signs and checks the header.

    Who reads it on a connection without TLS can use its address in other requests of the same term; they
    could use the request's token too.

    Args:
        key: Known to the masters only.
    """

    def __init__(self, key: bytes) -> None:
        self._key = key

    def sign(self, address: str, term: int) -> str:
        """Return the header's value.

        Args:
            address: Of the client; may be empty.
            term: The leader's.
        """
        signed = f"{address or '-'} {term}"
        return f"{signed} {self._mac(signed)}"

    def read(self, value: str, term: int) -> str | None:
        """Return the client's address, or None if no stand-by wrote the value for this term."""
        signed, _, mac = value.rpartition(" ")
        if not hmac.compare_digest(self._mac(signed).encode(), mac.encode("utf-8", "surrogateescape")):
            return None
        address, _, of = signed.partition(" ")
        if of != str(term):
            return None
        return "" if address == "-" else address

    def _mac(self, text: str) -> str:
        return hmac.digest(self._key, text.encode("utf-8", "surrogateescape"), "sha256").hex()
