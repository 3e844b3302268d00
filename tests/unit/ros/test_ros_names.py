"""Graph names and remappings."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.ros import names
from rce.ros.errors import InvalidNameError

BASE = st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,8}", fullmatch=True)


@pytest.mark.parametrize(
    ("name", "resolved"),
    [("/a/b", "/a/b"), ("a", "/ns/a"), ("a/b", "/ns/a/b"), ("~a", "/ns/node/a"), ("/a/", "/a"), ("/", "/")],
)
def test_resolves_relative_to_the_node(name: str, resolved: str) -> None:
    assert names.Resolver("node", "ns").resolve(name) == resolved
    assert names.resolve(name, "/ns/node") == resolved


@pytest.mark.parametrize("namespace", ["", "/"])
def test_a_node_without_namespace_lives_at_the_root(namespace: str) -> None:
    resolver = names.Resolver("node", namespace)
    assert resolver.node_name == "/node"
    assert resolver.resolve("topic") == "/topic"


@pytest.mark.parametrize("name", ["", "a b", "1a", "a//b", "a-b", "é", "http://x"])
def test_refuses_what_is_no_name(name: str) -> None:
    with pytest.raises(InvalidNameError):
        names.Resolver("node").resolve(name)


@pytest.mark.parametrize("name", ["", "/node", "ns/node", "~node", "2node"])
def test_refuses_what_cannot_name_a_node(name: str) -> None:
    with pytest.raises(InvalidNameError):
        names.Resolver(name)


def test_remaps_after_resolving_both_sides() -> None:
    resolver = names.Resolver("node", "ns", {"in": "/out", "/global": "relative", "~private": "~other"})
    assert resolver.resolve("in") == "/out"
    assert resolver.resolve("/ns/in") == "/out"
    assert resolver.resolve("/global") == "/ns/relative"
    assert resolver.resolve("~private") == "/ns/node/other"
    assert resolver.resolve("inside") == "/ns/inside"


def test_takes_a_command_line_apart() -> None:
    found = names.parse_arguments(
        ["prog", "a:=b", "_gain:=2", "__name:=n", "__ns:=/x", "--flag", ":=odd", "c:=d:=e"]
    )
    assert found.remappings == {"a": "b", "c": "d:=e"}
    assert found.parameters == {"gain": "2"}
    assert found.specials == {"__name": "n", "__ns": "/x"}
    assert found.rest == ("prog", "--flag", ":=odd")


def test_remappings_without_a_target_are_left_out() -> None:
    """As rospy does: launch files have them where an argument is empty."""
    found = names.parse_arguments(["prog", "topic:=", "__name:=", "__ns:=", "_gain:="])
    assert found == names.Arguments({}, {}, {"gain": ""}, ("prog",))


@given(st.lists(BASE, max_size=4), BASE, st.lists(BASE, min_size=1, max_size=4))
def test_resolved_names_are_global_and_stay_as_they_are(
    namespace: list[str], node: str, name: list[str]
) -> None:
    resolver = names.Resolver(node, "/".join(namespace))
    resolved = resolver.resolve("/".join(name))
    assert names.is_graph_name(resolved)
    assert names.is_global(resolved)
    assert resolver.resolve(resolved) == resolved


@given(st.text(max_size=30))
def test_any_text_is_resolved_or_refused(text: str) -> None:
    try:
        assert names.is_global(names.Resolver("node", "ns").resolve(text))
    except InvalidNameError:
        assert not names.is_graph_name(text)
