"""ROS 1 message and service types: definitions, checksums, serialization.

>>> from rce.ros.types import TypeRegistry
>>> string = TypeRegistry().message("std_msgs/String")
>>> string.serialize(string.new(data="hello"))
b'\\x05\\x00\\x00\\x00hello'
"""

from rce.ros.types.exceptions import BadDefinition, SerializationError, TypesError, UnknownType
from rce.ros.types.message import Buffer, Field, Message, MessageType, ServiceType
from rce.ros.types.registry import TypeRegistry
from rce.ros.types.values import Duration, Time

__all__ = [
    "BadDefinition",
    "Buffer",
    "Duration",
    "Field",
    "Message",
    "MessageType",
    "SerializationError",
    "ServiceType",
    "Time",
    "TypeRegistry",
    "TypesError",
    "UnknownType",
]
