"""The requests and answers of a worker process, as bytes.

A packet is a header, the lengths of its parts, a part of MessagePack that describes it, and raw parts: texts,
payloads, binary values.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, TypeAlias

import msgspec

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce_robot.outgoing import Buffer

HEAD = struct.Struct("!I")
"""How many parts follow."""
MAX_PARTS = 8192


class ReadText(msgspec.Struct, frozen=True, kw_only=True, tag_field="job", tag="text"):
    """Parse a data message and serialize its content. Parts: the text, then its binary values."""

    i_tag: str
    stated_type: str
    """As they were found in the text; ``stated_type`` may be empty."""
    message_type: str
    interface_type: str
    ids: tuple[str, ...] = ()
    """Of the binary values."""


class ReadValue(msgspec.Struct, frozen=True, kw_only=True, tag_field="job", tag="value"):
    """Serialize a parsed message. Part: the value in MessagePack."""

    message_type: str
    interface_type: str


class Show(msgspec.Struct, frozen=True, kw_only=True, tag_field="job", tag="show"):
    """Make the data message that carries a payload to the robot. Part: the payload."""

    i_tag: str
    message_type: str
    interface_type: str
    msg_id: str


Job: TypeAlias = ReadText | ReadValue | Show


class Result(msgspec.Struct, frozen=True, kw_only=True):
    """The result of a job.

    Parts: of a read, the serialized message; of :class:`Show`, the text and its binary frames, ids included;
    none if there is a fault.
    """

    fault: str = ""
    """Why the job failed, for the robot."""
    warnings: tuple[str, ...] = ()
    ids: tuple[str, ...] = ()
    """Binary values that the text refers to and that are still missing."""
    msg_id: str = ""
    text: str | None = None
    """The message was a string: a service's error text."""


encode_meta = msgspec.msgpack.Encoder().encode
decode_job = msgspec.msgpack.Decoder(Job).decode
decode_result = msgspec.msgpack.Decoder(Result).decode


def pack(meta: Job | Result, parts: Sequence[Buffer]) -> list[Buffer]:
    """Return the buffers of a packet, to be written one after the other."""
    described = encode_meta(meta)
    sizes = [len(described), *map(len, parts)]
    head = HEAD.pack(len(sizes)) + struct.pack(f"!{len(sizes)}Q", *sizes)
    return [head + described, *parts]
