"""The service call that a message belongs to, also if the message is refused.

A caller must learn of the end of its call. So a refusal names the interface and the ``msgID`` of the message,
as far as these can be read.
"""

from __future__ import annotations

from typing import Any

from rce.model import is_name
from rce.protocol.limits import MAX_MESSAGE_ID_LENGTH
from rce.protocol.messages import NO_ID, CallId


def call_of(value: Any) -> CallId | None:
    """Return the service call that a parsed text frame belongs to, ``None`` if it names none.

    Example:
        >>> call_of({"type": "DM", "data": {"iTag": "ask", "msgID": "7", "msg": 5}})
        CallId(i_tag='ask', msg_id='7')
    """
    if not isinstance(value, dict) or value.get("type") != "DM":
        return None
    data = value.get("data")
    if not isinstance(data, dict):
        return None
    return call_at(data.get("iTag"), text_id(data.get("msgID", NO_ID)))


def call_at(i_tag: Any, msg_id: Any) -> CallId | None:
    """Return the service call of an interface tag and a ``msgID``; ``None`` if they do not name one."""
    if not isinstance(i_tag, str) or not is_name(i_tag) or not isinstance(msg_id, str):
        return None
    if msg_id == NO_ID or len(msg_id) > MAX_MESSAGE_ID_LENGTH:
        return None
    return CallId(i_tag, msg_id)


def text_id(msg_id: Any) -> Any:
    """Return a ``msgID`` as text if it is an integer, as clients in other languages write it, else unchanged.

    A number without fraction is one: ``7.0`` is ``"7"``.
    """
    if type(msg_id) is float and msg_id.is_integer():
        msg_id = int(msg_id)
    return str(msg_id) if type(msg_id) is int and msg_id.bit_length() <= _MOST_BITS else msg_id


_MOST_BITS = 256
"""Most bits of a number that is accepted as an id; converting longer ones to text takes time."""
