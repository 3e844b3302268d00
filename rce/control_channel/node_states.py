"""A task set's connections to the master for snapshots of nodes' states (:mod:`rce.control.node_states`)."""

from __future__ import annotations

import asyncio
import hashlib
from typing import TYPE_CHECKING, TypeVar

import msgspec
from websockets.exceptions import WebSocketException

from rce.control import NodeStateError
from rce.control.node_states import (
    PATH,
    PIECE,
    Answer,
    Fetch,
    Found,
    Keep,
    Kept,
    Ready,
    Refusal,
    encode,
    read_answer,
)
from rce.tls import CertificateError, explain_to_client

if TYPE_CHECKING:
    from websockets.asyncio.client import ClientConnection

    from rce.control_channel.dialing import Dialer

A = TypeVar("A", bound=Answer)

ANSWER_S = 20.0
"""Seconds that the master may take for an answer: it waits for other masters, and for the former container of
one that moves."""
MIN_RATE = 1 << 20
"""Bytes per second of a snapshot on its way, at least."""


class NodeStateClient:
    """Fetches snapshots from the master, and has it keep them.

    Args:
        dialer: Connects to the master.
    """

    def __init__(self, dialer: Dialer) -> None:
        self._dialer = dialer

    async def fetch(self, question: Fetch, most: int) -> bytes | None:
        """Return the newest snapshot of a node's state; None if there is none.

        Args:
            question: Which node.
            most: Bytes that a snapshot may have.

        Raises:
            NodeStateError: The master is away, refuses it, or lacks it now.
        """
        try:
            async with asyncio.timeout(ANSWER_S) as limit, self._dialer.connect(PATH, PIECE) as master:
                found = await _ask(master, question, Found)
                limit.reschedule(
                    asyncio.get_running_loop().time() + ANSWER_S + min(found.size, most) / MIN_RATE
                )
                return await _receive(master, found, most) if found.sha256 else None
        except (OSError, TimeoutError, WebSocketException, CertificateError) as error:
            raise NodeStateError(_explain(error)) from error

    async def keep(self, question: Keep, state: bytes) -> None:
        """Have a snapshot kept; when this returns, it is acknowledged.

        Raises:
            NodeStateError: It is not kept, or that is not known.
        """
        try:
            async with (
                asyncio.timeout(ANSWER_S + len(state) / MIN_RATE),
                self._dialer.connect(PATH, PIECE) as master,
            ):
                await _ask(master, question, Ready)
                for start in range(0, len(state), PIECE):
                    await master.send(state[start : start + PIECE])
                _expect(await master.recv(), Kept)
        except (OSError, TimeoutError, WebSocketException, CertificateError) as error:
            raise NodeStateError(_explain(error)) from error


async def _ask(master: ClientConnection, question: Fetch | Keep, kind: type[A]) -> A:
    await master.send(encode(question).decode())
    return _expect(await master.recv(), kind)


def _expect(text: str | bytes, kind: type[A]) -> A:
    try:
        answer = read_answer(text)
    except (msgspec.MsgspecError, UnicodeError) as error:
        raise NodeStateError(f"the master answers what is not understood: {error}") from error
    if isinstance(answer, Refusal):
        raise NodeStateError(answer.reason)
    if not isinstance(answer, kind):
        raise NodeStateError(f"the master answers {type(answer).__name__}, not {kind.__name__}")
    return answer


async def _receive(master: ClientConnection, found: Found, most: int) -> bytes:
    if found.size > most:
        raise NodeStateError(f"the master has {found.size} bytes of it; at most {most} are allowed")
    state = bytearray()
    while len(state) < found.size:
        piece = await master.recv()
        if not isinstance(piece, bytes) or not piece:
            raise NodeStateError("the master sends what is not a snapshot")
        state += piece
    digest = await asyncio.to_thread(lambda: hashlib.sha256(state).hexdigest())
    if digest != found.sha256:
        raise NodeStateError("it was changed on its way, or is damaged at the master")
    return bytes(state)


def _explain(error: Exception) -> str:
    why = explain_to_client(error) or str(error) or "no answer in time"
    return f"the master does not answer: {why}"
