"""The data plane: endpoints, joined by links that carry the messages of many connections."""

from rce.link.endpoint import Endpoint
from rce.link.exceptions import (
    CallError,
    CallTimeoutError,
    InterfaceError,
    LinkError,
    LinkLostError,
    LinkRefusedError,
    MessageTooLargeError,
    NotConnectedError,
    OverloadedError,
    PeerFaultError,
    PeerLostError,
    ProtocolError,
)
from rce.link.hub import LinkHub
from rce.link.interface import Buffer, Interface, InterfaceFactory, Port
from rce.link.settings import LinkLimits, LinkTimeouts

__all__ = [
    "Buffer",
    "CallError",
    "CallTimeoutError",
    "Endpoint",
    "Interface",
    "InterfaceError",
    "InterfaceFactory",
    "LinkError",
    "LinkHub",
    "LinkLimits",
    "LinkLostError",
    "LinkRefusedError",
    "LinkTimeouts",
    "MessageTooLargeError",
    "NotConnectedError",
    "OverloadedError",
    "PeerFaultError",
    "PeerLostError",
    "Port",
    "ProtocolError",
]
