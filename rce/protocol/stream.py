"""One side of a connection, without I/O: frames in, messages and faults out.

The I/O around it is always the same: give each frame to :meth:`ProtocolStream.feed`, handle the events, and
call :meth:`ProtocolStream.expire` periodically (or at :attr:`ProtocolStream.next_deadline`). To send, use
:mod:`rce.protocol.codec`, which needs no state.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

from msgspec import Struct

from rce.model import FieldFault
from rce.protocol.assembler import Assembler, Binary, Dropped
from rce.protocol.calls import call_at, call_of
from rce.protocol.exceptions import MessageError, ProtocolError
from rce.protocol.limits import DEFAULT_LIMITS, Limits
from rce.protocol.messages import (
    DOWNWARD,
    REQUEST_TYPES,
    UPWARD,
    CallId,
    ClientMessage,
    DataMessage,
    ErrorReport,
)
from rce.protocol.reading import (
    SerializedData,
    check_depth,
    check_request_size,
    decode_data,
    decode_serialized,
    is_shallow,
    kind_and_data,
    message_from_json,
    parse_json,
)
from rce.protocol.requests import is_long, read_in_steps
from rce.protocol.single import MARK, SingleReader
from rce.protocol.weight import Address, find_address, is_light, memory_of

if TYPE_CHECKING:
    from collections.abc import Collection, Generator
    from typing import Self


class Fault(Struct, frozen=True):
    """A message of the peer was refused or dropped; the stream continues."""

    problem: str
    """The fault, without the call."""
    call: CallId | None = None
    """The service call that ends with this, because its request or its answer is lost."""
    fields: tuple[FieldFault, ...] = ()
    """The faults of a request."""

    @classmethod
    def of(cls, error: ProtocolError, call: CallId | None) -> Self:
        """Make the fault of a message, of a service call or not."""
        fields = error.faults if isinstance(error, MessageError) else ()
        return cls(str(error), call, tuple(field for field in fields if field.path))

    @property
    def report(self) -> ErrorReport:
        """The report to the peer."""
        if not self.fields:
            return ErrorReport(problem=self.problem, call=self.call)
        first = self.fields[0]
        several = self.fields if len(self.fields) > 1 else ()
        return ErrorReport(
            problem=self.problem, call=self.call, path=first.path, code=first.code, faults=several
        )

    @property
    def text(self) -> str:
        """The text for users."""
        return self.report.text


class LargeData(Struct, frozen=True):
    """A data message that takes too long to be parsed where it came in.

    :func:`rce.protocol.large.read_large` parses it. The stream returns it unparsed. If it turns out to refer
    to binary values, give their ids to :meth:`ProtocolStream.await_binaries`; the stream returns it again
    when these have come.
    """

    address: Address
    text: bytes
    binaries: dict[str, memoryview] = {}
    """By id."""

    @property
    def call(self) -> CallId | None:
        """The service call that it belongs to."""
        return call_at(self.address.i_tag, self.address.msg_id)

    @property
    def size(self) -> int:
        """Bytes of all its frames."""
        return len(self.text) + sum(map(len, self.binaries.values()))


class LongRequest(Struct, frozen=True):
    """A request of so many items that it takes too long to be read in one piece."""

    kind: str
    data: Any

    def read(self) -> Generator[None, None, ClientMessage | Fault]:
        """Read it, and stop after each few items.

        Returns:
            The request, or its fault.
        """
        try:
            return (yield from read_in_steps(self.kind, self.data))
        except ProtocolError as error:
            return Fault.of(error, None)


Event: TypeAlias = ClientMessage | LargeData | LongRequest | Fault
"""An output of a stream."""


class _Serialized:
    """A data message that waits for its one binary value, as most messages of Forwarders do."""

    __slots__ = ("_data", "holder")

    def __init__(self, data: SerializedData) -> None:
        self._data = data
        self.holder: list[Any] = [None]

    @property
    def call(self) -> CallId | None:
        """The service call that it belongs to."""
        return call_at(self._data.i_tag, self._data.msg_id)

    def message(self) -> DataMessage:
        """Return the message with the bytes that were put into ``holder``."""
        data = self._data
        return DataMessage(data.i_tag, data.message_type, self.holder[0], data.msg_id, data.latch)


class _WaitingLarge:
    """A large message that waits for its binary values."""

    __slots__ = ("_large", "binaries")

    def __init__(self, large: LargeData) -> None:
        self._large = large
        self.binaries: dict[str, Any] = {}

    @property
    def call(self) -> CallId | None:
        """The service call that it belongs to."""
        return self._large.call

    def message(self) -> LargeData:
        """Return the message with its binary values."""
        return LargeData(self._large.address, self._large.text, self.binaries)


class ProtocolStream:
    """Reads one peer's frames.

    It never raises for input of the peer: faults are returned as :class:`Fault`, and nothing else is lost.
    Binary values in messages are memoryviews of the frames they came in.
    """

    def __init__(
        self,
        accept: Collection[str],
        limits: Limits = DEFAULT_LIMITS,
        *,
        defer_large: bool = False,
        single: bool = False,
    ) -> None:
        self._accept = accept
        self._limits = limits
        self._defer_large = defer_large
        self._single = SingleReader() if single else None
        self._assembler = Assembler(limits)

    @classmethod
    def for_engine(cls, limits: Limits = DEFAULT_LIMITS, *, single: bool = False) -> Self:
        """Make the engine's side, which reads messages of clients, and returns large and long ones unread.

        Args:
            limits: Limits on the peer's data.
            single: Whether the client may send messages in one frame; see :mod:`rce.protocol.single`.
        """
        return cls(UPWARD, limits, defer_large=True, single=single)

    @classmethod
    def for_client(cls, limits: Limits = DEFAULT_LIMITS, *, single: bool = False) -> Self:
        """Make the client's side, which reads messages of the engine; the arguments are the same."""
        return cls(DOWNWARD, limits, single=single)

    @property
    def pending_bytes(self) -> int:
        """Bytes kept of incomplete messages and unclaimed binary values."""
        return self._assembler.pending_bytes

    @property
    def next_deadline(self) -> float | None:
        """When :meth:`expire` must be called next; None if nothing waits."""
        return self._assembler.next_deadline

    def feed(self, frame: str | bytes, now: float) -> list[Event]:
        """Take a frame as a WebSocket library gives it: ``str`` for text, ``bytes`` for binary."""
        return self.feed_text(frame, now) if isinstance(frame, str) else self.feed_binary(frame, now)

    def feed_text(self, text: str | bytes, now: float, *, light: bool | None = None) -> list[Event]:
        """Take a text frame.

        Args:
            text: Its text, or its UTF-8.
            now: Seconds on the caller's clock.
            light: The result of :func:`~rce.protocol.weight.is_light`; None if it is not known yet.
        """
        if len(text) > self._limits.max_text:
            return [self._too_long(text)]
        if self._defer_large and isinstance(text, bytes):
            if light is None:
                light = is_light(text)
            if not light:
                return [self._defer(text)]
        return self._feed_light(text, now)

    def _feed_light(self, text: str | bytes, now: float) -> list[Event]:
        limits = self._limits
        shallow = is_shallow(text, limits.max_depth)
        starred = _may_be_starred(text)
        value: Any = None
        partial: _Serialized | None = None
        if shallow and not starred:
            message = decode_data(text)
            if message is not None:
                return [message]
        try:
            if shallow and starred and (data := decode_serialized(text)) is not None:
                partial = _Serialized(data)
                complete, dropped = self._assembler.add_single(
                    partial, data.binary, partial.holder, len(text), now
                )
                return self._events(partial if complete else None, dropped)
            value = parse_json(text)
            if not shallow:
                check_depth(value, limits.max_depth)
            if len(text) > limits.max_request:
                check_request_size(value, len(text), limits.max_request)
            if not starred:
                return [self._read(value)]
            # What the engine does not defer has few values, which are counted fast.
            size = memory_of(value) if self._defer_large else len(text)
            complete, dropped = self._assembler.add_message(value, size, now)
        except ProtocolError as error:
            return [Fault.of(error, call_of(value) if partial is None else partial.call)]
        return self._events(value if complete else None, dropped)

    def await_binaries(self, large: LargeData, ids: Collection[str], now: float) -> list[Event]:
        """Keep a large message until the binary values that it refers to have come.

        Args:
            large: The message, as the stream returned it.
            ids: The ids that were found in it, in order.
            now: Seconds on the caller's clock.
        """
        waiting = _WaitingLarge(large)
        try:
            complete, dropped = self._assembler.add_references(
                waiting, ids, waiting.binaries, len(large.text), now
            )
        except ProtocolError as error:
            return [Fault.of(error, waiting.call)]
        return self._events(waiting if complete else None, dropped)

    def feed_binary(self, frame: Binary, now: float) -> list[Event]:
        """Take a binary frame, which is kept and must not be changed afterwards.

        Args:
            frame: Its bytes.
            now: Seconds on the caller's clock.
        """
        if len(frame) > self._limits.max_binary:
            limit = self._limits.max_binary
            return [Fault(f"a binary frame of {len(frame)} bytes is longer than the limit of {limit}")]
        if self._single is not None and frame and frame[0] == MARK:
            return [self._read_single(self._single, frame)]
        try:
            value, dropped = self._assembler.add_binary(frame, now)
        except ProtocolError as error:
            return [Fault(str(error))]
        return self._events(value, dropped)

    def _read_single(self, reader: SingleReader, frame: Binary) -> Event:
        value: Any = None
        try:
            message = reader.read(frame)
            if type(message) is DataMessage:
                return message
            value = {"type": "DM", "data": message}
            return message_from_json(value, self._accept)
        except ProtocolError as error:
            return Fault.of(error, call_of(value))

    def expire(self, now: float) -> list[Event]:
        """Drop messages that have been incomplete for too long."""
        return [_fault(dropped) for dropped in self._assembler.expire(now)]

    def drop_oldest(self, size: int) -> list[Event]:
        """Drop what is incomplete, oldest first, until ``size`` bytes are free."""
        return [_fault(dropped) for dropped in self._assembler.drop_oldest(size)]

    def _events(self, value: Any, dropped: list[Dropped]) -> list[Event]:
        """Make the events of a complete message, if there is one, and of dropped items."""
        events: list[Event] = [_fault(one) for one in dropped] if dropped else []
        if value is not None:
            events.append(self._message(value))
        return events

    def _too_long(self, text: str | bytes) -> Fault:
        limit = self._limits.max_text
        address = find_address(text) if isinstance(text, bytes) else None
        return Fault(
            f"a text frame of {len(text)} is longer than the limit of {limit}",
            None if address is None else call_at(address.i_tag, address.msg_id),
        )

    def _defer(self, text: bytes) -> Event:
        address = find_address(text)
        if address is None:
            return Fault(
                f"a text of {len(text)} bytes is too large for a request, and no data message: "
                "it has no iTag in its first or last 4096 bytes"
            )
        return LargeData(address, text)

    def _message(self, value: Any) -> Event:
        if type(value) is _Serialized or type(value) is _WaitingLarge:
            message: Event = value.message()
            return message
        try:
            return self._read(value)
        except ProtocolError as error:
            return Fault.of(error, call_of(value))

    def _read(self, value: Any) -> Event:
        if self._defer_large:
            kind, data = kind_and_data(value, self._accept)
            if kind in REQUEST_TYPES and is_long(kind, data):
                return LongRequest(kind, data)
        return message_from_json(value, self._accept)


def _fault(dropped: Dropped) -> Fault:
    """Return the fault of a dropped item."""
    value = dropped.value
    return Fault(
        dropped.text, value.call if isinstance(value, (_Serialized, _WaitingLarge)) else call_of(value)
    )


def _may_be_starred(text: str | bytes) -> bool:
    """Return whether a key may end in a star, written plainly or as an escape."""
    # Searching for one character is ten times as fast as for two, and most messages hold neither.
    if isinstance(text, str):
        return ("*" in text and '*"' in text) or ("\\" in text and "\\u002" in text)
    return (b"*" in text and b'*"' in text) or (b"\\" in text and b"\\u002" in text)
