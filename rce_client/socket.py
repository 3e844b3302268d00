"""The WebSocket of a client: all frames of a message go out together."""

from __future__ import annotations

from typing import TYPE_CHECKING

from websockets.frames import CloseCode

from rce.buffers import write_together
from rce.tls.websocket import TlsClientConnection

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce.protocol import Frame

JOIN_BELOW = 64 << 10
"""Below this many bytes a copy costs less than writing several buffers."""


class EngineSocket(TlsClientConnection):
    """A connection; made by ``websockets.asyncio.client.connect(create_connection=EngineSocket)``.

    Attributes:
        heard: Whether data came since this was last set to false.
    """

    heard = False

    def data_received(self, data: bytes) -> None:
        """Take note of the data."""
        self.heard = True
        super().data_received(data)

    async def close(self, code: CloseCode | int = CloseCode.NORMAL_CLOSURE, reason: str = "") -> None:
        """Close the connection; return when it has ended, after the close timeout at the latest."""
        # The library's time limit does not include the wait until the engine takes data.
        deadline = self.loop.call_later(self.close_timeout or 0.0, self.transport.abort)
        try:
            await super().close(code, reason)
        finally:
            deadline.cancel()

    async def send_frames(self, frames: Sequence[Frame]) -> None:
        """Send the frames of a message, and wait until the socket's buffer has room again.

        Raises:
            websockets.exceptions.ConnectionClosed: The connection ended.
        """
        async with self.send_context():
            for frame in frames:
                if isinstance(frame, str):
                    self.protocol.send_text(frame.encode())
                else:
                    self.protocol.send_binary(frame)
            chunks = self.protocol.data_to_send()
            if sum(map(len, chunks)) < JOIN_BELOW:
                self.transport.write(b"".join(chunks))
            else:
                write_together(self.transport, chunks)
