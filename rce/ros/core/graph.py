"""The state of a ROS graph, and the outcome of each operation on it. Pure: no I/O, no clock.

Every operation that changes something returns an :class:`Outcome`: the calls that the core must make to
nodes, and the events for watchers of the graph.
"""

from __future__ import annotations

from typing import Any

from rce.ros.core.events import Call, Change, GraphEvent, Outcome
from rce.ros.core.parameters import UNSET, ParameterTree, affected
from rce.ros.core.registrations import Kind, Registrations
from rce.ros.names import SEPARATOR, canonical

ANY_TYPE = "*"

_ADDED = {
    Kind.PUBLISHER: Change.PUBLISHER_ADDED,
    Kind.SUBSCRIBER: Change.SUBSCRIBER_ADDED,
    Kind.SERVICE: Change.SERVICE_ADDED,
}
_REMOVED = {
    Kind.PUBLISHER: Change.PUBLISHER_REMOVED,
    Kind.SUBSCRIBER: Change.SUBSCRIBER_REMOVED,
    Kind.SERVICE: Change.SERVICE_REMOVED,
}


class Graph:
    """Nodes, topics, services and parameters of one core. All names are global ones."""

    def __init__(self) -> None:
        self._registrations = Registrations()
        self._parameters = ParameterTree()
        self._types: dict[str, str] = {}

    # Questions

    @property
    def nodes(self) -> dict[str, str]:
        """Known nodes and their slave APIs."""
        return {name: entry.uri for name, entry in self._registrations.nodes.items()}

    def node(self, name: str) -> str | None:
        """Return the slave API of a node; None if it is not known."""
        entry = self._registrations.nodes.get(name)
        return None if entry is None else entry.uri

    @property
    def topic_types(self) -> dict[str, str]:
        """Topics in use with known types, and ``*`` for those whose publishers did not give one."""
        return dict(self._types)

    def publishers(self, topic: str) -> dict[str, str]:
        """Return the publishing nodes of a topic and their slave APIs."""
        return dict(self._registrations.of(Kind.PUBLISHER, topic))

    def subscribers(self, topic: str) -> dict[str, str]:
        """Return the subscribed nodes of a topic and their slave APIs."""
        return dict(self._registrations.of(Kind.SUBSCRIBER, topic))

    def service(self, name: str) -> str | None:
        """Return the ``rosrpc`` URI of a service's provider."""
        return next(iter(self._registrations.of(Kind.SERVICE, name).values()), None)

    def published(self, namespace: str = "") -> list[list[str]]:
        """Return ``[[topic, type], ...]`` of what is published below ``namespace`` (``/ns/``)."""
        topics = self._registrations.names(Kind.PUBLISHER)
        return [[topic, self._types.get(topic, ANY_TYPE)] for topic in topics if topic.startswith(namespace)]

    def system_state(self) -> list[list[list[object]]]:
        """Return publishers, subscribers and services, each as ``[[name, [node, ...]], ...]``."""
        return [self._registrations.state(kind) for kind in (Kind.PUBLISHER, Kind.SUBSCRIBER, Kind.SERVICE)]

    @property
    def parameters(self) -> ParameterTree:
        """The parameters; to be changed by :meth:`set_parameter` and :meth:`delete_parameter` only."""
        return self._parameters

    # Topics and services

    def register_publisher(self, topic: str, topic_type: str, node: str, uri: str) -> Outcome:
        """Note that a node publishes; the topic's subscribers are told."""
        outcome = self._displace(node, uri)
        if topic_type != ANY_TYPE or topic not in self._types:
            self._types[topic] = topic_type
        self._add(Kind.PUBLISHER, topic, node, uri, None, outcome)
        self._tell_subscribers(topic, outcome)
        return outcome

    def register_subscriber(self, topic: str, topic_type: str, node: str, uri: str) -> Outcome:
        """Note that a node subscribes; it learns the publishers from the answer, not by a call."""
        outcome = self._displace(node, uri)
        if topic_type != ANY_TYPE and topic not in self._types:
            self._types[topic] = topic_type
        self._add(Kind.SUBSCRIBER, topic, node, uri, None, outcome)
        return outcome

    def register_service(self, service: str, service_uri: str, node: str, uri: str) -> Outcome:
        """Note that a node provides a service, in place of the previous provider."""
        outcome = self._displace(node, uri)
        for other in list(self._registrations.of(Kind.SERVICE, service)):
            if other != node:
                self._remove(Kind.SERVICE, service, other, outcome)
        self._add(Kind.SERVICE, service, node, uri, service_uri, outcome)
        return outcome

    def unregister(self, kind: Kind, name: str, node: str, uri: str) -> tuple[bool, Outcome]:
        """Remove a registration; return whether it was there with this ``uri``."""
        outcome = Outcome.empty()
        if self._registrations.of(kind, name).get(node) != uri:
            return False, outcome
        self._remove(kind, name, node, outcome)
        return True, outcome

    def forget_node(self, node: str) -> Outcome:
        """Remove all registrations of a node."""
        outcome = Outcome.empty()
        entry = self._registrations.nodes.get(node)
        if entry is not None:
            for kind, name in sorted(entry.held, key=lambda held: (held[0].value, held[1])):
                self._remove(kind, name, node, outcome)
        return outcome

    # Parameters

    def set_parameter(self, name: str, value: Any, *, by: str = "") -> Outcome:
        """Set a parameter or namespace; its subscribers are told, but not the node ``by`` that did it."""
        self._parameters.set(name, value)
        return self._tell_of_parameter(name, besides=by)

    def delete_parameter(self, name: str) -> Outcome:
        """Delete a parameter or namespace.

        Raises:
            KeyError: It is not set.
        """
        self._parameters.delete(name)
        return self._tell_of_parameter(name)

    def subscribe_parameter(self, name: str, node: str, uri: str) -> tuple[Any, Outcome]:
        """Subscribe a node to a parameter's changes; return its present value."""
        outcome = self._displace(node, uri)
        self._add(Kind.PARAMETER, name, node, uri, None, outcome)
        return self._value(name), outcome

    def drop_parameter_subscription(self, uri: str, name: str) -> Outcome:
        """Note that the node at ``uri`` does not know of its subscription to exactly ``name``."""
        outcome = Outcome.empty()
        name = canonical(name)
        for node, known in list(self._registrations.of(Kind.PARAMETER, name).items()):
            if known == uri:
                self._remove(Kind.PARAMETER, name, node, outcome)
        return outcome

    def validate(self) -> None:
        """Check the invariants; for tests."""
        self._registrations.validate()
        for topic in self._types:
            assert self._is_used(topic), f"the type of {topic} is kept although it is unused"

    # Inside

    def _displace(self, node: str, uri: str) -> Outcome:
        """Remove and shut down an older node of the same name."""
        entry = self._registrations.nodes.get(node)
        if entry is None or entry.uri == uri:
            return Outcome.empty()
        outcome = self.forget_node(node)
        outcome.calls.append(Call(entry.uri, "shutdown", (f"a new node registered with the name {node}",)))
        return outcome

    def _add(self, kind: Kind, name: str, node: str, uri: str, value: str | None, outcome: Outcome) -> None:
        if node not in self._registrations.nodes:
            outcome.events.append(GraphEvent(Change.NODE_APPEARED, node))
        if self._registrations.add(kind, name, node, uri, value) and kind in _ADDED:
            outcome.events.append(GraphEvent(_ADDED[kind], node, name))

    def _remove(self, kind: Kind, name: str, node: str, outcome: Outcome) -> None:
        if not self._registrations.remove(kind, name, node):
            return
        if kind in _REMOVED:
            outcome.events.append(GraphEvent(_REMOVED[kind], node, name))
        if kind is Kind.PUBLISHER:
            self._tell_subscribers(name, outcome)
        if kind in (Kind.PUBLISHER, Kind.SUBSCRIBER) and not self._is_used(name):
            self._types.pop(name, None)
        if kind is not Kind.PARAMETER:
            self._drop_parameter_subscriptions(node)
        if node not in self._registrations.nodes:
            outcome.events.append(GraphEvent(Change.NODE_VANISHED, node))

    def _drop_parameter_subscriptions(self, node: str) -> None:
        """Remove a node's subscriptions with its last topic or service: rospy does not when it leaves."""
        entry = self._registrations.nodes.get(node)
        if entry is not None and all(kind is Kind.PARAMETER for kind, _ in entry.held):
            for kind, name in list(entry.held):
                self._registrations.remove(kind, name, node)

    def _is_used(self, topic: str) -> bool:
        return any(self._registrations.of(kind, topic) for kind in (Kind.PUBLISHER, Kind.SUBSCRIBER))

    def _tell_subscribers(self, topic: str, outcome: Outcome) -> None:
        publishers = list(self._registrations.of(Kind.PUBLISHER, topic).values())
        arguments = (topic, publishers)  # one object for all: it is written once
        for uri in self._registrations.of(Kind.SUBSCRIBER, topic).values():
            outcome.calls.append(Call(uri, "publisherUpdate", arguments))

    def _tell_of_parameter(self, name: str, besides: str = "") -> Outcome:
        outcome = Outcome.empty()
        for subscription, reported in affected(self._registrations.names(Kind.PARAMETER), name):
            value = self._value(reported)
            knows = besides if reported == name else ""  # the caller learns the changed parts
            arguments = (reported.rstrip(SEPARATOR) + SEPARATOR, value)  # as all masters write it
            for node, uri in self._registrations.of(Kind.PARAMETER, subscription).items():
                if node != knows:
                    outcome.calls.append(Call(uri, "paramUpdate", arguments))
        return outcome

    def _value(self, name: str) -> Any:
        try:
            return self._parameters.get(name)
        except KeyError:
            return UNSET
