"""The header by which a stand-by tells the leading master who sent a request that it forwards. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rce.config import Secret

HEADER = "RCE-Forwarded"
"""``ADDRESS TERM PROOF``, of the client and of the leader to whom the request is sent."""
PURPOSE = "forwarded requests"
"""Of the proof."""


class ForwardingKey:
    """Signs and checks the header.

    Who reads it on a connection without TLS can use its address in other requests of the same term; they
    could use the request's token too.

    Args:
        secret: The engine's, which may change.
    """

    def __init__(self, secret: Secret) -> None:
        self._secret = secret

    def sign(self, address: str, term: int) -> str:
        """Return the header's value.

        Args:
            address: Of the client; may be empty.
            term: The leader's.
        """
        signed = f"{address or '-'} {term}"
        return f"{signed} {self._secret.sign(PURPOSE, signed)}"

    def read(self, value: str, term: int) -> str | None:
        """Return the client's address, or None if no stand-by wrote the value for this term."""
        signed, _, proof = value.rpartition(" ")
        if not self._secret.has_signed(PURPOSE, signed, proof):
            return None
        address, _, of = signed.partition(" ")
        if of != str(term):
            return None
        return "" if address == "-" else address
