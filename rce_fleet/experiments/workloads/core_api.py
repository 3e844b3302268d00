"""The master API of a ROS core, and the slave API of its nodes, by the standard library.

http://wiki.ros.org/ROS/Master_API, http://wiki.ros.org/ROS/Slave_API
"""

from __future__ import annotations

import os
import xmlrpc.client
from http.client import HTTPConnection
from typing import Any

TIMEOUT_S = 3.0
END_S = 30.0
"""How long a node may take to answer that it ends, on a busy machine too."""


class CoreApi:
    """Calls the core.

    Args:
        caller: Name by which it calls.
        uri: Of the core; if empty, that of the environment.
    """

    def __init__(self, caller: str, uri: str = "") -> None:
        self._caller = caller
        self._uri = uri or os.environ["ROS_MASTER_URI"]

    def published_topics(self) -> list[str]:
        """Return the names of all topics that are published."""
        return [topic for topic, _ in self._call(self._uri, "getPublishedTopics", "")]

    def nodes(self) -> list[str]:
        """Return the names of all nodes that publish, subscribe or provide."""
        state = self._call(self._uri, "getSystemState")
        return sorted({node for part in state for _, nodes in part for node in nodes})

    def parameters(self) -> list[str]:
        """Return the names of all parameters."""
        return list(self._call(self._uri, "getParamNames"))

    def set_parameter(self, name: str, value: Any) -> None:
        """Set a parameter."""
        self._call(self._uri, "setParam", name, value)

    def answers(self) -> bool:
        """Return whether the core answers."""
        try:
            self._call(self._uri, "getPid")
        except OSError:
            return False
        return True

    def end_node(self, name: str) -> bool:
        """Tell a node to end, as ``rosnode kill`` does; return whether it was told.

        Raises:
            OSError, xmlrpc.client.Error: The core does not answer.
            TimeoutError: The node neither answers nor refuses: the run says nothing, and must be done again.
        """
        uri = self._call(self._uri, "lookupNode", name)
        try:
            self._call(uri, "shutdown", "an experiment", timeout=END_S)
        except TimeoutError:
            raise
        except OSError:
            return False
        return True

    def _call(self, uri: str, method: str, *arguments: Any, timeout: float = TIMEOUT_S) -> Any:
        with xmlrpc.client.ServerProxy(uri, transport=_Transport(timeout)) as core:
            code, text, value = getattr(core, method)(self._caller, *arguments)
        if code != 1:
            raise OSError(f"{method}: {text}")
        return value


class _Transport(xmlrpc.client.Transport):
    """Gives up after some seconds."""

    def __init__(self, timeout: float) -> None:
        super().__init__()
        self._timeout = timeout

    def make_connection(self, host: Any) -> HTTPConnection:
        """Return a connection to a host."""
        connection: HTTPConnection = super().make_connection(host)
        connection.timeout = self._timeout
        return connection
