"""The protocol between a client and its robot endpoint: vocabulary, messages, binary assembler (sans-I/O)."""

from rce.protocol.calls import call_at
from rce.protocol.codec import Frame, encode, encode_data
from rce.protocol.exceptions import HandshakeError, MessageError, ProtocolError
from rce.protocol.http import (
    FEATURES,
    FEATURES_HEADER,
    FEATURES_KEY,
    LATCH,
    SINGLE_FRAME,
    Credentials,
    master_reply,
    read_credentials,
    read_features,
    read_master_request,
)
from rce.protocol.limits import Limits
from rce.protocol.messages import (
    NO_ID,
    CallId,
    DataMessage,
    ErrorReport,
    InterfaceStatus,
    LatchedSources,
    type_of,
)
from rce.protocol.requests import MAX_ITEMS, read_request, write_request
from rce.protocol.stream import Event, Fault, LargeData, LongRequest, ProtocolStream
from rce.protocol.weight import Address, is_light, memory_of, utf8_in_steps

__all__ = [
    "FEATURES",
    "FEATURES_HEADER",
    "FEATURES_KEY",
    "LATCH",
    "MAX_ITEMS",
    "NO_ID",
    "SINGLE_FRAME",
    "Address",
    "CallId",
    "Credentials",
    "DataMessage",
    "ErrorReport",
    "Event",
    "Fault",
    "Frame",
    "HandshakeError",
    "InterfaceStatus",
    "LargeData",
    "LatchedSources",
    "Limits",
    "LongRequest",
    "MessageError",
    "ProtocolError",
    "ProtocolStream",
    "call_at",
    "encode",
    "encode_data",
    "is_light",
    "master_reply",
    "memory_of",
    "read_credentials",
    "read_features",
    "read_master_request",
    "read_request",
    "type_of",
    "utf8_in_steps",
    "write_request",
]
