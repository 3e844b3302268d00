"""The ROS core: master and parameter server. ``async with Core(port=11311) as core: core.uri``."""

from rce.ros.core.events import Change, GraphEvent
from rce.ros.core.graph import Graph
from rce.ros.core.server import Core, GraphWatch

__all__ = ["Change", "Core", "Graph", "GraphEvent", "GraphWatch"]
