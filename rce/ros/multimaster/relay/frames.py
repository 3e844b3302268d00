"""The frames between the two ends of a relay. Sans-I/O.

A frame on the wire is its length (uint32, little-endian, of everything after it), one byte for its kind, and
its body: JSON for rare frames, a fixed header and the untouched message for frequent ones::

    H  hello     {"protocol": 3, "name": ..., "nonce": ..., "proof": ...}: see :mod:`.handshake`
    N  challenge {"nonce": ...}
    R  proof     {"proof": ...}
    O  offer     {"topics": [[id, name, type, md5sum, definition], ...],
                  "services": [[id, name, type, md5sum, request type, response type], ...]}: all there is now
    W  want      [topic id, ...]: all topics whose messages shall come now
    D  data      uint32 topic id, uint32 source (0: not latched), message
    S  sources   [topic id, [source, ...]]: the sources of latched messages that are in force now
    C  call      uint32 service id, uint32 call id, request
    A  answer    uint32 call id, uint8 success, response (or the error's text)
    P  ping      nothing: the sender is there
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar

from rce.ros.multimaster.errors import LinkBrokenError
from rce.ros.multimaster.relay.kinds import ServiceKind, TopicKind
from rce.ros.tcpros.framing import MAX_FRAME

PROTOCOL = 3

_HEAD = struct.Struct("<IB")
_DATA = struct.Struct("<II")
_CALL = struct.Struct("<II")
_ANSWER = struct.Struct("<IB")
MAX_FRAME_SIZE = MAX_FRAME + 64
"""Bytes of the longest frame."""
MAX_GREETING = 4096
"""Bytes of a frame of the handshake."""
_MAX_NUMBER = 2**32 - 1
"""Highest number of a topic, source, service or call."""
NO_SOURCE = 0
"""In place of a source: the message is not latched."""


@dataclass(frozen=True, slots=True)
class Hello:
    """Names this end and authenticates it."""

    CODE: ClassVar[bytes] = b"H"
    name: str
    nonce: str = ""
    """Of the side that dials; empty in the answer."""
    proof: str = ""
    """Of the side that listens; empty in the first hello."""
    protocol: int = PROTOCOL

    def body(self) -> tuple[bytes, ...]:
        """Write the body."""
        said = {"protocol": self.protocol, "name": self.name, "nonce": self.nonce, "proof": self.proof}
        return (_json(said),)


@dataclass(frozen=True, slots=True)
class Challenge:
    """The nonce that the dialing side must use in its proof."""

    CODE: ClassVar[bytes] = b"N"
    nonce: str

    def body(self) -> tuple[bytes, ...]:
        """Write the body."""
        return (_json({"nonce": self.nonce}),)


@dataclass(frozen=True, slots=True)
class Proof:
    """The answer to a challenge."""

    CODE: ClassVar[bytes] = b"R"
    proof: str

    def body(self) -> tuple[bytes, ...]:
        """Write the body."""
        return (_json({"proof": self.proof}),)


@dataclass(frozen=True, slots=True)
class Offer:
    """Everything that this end has, by the numbers that the other end may ask for."""

    CODE: ClassVar[bytes] = b"O"
    topics: dict[int, tuple[str, TopicKind]] = field(default_factory=dict)
    services: dict[int, tuple[str, ServiceKind]] = field(default_factory=dict)

    def body(self) -> tuple[bytes, ...]:
        """Write the body."""
        topics = [
            [key, name, kind.name, kind.md5sum, kind.definition] for key, (name, kind) in self.topics.items()
        ]
        services = [
            [key, name, kind.name, kind.md5sum, kind.request_type, kind.response_type]
            for key, (name, kind) in self.services.items()
        ]
        return (_json({"topics": topics, "services": services}),)


@dataclass(frozen=True, slots=True)
class Want:
    """The topics whose messages shall come."""

    CODE: ClassVar[bytes] = b"W"
    topics: frozenset[int]

    def body(self) -> tuple[bytes, ...]:
        """Write the body."""
        return (_json(sorted(self.topics)),)


@dataclass(frozen=True, slots=True)
class Data:
    """A message."""

    CODE: ClassVar[bytes] = b"D"
    topic: int
    source: int
    """The publisher of a latched message, as the sender numbers it."""
    payload: bytes

    def body(self) -> tuple[bytes, ...]:
        """Write the body."""
        return _DATA.pack(self.topic, self.source), self.payload

    @property
    def key(self) -> tuple[int, int] | None:
        """Key under which a queue keeps it; None: it may be dropped."""
        return None if self.source == NO_SOURCE else (self.topic, self.source)


@dataclass(frozen=True, slots=True)
class Sources:
    """The sources of a topic whose latched messages are in force; the messages of others are void."""

    CODE: ClassVar[bytes] = b"S"
    topic: int
    sources: frozenset[int] = frozenset()

    def body(self) -> tuple[bytes, ...]:
        """Write the body."""
        return (_json([self.topic, sorted(self.sources)]),)

    @property
    def key(self) -> tuple[int, int]:
        """Key under which a queue keeps it."""
        return self.topic, NO_SOURCE


@dataclass(frozen=True, slots=True)
class Call:
    """A request to a service."""

    CODE: ClassVar[bytes] = b"C"
    service: int
    call: int
    payload: bytes

    def body(self) -> tuple[bytes, ...]:
        """Write the body."""
        return _CALL.pack(self.service, self.call), self.payload


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer of a service."""

    CODE: ClassVar[bytes] = b"A"
    call: int
    ok: bool
    payload: bytes

    def body(self) -> tuple[bytes, ...]:
        """Write the body."""
        return _ANSWER.pack(self.call, self.ok), self.payload


@dataclass(frozen=True, slots=True)
class Ping:
    """Shows that the sender is alive."""

    CODE: ClassVar[bytes] = b"P"

    def body(self) -> tuple[bytes, ...]:
        """Write the body."""
        return ()


Greeting = Hello | Challenge | Proof
"""A frame of the handshake."""
Frame = Greeting | Offer | Want | Data | Sources | Call | Answer | Ping


def encode(frame: Frame) -> tuple[bytes, ...]:
    """Write a frame as pieces to be sent one after the other; a message in it is not copied."""
    body = frame.body()
    return _HEAD.pack(1 + sum(map(len, body)), frame.CODE[0]), *body


class Decoder:
    """Cuts a byte stream into frames.

    Attributes:
        most: Bytes of the longest frame that is taken. Set to :data:`MAX_GREETING` until the peer is known.
    """

    def __init__(self, most: int = MAX_FRAME_SIZE) -> None:
        self.most = most
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[Frame]:
        """Take bytes; return the frames that are complete.

        Raises:
            LinkBrokenError: The bytes are not frames of this protocol.
        """
        self._buffer += data
        position = 0
        while len(self._buffer) - position >= _HEAD.size:
            length, code = _HEAD.unpack_from(self._buffer, position)
            if not 1 <= length <= self.most:
                raise LinkBrokenError(f"a frame of {length} bytes")
            end = position + _HEAD.size + length - 1
            if end > len(self._buffer):
                break
            body = bytes(memoryview(self._buffer)[position + _HEAD.size : end])
            position = end
            yield _decode(bytes([code]), body)
        del self._buffer[:position]


def _decode(code: bytes, body: bytes) -> Frame:
    try:
        match code:
            case Data.CODE:
                topic, source = _DATA.unpack_from(body)
                return Data(topic, source, body[_DATA.size :])
            case Call.CODE:
                service, call = _CALL.unpack_from(body)
                return Call(service, call, body[_CALL.size :])
            case Answer.CODE:
                call, ok = _ANSWER.unpack_from(body)
                return Answer(call, bool(ok), body[_ANSWER.size :])
            case Ping.CODE:
                return Ping()
            case _:
                return _decode_json(code, json.loads(body))
    except (
        struct.error,
        ValueError,
        TypeError,
        KeyError,
        AttributeError,
        OverflowError,
        RecursionError,
    ) as error:
        raise LinkBrokenError(f"a frame {code!r} that cannot be read: {error}") from error


def _decode_json(code: bytes, values: Any) -> Frame:
    match code:
        case Hello.CODE:
            nonce, proof = _text(values.get("nonce", "")), _text(values.get("proof", ""))
            return Hello(_text(values["name"]), nonce, proof, _number(values["protocol"]))
        case Challenge.CODE:
            return Challenge(_text(values["nonce"]))
        case Proof.CODE:
            return Proof(_text(values["proof"]))
        case Want.CODE:
            return Want(frozenset(map(_number, values)))
        case Sources.CODE:
            topic, sources = values
            return Sources(_number(topic), frozenset(map(_number, sources)))
        case Offer.CODE:
            topics = {
                _number(key): (_text(name), TopicKind(*map(_text, kind)))
                for key, name, *kind in values["topics"]
            }
            services = {
                _number(key): (_text(name), ServiceKind(*map(_text, kind)))
                for key, name, *kind in values["services"]
            }
            return Offer(topics, services)
        case _:
            raise ValueError("an unknown kind of frame")


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"expected a text, found {type(value).__name__}")
    value.encode()  # JSON can carry half a surrogate pair, which no other part can write
    return value


def _number(value: Any) -> int:
    if not isinstance(value, int) or not 0 <= value <= _MAX_NUMBER:
        raise ValueError(f"expected a number of 0 to {_MAX_NUMBER}")
    return value


def _json(values: Any) -> bytes:
    return json.dumps(values, separators=(",", ":")).encode()
