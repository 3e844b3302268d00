"""The snapshots of a container's nodes: joins the nodes' states with the manager, which keeps them."""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING, assert_never

from rce.aio.tasks import BackgroundTasks
from rce_container.environment import messages as m
from rce_container.environment.nodes.states import NodeStates
from rce_container.environment.vault import ManagerVault

if TYPE_CHECKING:
    from rce_container.environment.channel import Channel
    from rce_container.environment.graph import Graph
    from rce_container.environment.managers import Managers


class NodeStateKeeper:
    """Snapshots of all nodes of a container.

    Args:
        graph: The container's graph.
        managers: Connects to the manager.

    Attributes:
        states: Restores and saves the nodes.
        vault: Asks the manager.
    """

    def __init__(self, graph: Graph, managers: Managers) -> None:
        self.vault = ManagerVault(managers.send)
        self.states = NodeStates(graph, self.vault)
        self._orders = BackgroundTasks()

    def handle(self, channel: Channel, message: m.SaveState | m.OpenState | m.StateDone) -> None:
        """Handle a message of the manager.

        Raises:
            ChannelError: A descriptor that belongs to it is missing.
        """
        match message:
            case m.OpenState(request=request, empty=empty):
                self.vault.opened(request, None if empty else socket.socket(fileno=channel.take_fd()))
            case m.StateDone(request=request, error=error):
                self.vault.answered(request, error)
            case m.SaveState(request=request, node=node):
                if not self._orders.closed:
                    self._orders.spawn(self._save(channel, request, node), name=f"snapshot of {node}")
            case _:
                assert_never(message)

    async def close(self) -> None:
        """Stop saving on request."""
        await self._orders.close()

    async def _save(self, channel: Channel, request: int, node: str) -> None:
        error = await self.states.save_now(node)
        channel.send(m.encode(m.StateSaved(request=request, error=error)))
