"""The client address of a request that came through proxies (pure)."""

from __future__ import annotations

import ipaddress
from typing import TYPE_CHECKING

from rce.guard.lobby import address_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    Network = ipaddress.IPv4Network | ipaddress.IPv6Network


class TrustedProxies:
    """Reads ``X-Forwarded-For``, which only a proxy that is trusted may write.

    Each proxy adds, at the end, the address that it was reached from. So the last address that is not a
    trusted proxy's is the client; addresses before it are claims of the client and are ignored.

    Args:
        networks: The proxies, as addresses or networks (``10.0.0.0/8``).

    Raises:
        ValueError: A value is neither.
    """

    def __init__(self, networks: Iterable[str] = ()) -> None:
        self._networks: list[Network] = [ipaddress.ip_network(text, strict=False) for text in networks]

    def origin(self, peer: object, forwarded: Iterable[str] = ()) -> str:
        """Return the address that a request counts for.

        Args:
            peer: The connected peer, as :meth:`socket.socket.getpeername` returns it.
            forwarded: The values of all ``X-Forwarded-For``, in their order.

        Returns:
            An address, as :func:`rce.guard.lobby.address_of` writes it.
        """
        claimed = [word.strip() for value in forwarded for word in value.split(",")]
        found = str(peer[0]) if isinstance(peer, tuple) and peer else ""
        while claimed and self._trusts(found):
            word = claimed.pop()
            if _address(word) is None:
                break
            found = word
        return address_of((found,)) if found else ""

    def _trusts(self, text: str) -> bool:
        address = _address(text)
        return address is not None and any(
            address.version == network.version and address in network for network in self._networks
        )


def _address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        address = ipaddress.ip_address(text.partition("%")[0])
    except ValueError:
        return None
    mapped = address.ipv4_mapped if address.version == 6 else None  # noqa: PLR2004 - the protocol's number
    return mapped or address
