"""The messages between a client and its robot endpoint, as types.

Requests of clients are in :mod:`rce.model.requests`; :mod:`rce.protocol.requests` has their spelling here.
:mod:`rce.protocol.reading` makes messages from JSON and checks them, :mod:`rce.protocol.codec` writes them.
Wire source: ``docs/protocol.md``.
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple, TypeAlias

from msgspec import Meta, Struct, field

from rce.model import (
    ConfigureComponents,
    ConfigureConnections,
    CreateContainer,
    DestroyContainer,
    FaultCode,
    FieldFault,
    Path,
    Request,
    ResizeContainer,
)
from rce.model.written import MessageTypeName, Name
from rce.protocol.limits import MAX_MESSAGE_ID_LENGTH

MessageId = Annotated[str, Meta(max_length=MAX_MESSAGE_ID_LENGTH)]
"""Echoed in the answer to a service request."""
MAX_SOURCE_LENGTH = 64
SourceName = Annotated[str, Meta(max_length=MAX_SOURCE_LENGTH)]
"""Names a publisher of latched messages within an interface."""

NO_ID = "nil"
"""The ``msgID`` of a message that expects no answer."""
UPDATE_TOPIC = "iu"
"""The ``topic`` of an interface's status."""


class DataMessage(Struct, frozen=True, omit_defaults=False):
    """``DM``: a message on a topic, a service request or its answer, at one interface."""

    i_tag: Name = field(name="iTag")
    message_type: MessageTypeName = field(name="type")
    msg: Any
    """A JSON object, or bytes where the message travels serialized."""
    msg_id: MessageId = field(name="msgID", default=NO_ID)
    latch: SourceName = ""
    """The source whose latched message it is; empty if it is not latched."""


class LatchedSources(Struct, frozen=True, kw_only=True, omit_defaults=True, rename="camel"):
    """``LT``: the sources whose latched messages are in force at an interface; all others ended."""

    i_tag: Name
    sources: tuple[SourceName, ...] = ()


class InterfaceStatus(Struct, frozen=True, kw_only=True, omit_defaults=True, rename="camel"):
    """``ST``: an interface became usable (``True``) or unusable."""

    i_tag: Name
    status: bool
    topic: str = field(default_factory=lambda: UPDATE_TOPIC)


class CallId(NamedTuple):
    """A service call at an interface of a robot."""

    i_tag: str
    msg_id: str

    def __str__(self) -> str:
        return f"{self.i_tag}, msgID {self.msg_id}"


class ErrorReport(Struct, frozen=True, kw_only=True):
    """``ER``: a request of the client failed."""

    problem: str
    """The fault, without the call."""
    call: CallId | None = None
    """The service call that failed."""
    path: Path = ()
    """The place of the fault in a message; of the first one, if there are several."""
    code: FaultCode | None = None
    """The kind of the fault; None if it is not given."""
    faults: tuple[FieldFault, ...] = ()
    """All faults of the message, if there are several."""
    ids: dict[str, str] = {}
    """What the refused request is about, by the keys of the request: ``{"containerTag": "brain"}``."""

    @property
    def text(self) -> str:
        """The text for users."""
        return self.problem if self.call is None else f"{self.call}: {self.problem}"


ClientMessage: TypeAlias = Request | DataMessage | LatchedSources | InterfaceStatus | ErrorReport
"""Any message of the protocol."""

REQUEST_TYPES: dict[str, type[Request]] = {
    "CC": CreateContainer,
    "DC": DestroyContainer,
    "CN": ConfigureComponents,
    "CX": ConfigureConnections,
    "RC": ResizeContainer,
}
TYPES: dict[str, type[ClientMessage]] = {
    **REQUEST_TYPES,
    "DM": DataMessage,
    "LT": LatchedSources,
    "ST": InterfaceStatus,
    "ER": ErrorReport,
}
"""The value of ``type`` to the class of the message."""
UPWARD = frozenset(("CC", "DC", "CN", "CX", "RC", "DM", "LT"))
"""Types that a client sends."""
DOWNWARD = frozenset(("DM", "LT", "ST", "ER"))
"""Types that the engine sends."""

_TAGS = {cls: tag for tag, cls in TYPES.items()}


def type_of(message: ClientMessage) -> str:
    """Return the value of ``type`` for a message, such as ``CN``."""
    return _TAGS[type(message)]
