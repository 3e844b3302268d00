"""Sends snapshots of volumes to the master (:mod:`rce.control.snapshots`)."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, TypeVar

import msgspec
from websockets.exceptions import WebSocketException

from rce.control import SnapshotError
from rce.control.snapshots import MAX_MANIFEST, UPLOADS, Kept, Offer, Wanted
from rce.tls import CertificateError, explain_to_client

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from websockets.asyncio.client import ClientConnection

    from rce.control_channel.dialing import Dialer

T = TypeVar("T")

ANSWER_S = 60.0
"""How long the master may take to keep a content, on a slow disk and at other masters."""
_AHEAD = 8
"""Contents that are sent before the first of them is answered."""


class Upload:
    """An upload that is under way.

    Args:
        master: The connection.
        wanted: The hashes of what the master lacks, in hex.
    """

    def __init__(self, master: ClientConnection, wanted: frozenset[str]) -> None:
        self.wanted = wanted
        self._master = master
        self._unanswered = 0

    async def send(self, data: bytes) -> None:
        """Send a content; it may be on its way when this returns.

        Raises:
            SnapshotError: The master did not keep this one, or one before it.
        """
        await self._master.send(data)
        self._unanswered += 1
        if self._unanswered >= _AHEAD:
            await self._receive_answer()

    async def finish(self) -> None:
        """Wait until the master has all that was sent on its disk.

        Raises:
            SnapshotError: It does not.
        """
        while self._unanswered:
            await self._receive_answer()

    async def _receive_answer(self) -> None:
        answer = await _receive(self._master, Kept)
        self._unanswered -= 1
        if answer.error:
            raise SnapshotError(answer.error)


class Uploader:
    """Sends snapshots.

    Args:
        dialer: Connects to the master.
    """

    def __init__(self, dialer: Dialer) -> None:
        self._dialer = dialer

    @contextlib.asynccontextmanager
    async def upload(self, offer: Offer) -> AsyncIterator[Upload]:
        """Begin to send a snapshot. Cancelling closes the connection.

        Raises:
            SnapshotError: The master cannot be reached, or does not take it; also from within the block.
        """
        try:
            async with self._dialer.connect(UPLOADS, MAX_MANIFEST) as master:
                await master.send(msgspec.json.encode(offer).decode())
                answer = await _receive(master, Wanted)
                if answer.error:
                    raise SnapshotError(answer.error)
                yield Upload(master, frozenset(answer.contents))
        except (OSError, WebSocketException, CertificateError) as error:  # a time-out is an OSError
            why = explain_to_client(error) or str(error) or "no answer in time"
            text = f"the master does not take the snapshot: {why}"
            raise SnapshotError(text, is_temporary=True) from error


async def _receive(master: ClientConnection, kind: type[T]) -> T:
    async with asyncio.timeout(ANSWER_S):
        text = await master.recv()
    try:
        return msgspec.json.decode(text, type=kind)
    except msgspec.MsgspecError as error:
        raise SnapshotError(f"the master's answer cannot be read: {error}") from error
