"""The client side: :class:`Connection`; the bridge of ROS graphs is :mod:`rce_client.ros_bridge`."""

from rce_client.connection import Connection, State
from rce_client.ends import Publisher, ServiceClient, ServiceProvider, Subscriber
from rce_client.exceptions import (
    CallError,
    CallTimeoutError,
    ClientError,
    InterfaceError,
    LostError,
    NotConnectedError,
    RefusedError,
    UnavailableError,
)

__all__ = [
    "CallError",
    "CallTimeoutError",
    "ClientError",
    "Connection",
    "InterfaceError",
    "LostError",
    "NotConnectedError",
    "Publisher",
    "RefusedError",
    "ServiceClient",
    "ServiceProvider",
    "State",
    "Subscriber",
    "UnavailableError",
]
