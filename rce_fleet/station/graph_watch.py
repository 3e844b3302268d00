"""Watches the nodes of a ROS graph, for the page of a station without an engine."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from rce.ros.errors import MasterError
from rce.ros.node.master import MasterClient
from rce.ros.xmlrpc import RpcClient

POLL_S = 1.0
CALLER = "/operator_station"


class GraphWatch:
    """Polls the nodes of a ROS graph.

    Args:
        master_uri: The graph's master.
        on_state: Called with each new state of the graph; with ``{"error": text}`` if it cannot be read.
    """

    def __init__(self, master_uri: str, *, on_state: Callable[[dict[str, Any]], None]) -> None:
        self._uri = master_uri
        self._on_state = on_state
        self._last: dict[str, Any] = {}

    async def run(self) -> None:
        """Watch until cancelled."""
        async with RpcClient() as rpc:
            master = MasterClient(self._uri, CALLER, "", rpc)
            while True:
                try:
                    state = graph_state(self._uri, await master.call("getSystemState"))
                except MasterError as error:
                    state = {"error": f"the ROS master cannot be reached: {error}"}
                if state != self._last:
                    self._last = state
                    self._on_state(state)
                await asyncio.sleep(POLL_S)


def graph_state(uri: str, system_state: Any) -> dict[str, Any]:
    """Return a graph in the form that the page shows.

    Args:
        uri: The graph's master.
        system_state: What the Master API's ``getSystemState`` returns.
    """
    kinds = ("publishes", "subscribes", "serves")
    nodes: dict[str, dict[str, int]] = {}
    for kind, entries in zip(kinds, system_state, strict=True):
        for _, names in entries:
            for name in names:
                counts = nodes.setdefault(name, dict.fromkeys(kinds, 0))
                counts[kind] += 1
    return {"graph": {"uri": uri, "nodes": [{"name": name, **nodes[name]} for name in sorted(nodes)]}}
