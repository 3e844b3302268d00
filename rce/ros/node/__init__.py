"""Nodes of a ROS graph in asyncio: ``async with Node("talker") as node: ...``."""

from rce.ros.node.node import Node
from rce.ros.node.publisher import Publisher
from rce.ros.node.running import run
from rce.ros.node.service import Service
from rce.ros.node.service_client import ServiceClient
from rce.ros.node.subscriber import Subscriber
from rce.ros.node.timing import Rate, Timer, TimerEvent

__all__ = [
    "Node",
    "Publisher",
    "Rate",
    "Service",
    "ServiceClient",
    "Subscriber",
    "Timer",
    "TimerEvent",
    "run",
]
