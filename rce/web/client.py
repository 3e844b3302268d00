"""Connectors of the engine's HTTP clients."""

from __future__ import annotations

import socket
from types import SimpleNamespace
from typing import TYPE_CHECKING

import aiohttp
from aiohttp.abc import AbstractResolver, ResolveResult

from rce.lookups import LOOKUPS

if TYPE_CHECKING:
    import ssl

UPLOAD_S = 300.0
"""Seconds to wait for an answer to an upload, which the server checks and copies first."""


class NameResolver(AbstractResolver):
    """Looks host names up without delaying the program's end (:mod:`rce.lookups`)."""

    async def resolve(
        self, host: str, port: int = 0, family: socket.AddressFamily = socket.AF_INET
    ) -> list[ResolveResult]:
        """Return the addresses of a host.

        Raises:
            OSError: The name cannot be resolved.
        """
        infos = await LOOKUPS.addresses(host, port, family=family, flags=socket.AI_ADDRCONFIG)
        return [
            ResolveResult(
                hostname=host,
                host=_text(family_, address),
                port=port,
                family=family_,
                proto=protocol,
                flags=socket.AI_NUMERICHOST | socket.AI_NUMERICSERV,
            )
            for family_, _, protocol, _, address in infos
        ]

    async def close(self) -> None:
        """Do nothing: lookups belong to the program."""


class Sent:
    """Notes whether a request was sent. It may be so even if no connection could be made at last.

    aiohttp repeats DELETE and PUT once, by itself, if the connection is lost before the answer.

    Attributes:
        times: How often some of the request may have arrived.
    """

    def __init__(self) -> None:
        self.times = 0

    @property
    def begun(self) -> bool:
        """Whether some of the request may have arrived."""
        return self.times > 0


def noting_sent() -> aiohttp.TraceConfig:
    """Return a trace for a session whose requests have a :class:`Sent` as ``trace_request_ctx``."""

    async def note(_: aiohttp.ClientSession, context: SimpleNamespace, __: object) -> None:
        if isinstance(context.trace_request_ctx, Sent):
            context.trace_request_ctx.times += 1

    trace = aiohttp.TraceConfig()
    trace.on_request_headers_sent.append(note)
    return trace


def session_connector(tls: ssl.SSLContext | None) -> aiohttp.TCPConnector:
    """Return the connector for an ``aiohttp.ClientSession``, which closes it.

    Args:
        tls: Checks servers; None for the authorities that the system trusts.
    """
    return aiohttp.TCPConnector(ssl=True if tls is None else tls, resolver=NameResolver())


def _text(family: int, address: tuple[str, int] | tuple[str, int, int, int]) -> str:
    """Write an address; a link-local one with its interface."""
    if family == socket.AF_INET6 and len(address) == 4 and address[3] and "%" not in address[0]:  # noqa: PLR2004
        return f"{address[0]}%{address[3]}"
    return address[0]
