"""WebSocket servers that answer in TLS."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection

    from rce.tls.gate import TlsGate


def behind_gate(kind: type[ServerConnection], gate: TlsGate | None) -> Any:
    """Return what makes connections of a kind, for ``serve(create_connection=...)``; no gate, no TLS."""
    if gate is None:
        return kind

    def make(*args: Any, **options: Any) -> Any:
        return gate.guard(kind(*args, **options))

    return make
