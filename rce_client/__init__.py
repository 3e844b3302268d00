"""The client side: :class:`Connection`; the bridge of ROS graphs is :mod:`rce_client.ros_bridge`."""

from rce_client.connection import Connection, State
from rce_client.exceptions import (
    CallError,
    CallTimeoutError,
    ClientError,
    InterfaceError,
    InUseError,
    LostError,
    NotConnectedError,
    RefusedError,
    UnavailableError,
    UntrustedError,
)
from rce_client.own_interfaces import Json, Serialized
from rce_client.services import ServiceClient, ServiceProvider
from rce_client.topics import Publisher, Subscriber

__all__ = [
    "CallError",
    "CallTimeoutError",
    "ClientError",
    "Connection",
    "InUseError",
    "InterfaceError",
    "Json",
    "LostError",
    "NotConnectedError",
    "Publisher",
    "RefusedError",
    "Serialized",
    "ServiceClient",
    "ServiceProvider",
    "State",
    "Subscriber",
    "UnavailableError",
    "UntrustedError",
]
