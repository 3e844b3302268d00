"""Prevents pages of other sites from using a server through their visitor's browser."""

from __future__ import annotations

import ipaddress
import re
import socket
from collections.abc import Callable, Collection, Iterable

_HOST = re.compile(r"(?:\[(?P<v6>[0-9A-Fa-f:.]+)\]|(?P<name>[^:@\[\]\s/]+))(?::(?P<port>[0-9]{1,5}))?")
_ORIGIN = re.compile(r"(?P<scheme>https?)://(?P<authority>[^/?#]+)", re.IGNORECASE)
_DEFAULT_PORTS = {"http": "80", "https": "443"}


def is_foreign(origin: str | None, host: str, allowed: Collection[str] = ()) -> bool:
    """Return whether a request comes from a page of another site.

    A browser leaves out the port of ``Origin`` and ``Host`` where it is the scheme's own (80, 443). A server
    behind a proxy does not know the scheme of its pages, so it is taken from the origin.

    Args:
        origin: The request's ``Origin``; most programs that are not browsers send none.
        host: The request's ``Host``.
        allowed: Origins that may use the server nevertheless.
    """
    if origin is None or origin in allowed:
        return False
    found = _ORIGIN.fullmatch(origin)
    if found is None:
        return True
    port = _DEFAULT_PORTS[found["scheme"].lower()]
    page = _address(found["authority"], port)
    return page is None or page != _address(host, port)


def _address(authority: str, default_port: str) -> tuple[str, str] | None:
    """Return host and port of an authority; None if it is not one."""
    found = _HOST.fullmatch(authority)
    if found is None:
        return None
    return (found["v6"] or found["name"]).lower(), found["port"] or default_port


def host_of(authority: str) -> str:
    """Return the host of a ``Host`` header, in lower case; empty if it has none."""
    found = _HOST.fullmatch(authority)
    return "" if found is None else (found["v6"] or found["name"]).lower().rstrip(".")


class ServerNames:
    """The names by which a server may be asked for.

    A page whose own name is made to lead to this server (DNS rebinding) is of the same origin as the server,
    as far as its browser can tell: ``Origin`` fits ``Host``, or is left out. But ``Host`` holds the page's
    name, which no server here has. An address as ``Host`` is always accepted: nothing can make an address
    lead elsewhere, and a server behind address translation does not know its own.

    Example::

        names = ServerNames("0.0.0.0", ["cloud.example.org"])
        names.refusal("evil.example:9000")  # a text that says what to do
        names.refusal("cloud.example.org")  # None

    Args:
        bind: The address or name that the server listens on.
        public: Further names that its operator gave it.
        certified: Returns the names in its certificate, in lower case.
    """

    def __init__(
        self,
        bind: str = "",
        public: Iterable[str] = (),
        certified: Callable[[], Collection[str]] = frozenset,
    ) -> None:
        self._certified = certified
        machine = socket.gethostname().lower()
        own = ("localhost", machine, machine.partition(".")[0], bind, *public)
        self._names = frozenset(name.lower().rstrip(".") for name in own if name)

    def __contains__(self, host: str) -> bool:
        """Return whether a ``Host`` header, with or without a port, names this server."""
        found = _HOST.fullmatch(host)
        if found is None:
            return False
        text = found["v6"] or found["name"]
        try:
            ipaddress.ip_address(text)
        except ValueError:
            name = text.lower().rstrip(".")
            return found["v6"] is None and (name in self._names or name in self._certified())
        return True

    def refusal(self, host: str) -> str | None:
        """Return why a request for ``host`` is not served, and what to do; None if it is."""
        if host in self:
            return None
        name = host[:100] or "(empty)"
        return (
            f"this server does not know the name {name!r}; use its address or host name, or let its operator"
            " add the name (--public-name)"
        )
