"""Connection headers: the first frame in either direction. Pure.

Each field is ``name=value`` after its length (4 bytes, little-endian); the header is the frame of all.
http://wiki.ros.org/ROS/Connection%20Header
"""

from __future__ import annotations

import struct
from collections.abc import Mapping

from rce.ros.errors import HandshakeRefusedError, MalformedFrameError

ANY = "*"
"""Stands for any md5 sum or type."""

MAX_HEADER = 2**20
"""Longest connection header in bytes; full message definitions are some 10 kB."""

_LENGTH = struct.Struct("<I")


def encode_header(fields: Mapping[str, str]) -> bytes:
    """Write a connection header, with the length in front of it."""
    encoded = [f"{name}={value}".encode() for name, value in fields.items()]
    body = b"".join(_LENGTH.pack(len(field)) + field for field in encoded)
    return _LENGTH.pack(len(body)) + body


def decode_header(body: bytes) -> dict[str, str]:
    """Read a connection header, without the length in front of it.

    Raises:
        MalformedFrameError: The bytes are not a header.
    """
    fields: dict[str, str] = {}
    position = 0
    while position < len(body):
        start = position + _LENGTH.size
        if start > len(body):
            raise MalformedFrameError("a connection header ends within a field's length")
        position = start + _LENGTH.unpack_from(body, start - _LENGTH.size)[0]
        if position > len(body):
            raise MalformedFrameError("a field of a connection header is longer than the header")
        name, mark, value = body[start:position].partition(b"=")
        if not mark:
            raise MalformedFrameError("a field of a connection header has no '='")
        fields[name.decode(errors="replace")] = value.decode(errors="replace")
    return fields


def raise_error_field(fields: Mapping[str, str]) -> None:
    """Raise the error in the other end's header, if it has a field ``error``.

    Raises:
        HandshakeRefusedError: The header has that field.
    """
    if "error" in fields:
        raise HandshakeRefusedError(fields["error"])


def require(fields: Mapping[str, str], *required: str) -> None:
    """Check that a header has all ``required`` fields.

    Raises:
        HandshakeRefusedError: One is missing.
    """
    missing = [name for name in required if not fields.get(name)]
    if missing:
        raise HandshakeRefusedError(f"the connection header lacks {', '.join(missing)}")


def check_type(fields: Mapping[str, str], *, md5sum: str, type_name: str, subject: str) -> None:
    """Check that the other end expects the same type; ``*`` on either side matches all.

    Args:
        fields: The other end's header.
        md5sum: This end's md5 sum.
        type_name: This end's type name.
        subject: The topic or service, for the error's text.

    Raises:
        HandshakeRefusedError: Another md5 sum. An equal sum under another type name is the same type.
    """
    theirs = fields.get("md5sum", ANY)
    if ANY not in (theirs, md5sum) and theirs != md5sum:
        raise HandshakeRefusedError(
            f"{subject} is of type {type_name} with md5 sum {md5sum} here,"
            f" of type {fields.get('type', ANY)} with md5 sum {theirs} there"
        )
