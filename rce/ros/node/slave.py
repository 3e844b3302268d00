"""The Slave API of a node: the methods that the master and other nodes call.

http://wiki.ros.org/ROS/Slave_API
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rce.ros.node.topics import Topics
from rce.ros.xmlrpc.arguments import graph_name, node_uris
from rce.ros.xmlrpc.dispatch import ERROR, FAILURE, SUCCESS, BadArgumentError, Method

Answer = tuple[int, str, Any]

NOTHING: dict[str, Any] = {
    "getBusStats": [],
    "getBusInfo": [],
    "getName": "",
    "getUri": "",
    "getMasterUri": "",
    "getPid": -1,
    "getSubscriptions": [],
    "getPublications": [],
    "requestTopic": [],
    "publisherUpdate": -1,
    "paramUpdate": -1,
}
"""The value in a failed answer of each method: of the expected type, as rospy's."""


@dataclass(slots=True)
class SlaveApi:
    """Answers for one node."""

    name: str
    """The node's global name."""
    uri: Callable[[], str]
    """This API's own URI."""
    topics: Topics
    master_uri: str
    tcpros_address: Callable[[], tuple[str, int]]
    """The address that subscribers connect to."""
    on_shutdown: Callable[[str], None]
    """Takes the reason for which the node is told to stop."""
    on_parameter: Callable[[str, Any], bool]
    """Takes a parameter's name and new value; returns whether the node subscribed to it."""

    def methods(self) -> dict[str, Method]:
        """Return the method table: the specification's, and the two that rospy's nodes have beside."""
        return {
            "getName": lambda _caller: (SUCCESS, "", self.name),
            "getUri": lambda _caller: (SUCCESS, "", self.uri()),
            "getBusStats": self._get_bus_stats,
            "getBusInfo": self._get_bus_info,
            "getMasterUri": self._get_master_uri,
            "getPid": self._get_pid,
            "getSubscriptions": self._get_subscriptions,
            "getPublications": self._get_publications,
            "requestTopic": self._request_topic,
            "publisherUpdate": self._publisher_update,
            "paramUpdate": self._param_update,
            "shutdown": self._shutdown,
        }

    def _request_topic(self, caller: str, topic: Any, protocols: Any) -> Answer:
        name = graph_name("topic", topic, caller)
        is_list = isinstance(protocols, list) and all(isinstance(protocol, list) for protocol in protocols)
        if not protocols or not (is_list or isinstance(protocols, str)):
            raise BadArgumentError('parameter [protocols] must be a list of lists such as ["TCPROS"]')
        if name not in self.topics.outputs:
            return ERROR, f"Not a publisher of [{name}]", []
        if any(protocol[:1] == ["TCPROS"] for protocol in protocols):
            host, port = self.tcpros_address()
            return SUCCESS, f"ready on {host}:{port}", ["TCPROS", host, port]
        return FAILURE, "TCPROS is the only protocol here", []

    def _publisher_update(self, caller: str, topic: Any, publishers: Any) -> Answer:
        source = self.topics.inputs.get(graph_name("topic", topic, caller))
        uris = node_uris("publishers", publishers)
        if source is not None:
            source.take_update(uris)
        return SUCCESS, "", 0

    def _param_update(self, _caller: str, key: Any, value: Any) -> Answer:
        if not isinstance(key, str) or not key:
            raise BadArgumentError("parameter [key] must be a non-empty string")
        if not self.on_parameter(key, value):
            return ERROR, f"not subscribed to {key}", 0  # the master then forgets the subscription
        return SUCCESS, "", 0

    def _shutdown(self, caller: str, reason: Any = "") -> Answer:
        self.on_shutdown(f"{caller} asked for it: {reason}")
        return SUCCESS, "shutdown", 0

    def _get_master_uri(self, _caller: str) -> Answer:
        return SUCCESS, "", self.master_uri

    def _get_pid(self, _caller: str) -> Answer:
        return SUCCESS, "", os.getpid()

    def _get_subscriptions(self, _caller: str) -> Answer:
        return (
            SUCCESS,
            "subscriptions",
            [[topic, source.message_type_name] for topic, source in self.topics.inputs.items()],
        )

    def _get_publications(self, _caller: str) -> Answer:
        return (
            SUCCESS,
            "publications",
            [[topic, output.message_type_name] for topic, output in self.topics.outputs.items()],
        )

    def _get_bus_stats(self, _caller: str) -> Answer:
        return SUCCESS, "bus stats", [self.topics.publish_stats(), self.topics.subscribe_stats(), []]

    def _get_bus_info(self, _caller: str) -> Answer:
        return SUCCESS, "bus info", self.topics.bus_info()
