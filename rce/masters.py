"""The addresses of an engine's masters: one or several, of which one is in use at a time. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable


_MAX_PORT = 65535


def split_addresses(text: str) -> tuple[str, ...]:
    """Return the addresses in a text that separates them by commas."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def split_port(address: str, default: int) -> tuple[str, int]:
    """Return host and port of ``HOST``, ``HOST:PORT``, ``ADDRESS`` or ``[ADDRESS]:PORT``.

    Args:
        address: The text; an IPv6 address with a port is in brackets.
        default: The port, if the text names none.

    Raises:
        ValueError: What should be a port is none.

    Example:
        >>> split_port("[::1]:8081", 8080)
        ('::1', 8081)
    """
    host, separator, port = address.rpartition(":")
    if address.startswith("["):
        host, _, rest = address[1:].partition("]")
        separator, port = rest[:1], rest[1:]
    elif ":" in host or not separator:  # an IPv6 address, or a host alone
        return address, default
    if not separator and not port:
        return host, default
    if separator != ":" or not port.isascii() or not port.isdecimal() or not 0 < int(port) <= _MAX_PORT:
        raise ValueError(f"must be HOST or HOST:PORT, found {address!r:.60}")
    return host, int(port)


class Masters:
    """Addresses of which one stays in use until it fails; then the others are used in turn.

    A connection that worked and ended does not count as a failure: its master is tried first, then others.

    Args:
        addresses: One or several; in a text they are separated by commas.

    Raises:
        ValueError: No address was given.

    Example:
        ```python
        masters = Masters("http://one:9000/,http://two:9000/")
        masters.current  # http://one:9000/
        masters.failed("http://one:9000/")
        masters.current  # http://two:9000/
        masters.worked()
        ```
    """

    def __init__(self, addresses: str | Iterable[str]) -> None:
        self.all = split_addresses(addresses) if isinstance(addresses, str) else tuple(addresses)
        if not self.all:
            raise ValueError("give the address of a master, or several, separated by commas")
        self._index = 0
        self._failures = 0
        """Of masters, since one worked."""

    def __str__(self) -> str:
        return ",".join(self.all)

    @property
    def current(self) -> str:
        """The address to use now."""
        return self.all[self._index]

    @property
    def has_others(self) -> bool:
        """Whether there is more than one address."""
        return len(self.all) > 1

    @property
    def has_untried(self) -> bool:
        """Whether another address has not failed since a master worked: a slow one need not be waited for."""
        return self._failures + 1 < len(self.all)

    @property
    def is_round_over(self) -> bool:
        """Whether all addresses failed equally often since a master worked: then a pause is due."""
        return self._failures % len(self.all) == 0

    def failed(self, address: str) -> None:
        """Switch to the next address, if ``address`` is still in use."""
        if address == self.current:
            self._index = (self._index + 1) % len(self.all)
            self._failures += 1

    def worked(self) -> None:
        """Note that the master in use does what it is asked: its address stays in use until it fails."""
        self._failures = 0
