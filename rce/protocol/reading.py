"""From JSON text to typed messages, with errors that name the place.

Data messages have a way of their own through msgspec's typed decoder, because they are nearly all the
traffic; everything else, and everything that is wrong, takes the slow way that finds good words.
"""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Annotated, Any, AnyStr, Literal, TypeVar, assert_never

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType, field

from rce.model.names import Form
from rce.protocol.calls import text_id
from rce.protocol.container_checks import container_faults, resize_faults
from rce.protocol.exceptions import MessageError
from rce.protocol.limits import DEFAULT_LIMITS
from rce.protocol.messages import (
    CHOICES,
    HUMAN_PATTERNS,
    NO_ID,
    REQUEST_TYPES,
    TYPES,
    AddInterface,
    AddNode,
    ClientMessage,
    ConfigureComponents,
    ConfigureConnections,
    Connection,
    CreateContainer,
    DataMessage,
    DeleteParam,
    DestroyContainer,
    ErrorReport,
    MessageId,
    MessageTypeName,
    Name,
    RemoveInterface,
    RemoveNode,
    Request,
    ResizeContainer,
    SetParam,
    SourceName,
)

if TYPE_CHECKING:
    from collections.abc import Collection

T = TypeVar("T")


class _DataFrame(Struct):
    type: Literal["DM"]
    data: DataMessage


class SerializedData(Struct):
    """A data message that travels serialized, as its text frame tells it."""

    i_tag: Name = field(name="iTag")
    message_type: MessageTypeName = field(name="type")
    binary: Annotated[str, Meta(pattern=r"^[0-9A-Fa-f]{32}\Z")] = field(name="msg*")
    """The id of the binary frame."""
    msg_id: MessageId = field(name="msgID", default=NO_ID)
    latch: SourceName = ""
    msg: UnsetType = UNSET
    """Must not be there beside ``msg*``."""


class _SerializedFrame(Struct):
    type: Literal["DM"]
    data: SerializedData


_decode_data_frame = msgspec.json.Decoder(_DataFrame).decode
_decode_serialized_frame = msgspec.json.Decoder(_SerializedFrame).decode
_decode_any = msgspec.json.Decoder().decode

_DECODE_FAULTS = (msgspec.MsgspecError, UnicodeError, RecursionError)

_ITEMS: dict[str, type[Struct]] = {
    "addNodes": AddNode,
    "removeNodes": RemoveNode,
    "addInterfaces": AddInterface,
    "removeInterfaces": RemoveInterface,
    "setParam": SetParam,
    "deleteParam": DeleteParam,
}
_CONNECTION_ITEMS: dict[str, type[Struct]] = {"connect": Connection, "disconnect": Connection}

_MAX_ITEMS = 512
"""Items of all lists of one ``CN`` or ``CX``: each is read on its own."""
_MAX_FAULTS = 32
"""Wrong items of one ``CN`` or ``CX`` after which no more are read."""
_MAX_QUOTED = 80
_SHORT = 4096

_PLACE = re.compile(r"(?s)(.*) - at `(?:key in )?\$(.*)`")
_MISSING = re.compile(r"Object missing required field `([^`]+)`")
_ESCAPED_SURROGATE = re.compile(rb"\\u[dD]")
_REPR_PATTERNS = {repr(pattern): text for pattern, text in HUMAN_PATTERNS.items()}


def decode(text: str | bytes, *, max_depth: int = DEFAULT_LIMITS.max_depth) -> ClientMessage:
    """Read a text frame that refers to no binary frames.

    Args:
        text: The JSON text, or its UTF-8.
        max_depth: Deepest nesting that is accepted.

    Returns:
        The message. A ``CN`` or ``CX`` of which some items are wrong holds the good ones, and a text for each
        of the others in ``faults``.

    Raises:
        MessageError: It is not a message.
    """
    shallow = is_shallow(text, max_depth)
    if shallow:
        message = decode_data(text)
        if message is not None:
            return message
    value = parse_json(text)
    if not shallow:
        check_depth(value, max_depth)
    return message_from_json(value)


def decode_data(text: str | bytes) -> DataMessage | None:
    """Read a data message, the quick way. ``None``: it is another type or wrong, the slow way tells which."""
    try:
        return _decode_data_frame(text).data
    except _DECODE_FAULTS:
        return None


def decode_serialized(text: str | bytes) -> SerializedData | None:
    """Read a data message that is one binary value, the quick way. ``None``: take the slow way."""
    stars = text.count('*"') if isinstance(text, str) else text.count(b'*"')
    escaped = "\\" in text if isinstance(text, str) else b"\\" in text
    if stars != 1 or escaped:
        return None
    try:
        return _decode_serialized_frame(text).data
    except _DECODE_FAULTS:
        return None


def is_shallow(text: str | bytes, max_depth: int) -> bool:
    """Tell whether ``text`` cannot be nested too deep, at the cost of two scans in C."""
    if isinstance(text, str):
        return _openers(text, "{", max_depth) + _openers(text, "[", max_depth) <= max_depth
    return _openers(text, b"{", max_depth) + _openers(text, b"[", max_depth) <= max_depth


def _openers(text: AnyStr, brace: AnyStr, enough: int) -> int:
    """Count braces; on a long text ``find`` is ten times as fast as ``count``, and stops at ``enough``."""
    if len(text) <= _SHORT:
        return text.count(brace)
    count, place = 0, text.find(brace)
    while place >= 0 and count <= enough:
        count += 1
        place = text.find(brace, place + 1)
    return count


def check_depth(value: Any, max_depth: int) -> None:
    """Check the nesting of a JSON value, level by level and so without recursion.

    Raises:
        MessageError: It is nested deeper than ``max_depth``.
    """
    level = [value] if type(value) in (dict, list) else []
    depth = 0
    while level:
        depth += 1
        if depth > max_depth:
            raise MessageError("", f"nested deeper than {max_depth} levels")
        level = [
            inner
            for outer in level
            for inner in (outer.values() if type(outer) is dict else outer)
            if type(inner) is dict or type(inner) is list
        ]


def check_request_size(value: Any, size: int, limit: int) -> None:
    """Check the size of what is not a data message.

    Raises:
        MessageError: Its text is longer than ``limit``.
    """
    kind = value.get("type") if isinstance(value, dict) else None
    if kind != "DM":
        raise MessageError(
            "", f"{_short(kind)}: a request of {size} bytes is longer than the limit of {limit}"
        )


def parse_json(text: str | bytes) -> Any:
    """Read JSON; ``NaN`` and ``Infinity``, which Python's own writer emits, are understood too.

    Raises:
        MessageError: It is not JSON.
    """
    try:
        return _decode_any(text)
    except RecursionError as error:
        raise MessageError("", "nested deeper than any message may be") from error
    except _DECODE_FAULTS as error:
        if not _may_hold_nan(text):
            raise MessageError("", f"not valid JSON: {error}") from error
    try:
        value = json.loads(text)
        if _ESCAPED_SURROGATE.search(text.encode(errors="replace") if isinstance(text, str) else text):
            json.dumps(value, ensure_ascii=False).encode()  # Python reads halves of characters, too
    except (ValueError, RecursionError) as error:
        raise MessageError("", f"not valid JSON: {error}") from error
    return value


def _may_hold_nan(text: str | bytes) -> bool:
    if isinstance(text, str):
        return "NaN" in text or "Infinity" in text
    return b"NaN" in text or b"Infinity" in text


def message_from_json(value: Any, accept: Collection[str] = TYPES) -> ClientMessage:
    """Make a message of a parsed text frame whose binary values are in place.

    Args:
        value: The JSON value.
        accept: The types that the peer may send.

    Raises:
        MessageError: It is not a message, or one of another type.
    """
    if not isinstance(value, dict):
        raise MessageError("", f"a message must be an object, not {_kind(value)}")
    kind = value.get("type")
    if not isinstance(kind, str) or kind not in accept:
        known = ", ".join(sorted(accept))
        problem = "is missing" if "type" not in value else f"unknown message type {_short(kind)}"
        raise MessageError("type", f"{problem}; use one of {known}")
    if "data" not in value:
        raise MessageError("data", "is missing")
    data = value["data"]
    if kind in REQUEST_TYPES:
        return read_request(kind, data)
    if kind == "ER":
        return ErrorReport(text=_convert(data, str, "data"))
    if kind == "DM" and isinstance(data, dict) and "msgID" in data:
        data = {**data, "msgID": text_id(data["msgID"])}
    return _convert(data, TYPES[kind], "data")


def read_request(kind: str, data: Any) -> Request:
    """Make a request of its type and its ``data``.

    Raises:
        MessageError: ``kind`` is not a request, or ``data`` as a whole is wrong. Wrong items of a ``CN`` or
            ``CX`` do not raise: they are in ``faults``.
    """
    cls = REQUEST_TYPES.get(kind)
    if cls is None:
        raise MessageError("type", f"{_short(kind)} is not a request; use one of {', '.join(REQUEST_TYPES)}")
    if not isinstance(data, dict):
        raise MessageError("data", f"must be an object, not {_kind(data)}")
    if cls is ConfigureComponents:
        return msgspec.convert(_read_items(data, _ITEMS), ConfigureComponents)
    if cls is ConfigureConnections:
        return msgspec.convert(_read_items(data, _CONNECTION_ITEMS), ConfigureConnections)
    if data.get("containerData", ...) is None:
        data = {key: value for key, value in data.items() if key != "containerData"}
    return _checked(_convert(data, cls, "data"))


def _checked(request: Request) -> Request:
    """Check what a container asks for; all that is wrong is told at once."""
    match request:
        case CreateContainer():
            faults = list(container_faults(request.container_data))
        case ResizeContainer():
            faults = list(resize_faults(request.container_data))
        case DestroyContainer() | ConfigureComponents() | ConfigureConnections():
            return request
        case _:
            assert_never(request)
    if faults:
        texts = [f"{_below('data.containerData', fault.key)}: {fault.problem}" for fault in faults]
        place, problem = texts[0].split(": ", 1)
        raise MessageError(place, "; ".join((problem, *texts[1:])))
    return request


def _below(place: str, key: str) -> str:
    return f"{place}.{key}" if key else place


def _read_items(data: dict[str, Any], kinds: dict[str, type[Struct]]) -> dict[str, Any]:
    """Read each item of each list on its own, so that a bad one harms no other."""
    count = sum(len(items) for key in kinds if isinstance(items := data.get(key), list))
    if count > _MAX_ITEMS:
        raise MessageError(
            "data", f"{count} items are over the limit of {_MAX_ITEMS}; send them in several messages"
        )
    read: dict[str, Any] = {}
    faults: list[str] = []
    for key, cls in kinds.items():
        items = data.get(key)
        if items is None:
            continue
        if not isinstance(items, list):
            faults.append(f"data.{key}: must be a list, not {_kind(items)}")
            continue
        good = read[key] = []
        for index, item in enumerate(items):
            if len(faults) >= _MAX_FAULTS:
                faults.append(
                    f"data.{key}: the last {len(items) - index} items were not read, too many are wrong"
                )
                break
            place = f"data.{key}[{index}]"
            try:
                made = _convert(item, cls, place)
                _check_address(made, place)
            except MessageError as error:
                faults.append(str(error))
            else:
                good.append(made)
    read["faults"] = faults
    return read


def _check_address(item: Struct, place: str) -> None:
    if (
        isinstance(item, AddInterface)
        and not item.addr
        and item.interface_type.endswith(Form.INTERFACE.value)
    ):
        raise MessageError(f"{place}.addr", f"is missing; a {item.interface_type} needs its ROS name")


def _convert(value: Any, cls: type[T], place: str) -> T:
    """Convert with msgspec and give its complaint our words and our place."""
    try:
        return msgspec.convert(value, cls)
    except msgspec.ValidationError as error:
        raise _reworded(str(error), value, place) from error


def _reworded(text: str, value: Any, place: str) -> MessageError:
    found = _PLACE.fullmatch(text)
    problem, inner = found.groups() if found else (text, "")
    key = inner.rpartition(".")[2]
    if problem.startswith("Invalid enum value") and key in CHOICES:
        given = _short(_look_up(value, inner))
        return MessageError(place + inner, f"must be one of {', '.join(CHOICES[key])}, not {given}")
    missing = _MISSING.fullmatch(problem)
    if missing:
        return MessageError(f"{place}{inner}.{missing[1]}", "is missing")
    for pattern, words in _REPR_PATTERNS.items():
        if problem.endswith(pattern):
            problem = f"{words}, not {_short(_look_up(value, inner))}"
            break
    else:
        problem = problem.replace("Expected", "must be", 1).replace(", got", ", not").replace("`", "")
    return MessageError(place + inner, problem)


def _look_up(value: Any, path: str) -> Any:
    for key, index in re.findall(r"\.([^.\[]+)|\[(\d+)\]", path):
        value = value[int(index)] if index else value[key]
    return value


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _MAX_QUOTED else f"{text[:_MAX_QUOTED]}..."


def _kind(value: Any) -> str:
    names = {dict: "an object", list: "a list", str: "a string", bool: "a boolean", type(None): "null"}
    return names.get(type(value), "a number" if isinstance(value, int | float) else "binary")
