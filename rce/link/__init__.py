"""The data plane: endpoints, joined by links that carry the messages of many connections."""

from rce.link.address import in_url, is_any, own_address
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
from rce.link.handover import HandoverReceiver, HandoverSender, LinkAcceptor
from rce.link.hub import LinkHub
from rce.link.interface import Buffer, Interface, InterfaceFactory, Port
from rce.link.listening import listen_on
from rce.link.settings import LinkLimits, LinkTimeouts
from rce.link.unix import remove_stale_sockets, socket_name

__all__ = [
    "Buffer",
    "CallError",
    "CallTimeoutError",
    "Endpoint",
    "HandoverReceiver",
    "HandoverSender",
    "Interface",
    "InterfaceError",
    "InterfaceFactory",
    "LinkAcceptor",
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
    "in_url",
    "is_any",
    "listen_on",
    "own_address",
    "remove_stale_sockets",
    "socket_name",
]
