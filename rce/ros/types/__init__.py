"""ROS 1 message and service types: definitions, checksums, serialization.

::

    types = TypeRegistry(PackageIndex(["/opt/robots"]))
    string = types.message("std_msgs/String")
    data = string.serialize(string.new(data="hello"))
    assert string.deserialize(data).data == "hello"
    echo = types.service("Test/StringEcho")  # echo.request, echo.response, echo.md5sum
"""

from rce.ros.types.exceptions import BadDefinitionError, SerializationError, TypesError, UnknownTypeError
from rce.ros.types.fields import Buffer, Field
from rce.ros.types.message import MessageType, ServiceType
from rce.ros.types.registry import TypeRegistry
from rce.ros.types.values import Duration, Message, Time

__all__ = [
    "BadDefinitionError",
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
    "UnknownTypeError",
]
