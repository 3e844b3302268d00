"""What fixtures that make nodes give: a function that makes one of a name, at the master of the test."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypedDict, Unpack

from rce.ros.node import Node
from rce.ros.types import TypeRegistry
from support.ros_real import Graph


class NodeOptions(TypedDict, total=False):
    """Keywords of :class:`rce.ros.node.Node` that tests give."""

    namespace: str
    argv: Sequence[str]
    types: TypeRegistry
    master_timeout: float | None
    intra_process: bool
    rosout: bool


class MakeNode(Protocol):
    """Makes a node at the core of the test: ``make_node("a")``."""

    def __call__(self, name: str, **options: Unpack[NodeOptions]) -> Node:
        """Make a node; it starts when it is entered."""


class MakeGraphNode(Protocol):
    """Makes a node of ours in a graph of real nodes: ``make_node(graph, "a")``."""

    def __call__(self, graph: Graph, name: str, **options: Unpack[NodeOptions]) -> Node:
        """Make a node; it starts when it is entered."""
