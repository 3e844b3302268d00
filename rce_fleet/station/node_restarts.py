"""Restarts the operator's nodes when they end: a fleet without its planner stands still. Pure."""

from __future__ import annotations

from typing import Any

from rce.config.client import ClientConfig
from rce.model.requests import ConfigureComponents, RemoveNode, Request

_ENDED = frozenset({"failed", "exited"})
_UP = frozenset({"running", "degraded"})


def node_requests(config: ClientConfig, engine: dict[str, Any]) -> list[Request]:
    """Return the requests to the engine that make all nodes of ``config`` run.

    A node that ended is removed first; once the engine does not report it any more, it is added again.

    Args:
        config: The operator's config.
        engine: The engine's state, as :class:`~rce_fleet.station.engine_watch.EngineWatch` reports it.
    """
    requests: list[Request] = []
    for container in engine.get("containers", ()):
        if container["state"] not in _UP:
            continue
        states = {node["tag"]: node["state"] for node in container["nodes"]}
        for add in config.nodes:
            if add.container != container["tag"]:
                continue
            if add.node.tag not in states:
                requests.append(ConfigureComponents(add_nodes=(add,)))
            elif states[add.node.tag] in _ENDED:
                remove = RemoveNode(container=add.container, tag=add.node.tag)
                requests.append(ConfigureComponents(remove_nodes=(remove,)))
    return requests
