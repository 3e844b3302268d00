"""Snapshots of nodes' states: carried between environments and the master, which keeps them.

An environment cannot be trusted: the size and rate of its snapshots are limited here, and the master decides
whether its container may save at all.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import socket
import sys
from itertools import count
from typing import TYPE_CHECKING, Protocol

from rce.aio.tasks import BackgroundTasks
from rce.control import NODE_STATES, NodeStateError
from rce.control.node_states import Fetch, Keep
from rce.guard import CrowdedError, Turns
from rce.model import MAX_STATE, EndpointId
from rce_container import intake
from rce_container.environment import messages as m

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from rce.control_channel.node_states import NodeStateClient
    from rce_container.environment.channel import Channel

_log = logging.getLogger(__name__)

_AT_ONCE = 4
_OF_ONE_USER = 2
_MAX_WAITING = 256
_OF_ONE_CONTAINER = 64
"""Snapshots that one container may have under way."""
_TRANSFER_S = 30.0
"""Seconds that an environment may take to give or take a snapshot."""
_SAVE_S = 15.0
"""Seconds that an environment may take to save a node's state on request."""
_ORDERS_AT_ONCE = 64
_ORDERS_OF_ONE_USER = 32
"""Saves on request; others wait, so that no more snapshots are under way than are carried in time."""
_ALL_S = 30.0
"""Seconds in which the states of all nodes of a machine are saved at its end; nodes that hang take longer."""
_ENDED = "its container ended"
_CHUNK = 1 << 18
SIZE_BYTES = 8
"""A snapshot to an environment begins with its size."""


class StateCarrier:
    """Carries the snapshots of all containers of a machine.

    Args:
        process: The task set's name.
        client: Talks to the master; None: snapshots are not kept.
    """

    def __init__(self, process: str, client: NodeStateClient | None) -> None:
        self._process = process
        self._client = client
        self._turns = Turns(_AT_ONCE, waiting=_MAX_WAITING, each=_OF_ONE_USER)
        self.orders = Turns(_ORDERS_AT_ONCE, waiting=sys.maxsize, each=_ORDERS_OF_ONE_USER)
        """Of saves on request."""
        self._features: frozenset[str] | None = None
        """Of the master; None while there is none."""

    def learn(self, features: Collection[str] | None) -> None:
        """Note the features of the master; None: it is away."""
        self._features = None if features is None else frozenset(features)

    async def fetch(self, id_: str, node: str) -> bytes | None:
        """Return the newest snapshot of a node; None if there is none.

        Raises:
            NodeStateError: It cannot be told now.
        """
        if self._client is None or (self._features is not None and NODE_STATES not in self._features):
            return None
        question = Fetch(process=self._process, id=id_, node=node)
        try:
            async with self._turns.turn(EndpointId.parse(id_).user):
                return await self._there().fetch(question, MAX_STATE)
        except CrowdedError:
            raise NodeStateError("too many snapshots are carried on this machine just now") from None

    async def keep(self, question: Keep, state: bytes) -> None:
        """Have a snapshot kept; when this returns, it is acknowledged.

        Raises:
            NodeStateError: It is not kept, or that is not known.
        """
        try:
            async with self._turns.turn(EndpointId.parse(question.id).user):
                await self._there().keep(question, state)
        except CrowdedError:
            raise NodeStateError("too many snapshots are carried on this machine just now") from None

    def question(self, id_: str, incarnation: str, said: m.StateOffered, state: bytes) -> Keep:
        """Return the question whether the master keeps a snapshot."""
        return Keep(
            process=self._process,
            id=id_,
            node=said.node,
            incarnation=incarnation,
            number=said.request,
            size=len(state),
            sha256=hashlib.sha256(state).hexdigest(),
        )

    def _there(self) -> NodeStateClient:
        if self._client is None or self._features is None:
            raise NodeStateError("no master is connected")
        if NODE_STATES not in self._features:
            raise NodeStateError("the master is of an earlier release, which keeps no snapshots")
        return self._client


class ContainerStates:
    """The snapshots of one incarnation of a container.

    Args:
        id_: Endpoint id of the container.
        incarnation_id: Names the incarnation.
        carrier: Carries them.
    """

    def __init__(self, id_: str, incarnation_id: str, carrier: StateCarrier) -> None:
        self._id = id_
        self._incarnation_id = incarnation_id
        self._carrier = carrier
        self._tasks = BackgroundTasks()
        self._pace = intake.Pace()
        self._numbers = count(1)
        self._orders: dict[int, asyncio.Future[str]] = {}

    def handle(self, channel: Channel, said: m.StateWanted | m.StateOffered | m.StateSaved) -> None:
        """Handle a message of the environment."""
        if isinstance(said, m.StateSaved):
            order = self._orders.get(said.request)
            if order is not None and not order.done():
                order.set_result(intake.sanitize_text(said.error))
            return
        fault = intake.state_fault(said)
        if len(self._tasks) >= _OF_ONE_CONTAINER:
            fault = f"the container has {_OF_ONE_CONTAINER} snapshots under way already"
        if fault:
            channel.send(m.encode(m.StateDone(request=said.request, error=fault)))
        elif not self._tasks.closed:
            self._tasks.spawn(self._answer(channel, said), name=f"snapshot of {self._id}/{said.node}")

    async def save(self, channel: Channel, node: str) -> str:
        """Have the environment save a node's state now.

        Returns:
            Why it is not saved; empty if the snapshot is acknowledged.
        """
        async with self._carrier.orders.turn(EndpointId.parse(self._id).user):
            if self._tasks.closed:
                return _ENDED
            return await self._order(channel, node)

    async def _order(self, channel: Channel, node: str) -> str:
        number = next(self._numbers)
        order: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._orders[number] = order
        try:
            channel.send(m.encode(m.SaveState(request=number, node=node)))
            async with asyncio.timeout(_SAVE_S):
                return await order
        except TimeoutError:
            return f"it did not answer within {_SAVE_S:.0f} s"
        finally:
            del self._orders[number]

    async def close(self) -> None:
        """Stop carrying."""
        for order in self._orders.values():
            if not order.done():
                order.set_result(_ENDED)
        await self._tasks.close()

    async def _answer(self, channel: Channel, said: m.StateWanted | m.StateOffered) -> None:
        error = ""
        try:
            if isinstance(said, m.StateWanted):
                await self._give(channel, said)
                return
            await self._take(channel, said)
        except TimeoutError:
            error = f"it was not carried within {_TRANSFER_S:.0f} s"
        except (NodeStateError, OSError) as failure:
            error = str(failure)
        channel.send(m.encode(m.StateDone(request=said.request, error=error)))

    async def _give(self, channel: Channel, said: m.StateWanted) -> None:
        """Fetch the newest snapshot for the environment."""
        state = await self._carrier.fetch(self._id, said.node)
        if state is None:
            channel.send(m.encode(m.OpenState(request=said.request, empty=True)))
            return
        ours, theirs = socket.socketpair()
        with ours:
            with theirs:
                channel.send(m.encode(m.OpenState(request=said.request)), theirs.fileno())
            ours.setblocking(False)
            async with asyncio.timeout(_TRANSFER_S):
                loop = asyncio.get_running_loop()
                await loop.sock_sendall(ours, len(state).to_bytes(SIZE_BYTES, "big"))
                await loop.sock_sendall(ours, state)

    async def _take(self, channel: Channel, said: m.StateOffered) -> None:
        """Take a snapshot from the environment, and have the master keep it."""
        self._pace.pay(intake.PER_STATE + said.size)
        if pause := self._pace.pause:
            await asyncio.sleep(pause)
        state = await _collect(channel, said)
        question = await asyncio.to_thread(
            self._carrier.question, self._id, self._incarnation_id, said, state
        )
        await self._carrier.keep(question, state)


class Savable(Protocol):
    """A container with nodes."""

    async def save_states(self) -> None:
        """Save the states of its nodes."""


async def save_all(containers: Iterable[Savable]) -> None:
    """Save the states of all containers' nodes, as far as there is time for it before the machine ends."""
    try:
        async with asyncio.timeout(_ALL_S):
            await asyncio.gather(*(one.save_states() for one in containers))
    except TimeoutError:
        _log.warning("some states of nodes are not saved: that takes longer than %.0f s", _ALL_S)


async def _collect(channel: Channel, said: m.StateOffered) -> bytes:
    """Read a snapshot of the size that was told."""
    ours, theirs = socket.socketpair()
    state = bytearray()
    with ours:
        with theirs:
            channel.send(m.encode(m.OpenState(request=said.request)), theirs.fileno())
        ours.setblocking(False)
        async with asyncio.timeout(_TRANSFER_S):
            loop = asyncio.get_running_loop()
            while piece := await loop.sock_recv(ours, _CHUNK):
                state += piece
                if len(state) > said.size:
                    raise NodeStateError("it is larger than was said")
    if len(state) != said.size:
        raise NodeStateError("it came in part only")
    return bytes(state)
