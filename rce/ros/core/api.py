"""The Master API and the Parameter Server API: check arguments, query the graph, format the answers.

http://wiki.ros.org/ROS/Master_API, http://wiki.ros.org/ROS/Parameter%20Server%20API
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any
from xmlrpc.client import MAXINT, MININT

from rce.ros import names
from rce.ros.core.events import Outcome
from rce.ros.core.graph import ANY_TYPE, Graph
from rce.ros.core.registrations import Kind
from rce.ros.xmlrpc.arguments import graph_name
from rce.ros.xmlrpc.codec import MAX_DEPTH
from rce.ros.xmlrpc.dispatch import ERROR, FAILURE, SUCCESS, BadArgumentError, Method

Answer = tuple[int, str, Any]

MAX_NESTING = MAX_DEPTH // 4 - 2
"""Levels of namespaces, dictionaries and lists: the answer with all parameters must be readable too."""

NOTHING: dict[str, Any] = {
    "getUri": "",
    "getPid": -1,
    "registerPublisher": [],
    "registerSubscriber": [],
    "lookupNode": "",
    "lookupService": "",
    "getTopicTypes": [],
    "getSystemState": [[], [], []],
    "hasParam": False,
    "getParamNames": [],
}
"""The value in a failed answer of each method: of the expected type, as rosmaster's."""


class MasterApi:
    """The methods of a core. Parameters, answers and their wording are those of rosmaster."""

    def __init__(
        self,
        graph: Graph,
        uri: Callable[[], str],
        perform: Callable[[Outcome], None],
        on_shutdown: Callable[[str], None] | None = None,
    ) -> None:
        """Wire the API.

        Args:
            graph: The state.
            uri: Returns the core's own URI.
            perform: Takes the outcome of an operation.
            on_shutdown: Takes the reason when the core is told to end; without it, that is refused.
        """
        self._graph = graph
        self._uri = uri
        self._perform = perform
        self._on_shutdown = on_shutdown

    def methods(self) -> dict[str, Method]:
        """Return the method table."""
        return {
            "getUri": self._get_uri,
            "getPid": self._get_pid,
            "shutdown": self._shutdown,
            "registerPublisher": self._register_publisher,
            "unregisterPublisher": self._unregister_publisher,
            "registerSubscriber": self._register_subscriber,
            "unregisterSubscriber": self._unregister_subscriber,
            "registerService": self._register_service,
            "unregisterService": self._unregister_service,
            "lookupNode": self._lookup_node,
            "lookupService": self._lookup_service,
            "getPublishedTopics": self._get_published_topics,
            "getTopicTypes": self._get_topic_types,
            "getSystemState": self._get_system_state,
            "setParam": self._set_param,
            "getParam": self._get_param,
            "deleteParam": self._delete_param,
            "hasParam": self._has_param,
            "searchParam": self._search_param,
            "subscribeParam": self._subscribe_param,
            "unsubscribeParam": self._unsubscribe_param,
            "getParamNames": self._get_param_names,
        }

    # The core itself

    def _get_uri(self, _caller: str) -> Answer:
        return SUCCESS, "", self._uri()

    def _get_pid(self, _caller: str) -> Answer:
        return SUCCESS, "", os.getpid()

    def _shutdown(self, caller: str, reason: Any) -> Answer:
        if self._on_shutdown is None:
            return ERROR, "this core ends with the program that runs it", 0
        self._on_shutdown(f"{caller} asked for it: {reason}")
        return SUCCESS, "shutdown", 0

    # Registrations

    def _register_publisher(self, caller: str, topic: Any, topic_type: Any, uri: Any) -> Answer:
        topic = graph_name("topic", topic, caller)
        kind, uri = _type(topic_type), _uri("caller_api", uri)
        self._perform(self._graph.register_publisher(topic, kind, caller, uri))
        subscribers = list(self._graph.subscribers(topic).values())
        return SUCCESS, f"Registered [{caller}] as publisher of [{topic}]", subscribers

    def _register_subscriber(self, caller: str, topic: Any, topic_type: Any, uri: Any) -> Answer:
        topic = graph_name("topic", topic, caller)
        kind, uri = _type(topic_type), _uri("caller_api", uri)
        self._perform(self._graph.register_subscriber(topic, kind, caller, uri))
        return SUCCESS, f"Subscribed to [{topic}]", list(self._graph.publishers(topic).values())

    def _register_service(self, caller: str, service: Any, service_uri: Any, uri: Any) -> Answer:
        service = graph_name("service", service, caller)
        service_uri = _uri("service_api", service_uri)
        self._perform(self._graph.register_service(service, service_uri, caller, _uri("caller_api", uri)))
        return SUCCESS, f"Registered [{caller}] as provider of [{service}]", 1

    def _unregister_publisher(self, caller: str, topic: Any, uri: Any) -> Answer:
        topic = graph_name("topic", topic, caller)
        return self._unregister(Kind.PUBLISHER, topic, caller, _uri("caller_api", uri))

    def _unregister_subscriber(self, caller: str, topic: Any, uri: Any) -> Answer:
        topic = graph_name("topic", topic, caller)
        return self._unregister(Kind.SUBSCRIBER, topic, caller, _uri("caller_api", uri))

    def _unregister_service(self, caller: str, service: Any, service_uri: Any) -> Answer:
        service = graph_name("service", service, caller)
        return self._unregister(Kind.SERVICE, service, caller, _uri("service_api", service_uri))

    def _unregister(self, kind: Kind, name: str, caller: str, uri: str) -> Answer:
        if self._graph.node(caller) is None:
            return SUCCESS, f"[{caller}] is not a registered node", 0
        was_there, outcome = self._graph.unregister(kind, name, caller, uri)
        self._perform(outcome)
        if was_there:
            return SUCCESS, f"Unregistered [{caller}] as provider of [{name}]", 1
        if kind is Kind.SERVICE:
            return SUCCESS, f"[{uri}] is no longer the current service api handle for [{name}]", 0
        return SUCCESS, f"[{caller}] is not a known provider of [{name}]", 0

    # Questions

    def _lookup_node(self, caller: str, node: Any) -> Answer:
        node = graph_name("node", node, caller)
        uri = self._graph.node(node)
        return (SUCCESS, "node api", uri) if uri else (ERROR, f"unknown node [{node}]", "")

    def _lookup_service(self, caller: str, service: Any) -> Answer:
        uri = self._graph.service(graph_name("service", service, caller))
        return (SUCCESS, f"rosrpc URI: [{uri}]", uri) if uri else (ERROR, "no provider", "")

    def _get_published_topics(self, caller: str, namespace: Any) -> Answer:
        if not isinstance(namespace, str):
            raise BadArgumentError("parameter [subgraph] must be a string")
        below = (
            names.resolve(namespace, caller).rstrip(names.SEPARATOR) + names.SEPARATOR if namespace else ""
        )
        return SUCCESS, "current topics", self._graph.published(below)

    def _get_topic_types(self, _caller: str) -> Answer:
        return SUCCESS, "current system state", [list(pair) for pair in self._graph.topic_types.items()]

    def _get_system_state(self, _caller: str) -> Answer:
        return SUCCESS, "current system state", self._graph.system_state()

    # Parameters

    def _set_param(self, caller: str, key: Any, value: Any) -> Answer:
        name = _key(key, caller)
        _check_value(value, len(names.segments(name)))
        self._perform(self._graph.set_parameter(name, value, by=caller))
        return SUCCESS, f"parameter {name} set", 0

    def _get_param(self, caller: str, key: Any) -> Answer:
        name = _key(key, caller)
        try:
            return SUCCESS, f"Parameter [{name}]", self._graph.parameters.get(name)
        except KeyError:
            return ERROR, f"Parameter [{name}] is not set", 0

    def _delete_param(self, caller: str, key: Any) -> Answer:
        name = _key(key, caller)
        try:
            self._perform(self._graph.delete_parameter(name))
        except KeyError:
            return ERROR, f"parameter [{name}] is not set", 0
        return SUCCESS, f"parameter {name} deleted", 0

    def _has_param(self, caller: str, key: Any) -> Answer:
        name = _key(key, caller)
        return SUCCESS, name, self._graph.parameters.has(name)

    def _search_param(self, caller: str, key: Any) -> Answer:
        _key(key, caller)
        if names.is_private(key) or not names.is_global(caller):
            return FAILURE, "relative names are searched, from a node's global name upwards", 0
        found = self._graph.parameters.search(names.canonical(caller), key)
        if found is None:
            return ERROR, f"Cannot find parameter [{key}] in an upwards search", ""
        return SUCCESS, f"Found [{found}]", found

    def _subscribe_param(self, caller: str, uri: Any, key: Any) -> Answer:
        name = _key(key, caller)
        value, outcome = self._graph.subscribe_parameter(name, caller, _uri("caller_api", uri))
        self._perform(outcome)
        return SUCCESS, f"Subscribed to parameter [{name}]", value

    def _unsubscribe_param(self, caller: str, uri: Any, key: Any) -> Answer:
        name = _key(key, caller)
        _, outcome = self._graph.unregister(Kind.PARAMETER, name, caller, _uri("caller_api", uri))
        self._perform(outcome)
        return SUCCESS, f"Unsubscribe to parameter [{name}]", 1

    def _get_param_names(self, _caller: str) -> Answer:
        return SUCCESS, "Parameter names", self._graph.parameters.all_names()


def _key(value: Any, caller: str) -> str:
    if not isinstance(value, str) or not value:
        raise BadArgumentError("parameter [key] must be a non-empty string")
    return names.resolve(value, caller)


def _type(value: Any) -> str:
    if value == ANY_TYPE:
        return ANY_TYPE
    if not isinstance(value, str) or value.count("/") != 1:
        raise BadArgumentError(f"parameter [topic_type] is not of the form package/Type: {value!r}")
    return value


def _uri(role: str, value: Any) -> str:
    if not isinstance(value, str) or not value.startswith(("http://", "rosrpc://")):
        raise BadArgumentError(
            f"parameter [{role}] is not a URI of the form http://host:port or rosrpc://host:port"
        )
    return value


def _check_value(value: Any, depth: int) -> None:
    """Check that all clients can read a value, alone and with its namespaces.

    Args:
        value: Of a parameter, or a part of one.
        depth: In how many namespaces and values it is.

    Raises:
        BadArgumentError: It is or holds XML-RPC's extensions ``nil`` or ``i8``, or is nested too deep.
    """
    if depth > MAX_NESTING:
        raise BadArgumentError(f"parameter [value] is nested deeper than {MAX_NESTING} levels")
    if isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            _check_value(part, depth + 1)
    elif value is None:
        raise BadArgumentError("parameter [value] must be specified, and hold no nil")
    elif isinstance(value, int) and not MININT <= value <= MAXINT:
        raise BadArgumentError("parameter [value] must not hold integers beyond 32 bits")


def roslaunch_methods() -> dict[str, Method]:
    """Return the methods for tools that expect a ``roslaunch`` process, as ``roscore`` is one.

    Tools find the address in the parameters below ``/roslaunch/uris`` and ask there for the processes that
    were started. A core starts none. These methods take no caller's name.
    """
    return {
        "get_pid": lambda: (SUCCESS, str(os.getpid()), os.getpid()),
        "get_node_names": lambda: (SUCCESS, "node names", []),
        "list_processes": lambda: (SUCCESS, "processes on parent machine", [[], []]),
        "list_children": lambda: (SUCCESS, "roslaunch children", []),
        "process_info": lambda _name: (ERROR, "no process by that name", {}),
    }
