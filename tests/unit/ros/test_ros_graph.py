"""The core's state: registrations, parameters, what follows from each operation."""

from __future__ import annotations

import time
from typing import Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from rce.ros.core import Change, Graph, GraphEvent
from rce.ros.core.api import MasterApi
from rce.ros.core.events import Call
from rce.ros.core.registrations import Kind
from rce.ros.xmlrpc.dispatch import BadArgumentError


def uri(node: str) -> str:
    return f"http://{node.strip('/')}:1/"


def test_subscribers_are_told_of_publishers() -> None:
    graph = Graph()
    assert graph.register_subscriber("/t", "a/B", "/s", uri("/s")).calls == []
    told = graph.register_publisher("/t", "a/B", "/p", uri("/p"))
    assert told.calls == [Call(uri("/s"), "publisherUpdate", ("/t", [uri("/p")]))]
    assert told.events == [
        GraphEvent(Change.NODE_APPEARED, "/p"),
        GraphEvent(Change.PUBLISHER_ADDED, "/p", "/t"),
    ]
    was_there, left = graph.unregister(Kind.PUBLISHER, "/t", "/p", uri("/p"))
    assert was_there
    assert left.calls == [Call(uri("/s"), "publisherUpdate", ("/t", []))]
    assert left.events == [
        GraphEvent(Change.PUBLISHER_REMOVED, "/p", "/t"),
        GraphEvent(Change.NODE_VANISHED, "/p"),
    ]


def test_the_first_concrete_type_counts_over_any() -> None:
    graph = Graph()
    graph.register_subscriber("/t", "*", "/s", uri("/s"))
    assert graph.topic_types == {}
    graph.register_publisher("/t", "a/B", "/p", uri("/p"))
    graph.register_publisher("/t", "*", "/q", uri("/q"))
    assert graph.topic_types == {"/t": "a/B"}


def test_a_node_of_the_same_name_displaces_the_older() -> None:
    graph = Graph()
    graph.register_publisher("/t", "a/B", "/n", "http://old:1/")
    graph.register_service("/svc", "rosrpc://old:2", "/n", "http://old:1/")
    outcome = graph.register_subscriber("/u", "a/B", "/n", "http://new:1/")
    assert [call.method for call in outcome.calls] == ["shutdown"]
    assert outcome.calls[0].uri == "http://old:1/"
    assert graph.nodes == {"/n": "http://new:1/"}
    assert graph.publishers("/t") == {}
    assert graph.service("/svc") is None


def test_the_displaced_node_cannot_unregister_the_newer() -> None:
    graph = Graph()
    graph.register_publisher("/t", "a/B", "/n", "http://old:1/")
    graph.register_publisher("/t", "a/B", "/n", "http://new:1/")
    was_there, _ = graph.unregister(Kind.PUBLISHER, "/t", "/n", "http://old:1/")
    assert not was_there
    assert graph.publishers("/t") == {"/n": "http://new:1/"}


def test_looking_up_a_node_costs_the_same_in_a_large_graph() -> None:
    """Discoveries look up all nodes every second; a fleet's core has thousands."""

    def seconds(nodes: int) -> float:
        graph = Graph()
        api = MasterApi(graph, lambda: "", lambda _: None)
        lookup = api.methods()["lookupNode"]
        for number in range(nodes):
            graph.register_publisher(f"/t{number}", "a/B", f"/n{number}", uri(f"/n{number}"))
        spent = []
        for _ in range(20):
            begin = time.perf_counter()
            for _ in range(100):
                assert lookup("/asker", "/n7")[0] == 1
            spent.append(time.perf_counter() - begin)
        return min(spent)

    assert seconds(10_000) < 20 * seconds(10)


def test_a_service_has_one_provider() -> None:
    graph = Graph()
    graph.register_service("/svc", "rosrpc://a:1", "/a", uri("/a"))
    graph.register_service("/svc", "rosrpc://b:1", "/b", uri("/b"))
    assert graph.service("/svc") == "rosrpc://b:1"
    assert graph.system_state()[2] == [["/svc", ["/b"]]]
    assert "/a" not in graph.nodes


def test_a_node_that_died_is_forgotten_whole() -> None:
    graph = Graph()
    graph.register_publisher("/t", "a/B", "/n", uri("/n"))
    graph.register_subscriber("/u", "a/B", "/n", uri("/n"))
    graph.register_service("/svc", "rosrpc://n:1", "/n", uri("/n"))
    graph.subscribe_parameter("/p", "/n", uri("/n"))
    outcome = graph.forget_node("/n")
    assert outcome.events[-1] == GraphEvent(Change.NODE_VANISHED, "/n")
    assert graph.system_state() == [[], [], []]
    assert graph.nodes == {}


def test_the_last_topic_takes_parameter_subscriptions_along() -> None:
    graph = Graph()
    graph.register_publisher("/t", "a/B", "/n", uri("/n"))
    graph.subscribe_parameter("/p", "/n", uri("/n"))
    _, outcome = graph.unregister(Kind.PUBLISHER, "/t", "/n", uri("/n"))
    assert outcome.events[-1] == GraphEvent(Change.NODE_VANISHED, "/n")
    assert graph.nodes == {}


@pytest.mark.parametrize(
    ("subscribed", "changed", "value", "told"),
    [
        ("/a/b", "/a/b", 1, ("/a/b/", 1)),
        ("/a", "/a/b", 1, ("/a/b/", 1)),
        ("/", "/a/b", 1, ("/a/b/", 1)),
        ("/a/b", "/a", {"b": 2}, ("/a/b/", 2)),
        ("/a/b", "/a", {"c": 2}, ("/a/b/", {})),
        ("/a/b", "/ab", 1, None),
        ("/ab", "/a", 1, None),
    ],
)
def test_parameter_subscribers_are_told(
    subscribed: str, changed: str, value: object, told: tuple[str, Any] | None
) -> None:
    graph = Graph()
    graph.subscribe_parameter(subscribed, "/n", uri("/n"))
    outcome = graph.set_parameter(changed, value)
    assert [call.arguments for call in outcome.calls] == ([told] if told else [])
    knows = (
        changed.startswith(subscribed) or not told
    )  # who sets a tree is told what that means for its parts
    assert bool(graph.set_parameter(changed, value, by="/n").calls) is not knows


def test_deleting_a_parameter_tells_so() -> None:
    graph = Graph()
    graph.set_parameter("/a/b", 1)
    graph.subscribe_parameter("/a/b", "/n", uri("/n"))
    assert graph.delete_parameter("/a").calls == [Call(uri("/n"), "paramUpdate", ("/a/b/", {}))]
    with pytest.raises(KeyError):
        graph.delete_parameter("/a")


def test_who_does_not_know_of_a_subscription_has_none() -> None:
    graph = Graph()
    for name in ("/a", "/a/b"):
        graph.subscribe_parameter(name, "/n", uri("/n"))
    graph.drop_parameter_subscription(uri("/other"), "/a/b/")
    assert len(graph.set_parameter("/a/b", 1).calls) == 2
    graph.drop_parameter_subscription(uri("/n"), "/a/b/")
    assert len(graph.set_parameter("/a/b", 2).calls) == 1
    outcome = graph.drop_parameter_subscription(uri("/n"), "/a/")
    assert outcome.events == [GraphEvent(Change.NODE_VANISHED, "/n")]
    graph.validate()


def test_parameters_are_a_tree() -> None:
    tree = Graph()
    tree.set_parameter("/a", {"b": 1, "c": {"d": 2}})
    tree.set_parameter("/a/c/e", 3)
    assert tree.parameters.get("/a") == {"b": 1, "c": {"d": 2, "e": 3}}
    assert sorted(tree.parameters.all_names()) == ["/a/b", "/a/c/d", "/a/c/e"]
    tree.set_parameter("/a/b/x", 4)
    assert tree.parameters.get("/a/b") == {"x": 4}
    tree.set_parameter("/a", 5)
    assert tree.parameters.all_names() == ["/a"]
    assert not tree.parameters.has("/a/b")
    with pytest.raises(BadArgumentError):
        tree.set_parameter("/", 5)


def test_searching_goes_upwards_by_the_first_segment() -> None:
    graph = Graph()
    graph.set_parameter("/robot", {"arm": 1})
    graph.set_parameter("/pr2/robot/base", 2)
    assert graph.parameters.search("/pr2/foo", "robot") == "/pr2/robot"
    assert graph.parameters.search("/pr2/foo", "robot/arm") == "/pr2/robot/arm"
    assert graph.parameters.search("/other/foo", "robot/arm") == "/robot/arm"
    assert graph.parameters.search("/pr2/foo", "nothing") is None
    assert graph.parameters.search("/pr2/foo", "/robot/arm") == "/robot/arm"


@pytest.mark.parametrize(
    ("method", "arguments"),
    [
        ("registerPublisher", ("", "a/B", "http://n:1/")),
        ("registerPublisher", ("t", "noslash", "http://n:1/")),
        ("registerPublisher", ("t", "a/B", "n:1")),
        ("registerPublisher", (5, "a/B", "http://n:1/")),
        ("registerSubscriber", ("http://t", "a/B", "http://n:1/")),
        ("registerService", ("s", "no uri", "http://n:1/")),
        ("registerService", ("/", "rosrpc://n:1", "http://n:1/")),
        ("getParam", ("",)),
        ("setParam", (3, 4)),
        ("lookupNode", ([],)),
        ("getPublishedTopics", (7,)),
    ],
)
def test_the_api_refuses_nonsense(method: str, arguments: tuple[Any, ...]) -> None:
    graph = Graph()
    api = MasterApi(graph, lambda: "http://core:1/", lambda outcome: None)
    with pytest.raises(BadArgumentError):
        api.methods()[method]("/n", *arguments)
    assert graph.nodes == {}


NODES = st.sampled_from(["/a", "/b", "/c"])
TOPICS = st.sampled_from(["/t", "/u"])


class GraphMachine(RuleBasedStateMachine):
    """Whatever nodes do, in whatever order: the tables agree, and subscribers know the publishers."""

    def __init__(self) -> None:
        super().__init__()
        self.graph = Graph()
        self.incarnation = dict.fromkeys(["/a", "/b", "/c"], 0)
        self.known: dict[tuple[str, str], list[str]] = {}

    def uri(self, node: str) -> str:
        return f"http://{node[1:]}:{self.incarnation[node]}/"

    def perform(self, calls: list[Call]) -> None:
        for call in calls:
            if call.method == "publisherUpdate":
                self.known[call.uri, call.arguments[0]] = call.arguments[1]

    @rule(node=NODES, topic=TOPICS)
    def publish(self, node: str, topic: str) -> None:
        self.perform(self.graph.register_publisher(topic, "a/B", node, self.uri(node)).calls)

    @rule(node=NODES, topic=TOPICS)
    def subscribe(self, node: str, topic: str) -> None:
        self.perform(self.graph.register_subscriber(topic, "*", node, self.uri(node)).calls)
        self.known[self.uri(node), topic] = list(self.graph.publishers(topic).values())

    @rule(node=NODES, name=TOPICS)
    def provide(self, node: str, name: str) -> None:
        self.perform(self.graph.register_service(name, f"rosrpc://{node[1:]}:1", node, self.uri(node)).calls)

    @rule(node=NODES, topic=TOPICS, kind=st.sampled_from([Kind.PUBLISHER, Kind.SUBSCRIBER]))
    def unregister(self, node: str, topic: str, kind: Kind) -> None:
        self.perform(self.graph.unregister(kind, topic, node, self.uri(node))[1].calls)

    @rule(node=NODES)
    def die(self, node: str) -> None:
        self.perform(self.graph.forget_node(node).calls)

    @rule(node=NODES)
    def restart(self, node: str) -> None:
        self.incarnation[node] += 1

    @invariant()
    def consistent(self) -> None:
        self.graph.validate()
        for topic in ("/t", "/u"):
            publishers = list(self.graph.publishers(topic).values())
            for subscriber in self.graph.subscribers(topic).values():
                assert self.known[subscriber, topic] == publishers


TestGraphMachine = GraphMachine.TestCase
TestGraphMachine.settings = settings(max_examples=60, stateful_step_count=30)
