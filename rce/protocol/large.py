"""Reads large data messages, which :class:`~rce.protocol.stream.ProtocolStream` does not parse; slow."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce.protocol.assembler import Assembler, Binary
from rce.protocol.exceptions import MessageError
from rce.protocol.limits import DEFAULT_LIMITS, Limits
from rce.protocol.messages import DataMessage
from rce.protocol.reading import check_depth, message_from_json, parse_json
from rce.protocol.weight import Address, check_elements

if TYPE_CHECKING:
    from collections.abc import Mapping


def read_large(
    text: bytes, binaries: Mapping[str, Binary], address: Address, limits: Limits = DEFAULT_LIMITS
) -> DataMessage | list[str]:
    """Read a data message whose address was found without parsing it.

    Args:
        text: The text frame.
        binaries: The binary values that came for it, by id.
        address: The address that was found in it.
        limits: How much it may hold.

    Returns:
        The message, or the ids of the binary values that it refers to if none were given.

    Raises:
        ProtocolError: It is not a data message, or has another address.
    """
    check_elements(text, max_elements=limits.max_elements, max_values=limits.max_values)
    value = parse_json(text)
    check_depth(value, limits.max_depth)
    assembler = Assembler(limits)
    complete, _ = assembler.add_message(value, 0, 0.0)
    if not complete and not binaries:
        return assembler.awaited
    for id_, data in binaries.items():
        assembler.add_binary(b"".join((id_.encode(), data)), 0.0)
    message = message_from_json(value, ("DM",))
    assert isinstance(message, DataMessage)
    if message.i_tag != address.i_tag or (
        address.message_type and message.message_type != address.message_type
    ):
        raise MessageError(
            "data",
            f"in a large message iTag and type must come before msg, or after it within the last 4096 bytes; "
            f"found {address.i_tag!r} and {address.message_type!r} there",
        )
    return message
