"""A graph with our core or with a real one, programs of a real ROS at it, and a compiled roscpp node."""

from __future__ import annotations

import subprocess
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Unpack

import pytest
from support.ros_nodes import MakeGraphNode, NodeOptions
from support.ros_real import GRAPHS, Graph, our_graph

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
def roscpp_peer(tmp_path_factory: pytest.TempPathFactory) -> tuple[str]:
    """How to start the roscpp node ``/roscpp_peer``; compiled once."""
    return (compiled("roscpp_peer", tmp_path_factory),)


@pytest.fixture(scope="session")
def roscpp_library(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The program that uses what roscpp's client library has; compiled once."""
    return compiled("roscpp_library", tmp_path_factory)


def compiled(name: str, folders: pytest.TempPathFactory) -> str:
    """Compile a program of this folder against roscpp."""
    program = folders.mktemp("roscpp") / name
    flags = subprocess.run(
        ["pkg-config", "--cflags", "--libs", "roscpp"], capture_output=True, text=True, check=True
    ).stdout.split()
    source = SOURCES / f"{name}.cpp"
    subprocess.run(
        ["g++", "-O0", "-pthread", "-o", str(program), str(source), *flags], check=True, timeout=240
    )
    return str(program)
