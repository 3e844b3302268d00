"""The data plane: endpoints, joined by links that carry the messages of many connections."""

from rce.link.endpoint import Endpoint
from rce.link.exceptions import (
    CallError,
    CallTimeout,
    InterfaceError,
    LinkError,
    LinkLost,
    LinkRefused,
    MessageTooLarge,
    NotConnected,
    Overloaded,
    PeerFault,
    PeerLost,
    ProtocolError,
)
from rce.link.hub import LinkHub
from rce.link.interface import Buffer, Interface, InterfaceFactory, Port
from rce.link.settings import LinkLimits, LinkTimeouts

__all__ = [
    "Buffer",
    "CallError",
    "CallTimeout",
    "Endpoint",
    "Interface",
    "InterfaceError",
    "InterfaceFactory",
    "LinkError",
    "LinkHub",
    "LinkLimits",
    "LinkLost",
    "LinkRefused",
    "LinkTimeouts",
    "MessageTooLarge",
    "NotConnected",
    "Overloaded",
    "PeerFault",
    "PeerLost",
    "Port",
    "ProtocolError",
]
