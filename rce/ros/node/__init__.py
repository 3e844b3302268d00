"""Nodes of a ROS graph in asyncio: ``async with Node("talker") as node: ...``."""

from rce.ros.errors import MasterError, NodeClosedError, RosError, ServiceError, ServiceFaultError
from rce.ros.node.node import Node
from rce.ros.node.publisher import Publisher
from rce.ros.node.running import run
from rce.ros.node.service import Service
from rce.ros.node.service_client import ServiceClient
from rce.ros.node.subscriber import Subscriber
from rce.ros.node.timing import Rate, Timer, TimerEvent
from rce.ros.types import Duration, Message, Time, TypeRegistry

__all__ = [
    "Duration",
    "MasterError",
    "Message",
    "Node",
    "NodeClosedError",
    "Publisher",
    "Rate",
    "RosError",
    "Service",
    "ServiceClient",
    "ServiceError",
    "ServiceFaultError",
    "Subscriber",
    "Time",
    "Timer",
    "TimerEvent",
    "TypeRegistry",
    "run",
]
