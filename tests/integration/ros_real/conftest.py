"""A graph with our core or with a real one, programs of a real ROS at it, and a compiled roscpp node."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path
from typing import Unpack

import pytest
from support.ros_nodes import MakeGraphNode, NodeOptions
from support.ros_real import GRAPHS, Graph, our_graph
from support.roscpp_programs import compiled

from rce.ros.node import Node

SOURCES = Path(__file__).parent / "programs"


@pytest.fixture
async def ours(tmp_path: Path) -> AsyncIterator[Graph]:
    """A graph with our core."""
    async with our_graph(tmp_path) as graph:
        yield graph


@pytest.fixture(params=["ours", "roscore"])
async def graph(request: pytest.FixtureRequest, tmp_path: Path) -> AsyncIterator[Graph]:
    """A graph with our core and one with a real core, one after the other."""
    async with GRAPHS[request.param](tmp_path) as graph:
        yield graph


@pytest.fixture
def make_node() -> MakeGraphNode:
    """Nodes of ours: ``make_node(graph, "name")``."""

    def make(graph: Graph, name: str, **options: Unpack[NodeOptions]) -> Node:
        options.setdefault("argv", [])
        return Node(name, master_uri=graph.uri, signals=False, **options)

    return make


@pytest.fixture
def rospy_peer() -> tuple[str, str]:
    """How to start the rospy node ``/rospy_peer``."""
    return "/usr/bin/python3", str(SOURCES / "rospy_peer.py")


@pytest.fixture(scope="session")
def roscpp_peer() -> tuple[str]:
    """How to start the roscpp node ``/roscpp_peer``."""
    return (str(compiled(SOURCES / "roscpp_peer.cpp", "roscpp")),)


@pytest.fixture(scope="session")
def roscpp_library() -> str:
    """The program that uses what roscpp's client library has."""
    return str(compiled(SOURCES / "roscpp_library.cpp", "roscpp"))
