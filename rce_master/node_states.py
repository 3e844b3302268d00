"""Answers container task sets that fetch and bring snapshots of nodes' states."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncIterator
from typing import TYPE_CHECKING

import msgspec
from websockets.exceptions import ConnectionClosed

from rce.aio.tasks import finish
from rce.control import NODE_STATES, ControlError
from rce.control.node_states import (
    PIECE,
    Answer,
    Fetch,
    Found,
    Keep,
    Kept,
    Ready,
    Refusal,
    encode,
    read_question,
)
from rce.model import MAX_STATE, EndpointId
from rce_master.exceptions import FencedError, MasterError
from rce_master.state import commands, saved_states
from rce_master.state.volume_records import SavedState

if TYPE_CHECKING:
    from collections.abc import Callable

    from websockets.asyncio.server import ServerConnection

    from rce_master.leadership import Fence
    from rce_master.packages.keeper import ContentKeeper
    from rce_master.reconciler import Reconciler
    from rce_master.state_service import StateService

_log = logging.getLogger(__name__)

QUESTION_S = 10.0
"""Seconds that a task set may take to ask."""
TRANSFER_S = 30.0
"""Seconds that a snapshot may take on its way."""
AT_ONCE = 16
"""Snapshots that are brought or fetched at the same time; others wait."""


class NodeStateServer:
    """Keeps the newest snapshot of each node.

    Args:
        state_service: Keeps their records.
        keeper: Keeps their contents.
        reconciler: Knows the connected task sets.
        fence: Tells whether this master leads, if there may be others.
        clock: Seconds since 1970.
    """

    def __init__(
        self,
        state_service: StateService,
        keeper: ContentKeeper,
        reconciler: Reconciler,
        fence: Fence | None = None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._state_service = state_service
        self._keeper = keeper
        self._reconciler = reconciler
        self._fence = fence
        self._clock = clock
        self._turns = asyncio.Semaphore(AT_ONCE)

    async def serve(self, socket: ServerConnection) -> None:
        """Answer a connection of a task set."""
        try:
            async with asyncio.timeout(QUESTION_S):
                question = read_question(await socket.recv())
            if isinstance(question, Fetch):
                await self._before_a_move(question)
            async with self._turns, asyncio.timeout(TRANSFER_S):
                await self._answer(socket, question)
        except TimeoutError:
            _log.warning("a snapshot at %s is given up: it takes too long", socket.remote_address)
        except (msgspec.MsgspecError, UnicodeError) as error:
            _log.warning("garbage instead of a snapshot from %s: %s", socket.remote_address, error)
        except FencedError as error:
            _log.info("a snapshot is not answered: %s", error)
        except ConnectionClosed as error:
            _log.debug("the connection of a snapshot ended: %s", error)
        await socket.close()

    async def _answer(self, socket: ServerConnection, question: Fetch | Keep) -> None:
        try:
            if isinstance(question, Fetch):
                await self._give(socket, question)
            else:
                await self._take(socket, question)
        except FencedError:
            raise
        except MasterError as error:
            await self._say(socket, Refusal(reason=str(error)))

    async def _say(self, socket: ServerConnection, answer: Answer) -> None:
        """Send an answer, unless another master may lead by now."""
        if self._fence is not None:
            self._fence.check()
        await socket.send(encode(answer).decode())

    # Keeping

    async def _take(self, socket: ServerConnection, question: Keep) -> None:
        service = self._state_service
        state = self._record(question)
        saved_states.check(service.tables, service.state.settings, state)
        await self._say(socket, Ready())
        async with self._keeper.store.receive(_pieces(socket, question.size)) as incoming:
            if incoming.sha256 != question.sha256:
                await self._say(socket, Refusal(reason="it was changed on its way"))
                return
            async with self._keeper.keep(incoming):
                # To its end: contents that the state is about to name must not be removed.
                await finish(service.submit(commands.SaveState(state=state)))
        await self._say(socket, Kept())

    def _record(self, question: Keep) -> SavedState:
        return SavedState(
            container=question.id,
            node=question.node,
            process=question.process,
            incarnation=question.incarnation,
            number=question.number,
            size=question.size,
            sha256=question.sha256,
            taken=self._clock(),
        )

    # Fetching

    async def _give(self, socket: ServerConnection, question: Fetch) -> None:
        await self._state_service.settled()
        tables = self._state_service.tables
        state = saved_states.find(tables, question.process, question.id, question.node)
        if state is None:
            await self._say(socket, Found())
            return
        try:
            piece = await self._keeper.read(state.sha256, 0, MAX_STATE)
        except OSError as error:
            await self._say(socket, Refusal(reason=f"the master lacks it: {error.strerror or error}"))
            return
        if piece is None:
            await self._say(socket, Refusal(reason="the master lacks it; rce state remove gives it up"))
            return
        data, _ = piece
        await self._say(socket, Found(size=len(data), sha256=state.sha256))
        for start in range(0, len(data), PIECE):
            await socket.send(data[start : start + PIECE])

    async def _before_a_move(self, question: Fetch) -> None:
        """Have the container that is handed over save the state once more, for its copy."""
        tables = self._state_service.tables
        if not saved_states.is_moving_to(tables, question.id, question.process):
            return
        try:
            peer = self._reconciler.task_set_of(question.id)
            if NODE_STATES not in peer.features:
                return
            error = await peer.save_state(question.id, question.node)
        except (MasterError, ControlError) as refusal:
            error = str(refusal)
        if error:
            await self._tell(question, f"moves with the state that was saved before: {error}")

    async def _tell(self, question: Fetch, what: str) -> None:
        """Tell the user about a node."""
        _log.warning("%s/%s %s", question.id, question.node, what)
        tag = EndpointId.parse(question.id).tag
        fault = commands.FaultReported(id=question.id, text=f"container {tag}: node {question.node} {what}")
        try:
            await self._state_service.submit(fault)
        except FencedError:
            raise
        except MasterError as refusal:  # the user was removed meanwhile, or the disk is full
            _log.debug("%s is not told: %s", question.id, refusal)


async def _pieces(socket: ServerConnection, size: int) -> AsyncIterator[bytes]:
    """Receive a snapshot of a size."""
    while size > 0:
        piece = await socket.recv()
        if not isinstance(piece, bytes) or not 0 < len(piece) <= size:
            await socket.close(1007, "not a piece of the snapshot")
            raise msgspec.DecodeError("not a piece of the snapshot")
        size -= len(piece)
        yield piece
