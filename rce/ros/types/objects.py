"""Messages as objects: their classes, their codec, and which field is at fault when a codec fails."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rce.ros.types.arrays import BOOL_BYTES, pack_bools, pack_numbers, pack_octets, unpack_numbers
from rce.ros.types.codegen import FAULTS, Code
from rce.ros.types.exceptions import SerializationError
from rce.ros.types.faults import array_fault, find_fault, read_fault
from rce.ros.types.fields import LARGE, Buffer, Field, attribute
from rce.ros.types.readers import LenientReader, OnBadText, Reader, ReaderBuilder
from rce.ros.types.values import NUMBERS, STAMPS, Duration, Message, Time
from rce.ros.types.writers import WriterBuilder

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rce.ros.types.message import MessageType

_UNSET: Any = object()


def make_class(message_type: MessageType) -> type[Message]:
    """Make the class that holds messages of ``message_type``."""
    slots = tuple(attribute(field.name) for field in message_type.fields)
    code = Code()
    unset = code.bind(_UNSET)
    arguments = []
    for slot, field in zip(slots, message_type.fields, strict=True):
        default = _default_value(field)
        if isinstance(default, (bool, int, float, str, bytes)):
            arguments.append(f"{slot}={code.bind(default)}")
            code.line(f"self.{slot} = {slot}")
        else:
            arguments.append(f"{slot}={unset}")
            make = code.bind(lambda field=field: _default_value(field))
            code.line(f"self.{slot} = {make}() if {slot} is {unset} else {slot}")
    code.line("pass")
    init = code.compile(f"__init__({', '.join(['self', *arguments])})", f"class of {message_type.name}")
    body: dict[str, Any] = {attribute(constant.name): constant.value for constant in message_type.constants}
    body |= {
        "__slots__": slots,
        "__init__": init,
        "_type": message_type,
        "__doc__": f"A message of type {message_type.name}.",
    }
    return type(message_type.name.rpartition("/")[2], (Message,), body)


def make_codec(message_type: MessageType) -> tuple[Callable[[Message], bytes], Callable[[Buffer], Message]]:
    """Make the functions that serialize and deserialize objects of ``message_type``."""
    write, read, cls = _writer_of(message_type), _reader_of(message_type, "strict"), message_type.cls
    lenient = LenientReader(message_type.name, lambda: _reader_of(message_type, "replace"))

    def serialize(message: Message) -> bytes:
        if message.__class__ is not cls:
            message = _same_type(message_type, message)
        try:
            data: bytes = write(message, None)
        except FAULTS as error:
            find_fault(message_type, message, message_type.name)
            raise SerializationError(
                message_type.name, "", str(error) or "the message does not fit its type"
            ) from error
        return data

    def deserialize(buffer: Buffer) -> Message:
        if len(buffer) > LARGE:
            buffer = memoryview(buffer)
        try:
            try:
                message, end = read(buffer, 0)
            except UnicodeDecodeError:
                message, end = lenient(buffer, 0)
        except FAULTS as error:
            raise read_fault(message_type, buffer) from error
        if end != len(buffer):
            raise read_fault(message_type, buffer)
        result: Message = message
        return result

    return serialize, deserialize


def _same_type(message_type: MessageType, message: object) -> Message:
    """Accept a message of an equal type of another registry."""
    if isinstance(message, Message) and message._type.md5sum == message_type.md5sum:  # noqa: SLF001
        return message
    name = message._type.name if isinstance(message, Message) else type(message).__name__  # noqa: SLF001
    raise SerializationError(message_type.name, "", f"a {name} is not a {message_type.name}")


class _ObjectReading:
    """Values that were read become message objects."""

    def number(self, code: Code, field: Field, value: str) -> str:
        del code, field
        return value

    def stamp(self, code: Code, field: Field, secs: str, nsecs: str) -> str:
        return f"{code.bind(Time if field.type == 'time' else Duration)}({secs}, {nsecs})"

    def octets(self, code: Code, chunk: str) -> str:
        del code
        return f"bytes({chunk})"

    def numbers(self, code: Code, field: Field, chunk: str) -> str:
        if field.type == "bool":
            return f"[x != 0 for x in {chunk}]"
        return f"{code.bind(unpack_numbers)}({NUMBERS[field.type].code!r}, {chunk})"

    def message(self, code: Code, message_type: MessageType, values: Sequence[str]) -> str:
        return f"{code.bind(message_type.cls)}({', '.join(values)})"


class _ObjectWriting:
    """Values are taken from the attributes of message objects."""

    def open(self, code: Code, message_type: MessageType, holder: str) -> None:
        pass

    def close(self, code: Code, message_type: MessageType, holder: str) -> None:
        pass

    def take(self, code: Code, field: Field, holder: str) -> str:
        del code
        return f"{holder}.{attribute(field.name)}"

    def number(self, code: Code, field: Field, value: str) -> tuple[str, str]:
        if field.type == "bool":
            return "B", f"{code.bind(BOOL_BYTES)}[{value}]"
        return NUMBERS[field.type].code, value

    def stamp(self, code: Code, field: Field, value: str) -> tuple[str, str]:
        del field
        variable = code.variable()
        code.line(f"{variable} = {value}")
        return f"{variable}.secs", f"{variable}.nsecs"

    def octets(self, code: Code, value: str) -> str:
        return f"{code.bind(pack_octets)}({value})"

    def numbers(self, code: Code, field: Field, value: str) -> str:
        if field.type == "bool":
            return f"{code.bind(pack_bools)}({value})"
        return f"{code.bind(pack_numbers)}({NUMBERS[field.type].code!r}, {value})"

    def sequence(self, code: Code, value: str) -> str:
        del code
        return value


def _reader_of(message_type: MessageType, on_bad_text: OnBadText) -> Reader:
    return ReaderBuilder(_ObjectReading(), lambda nested: _reader_of(nested, on_bad_text), on_bad_text).build(
        message_type
    )


def _writer_of(message_type: MessageType) -> Any:
    return WriterBuilder(_ObjectWriting(), _writer_of).build(message_type)


def make_message(message_type: MessageType, values: Mapping[str, Any], root: str, path: str) -> Message:
    """Make a message of a mapping of its fields; nested messages may be mappings too."""
    fields = {field.name: field for field in message_type.fields}
    arguments = {}
    for name, value in values.items():
        field = fields.get(name) or fields.get(name.removesuffix("_"))
        if field is None:
            raise SerializationError(
                root,
                path + name,
                f"{message_type.name} has no such field; it has {', '.join(fields) or 'none'}",
            )
        arguments[attribute(field.name)] = _loose(field, value, root, path + field.name)
    return message_type.cls(**arguments)


def _loose(field: Field, value: Any, root: str, path: str) -> Any:
    message_type = field.message
    if not field.is_array:
        return (
            make_message(message_type, value, root, path + ".")
            if message_type is not None and isinstance(value, Mapping)
            else value
        )
    try:
        if message_type is not None:
            return [
                make_message(message_type, item, root, f"{path}[{index}].")
                if isinstance(item, Mapping)
                else item
                for index, item in enumerate(value)
            ]
        if field.is_bytes:
            return pack_octets(value)
        if field.type in NUMBERS and field.type != "bool":
            code = NUMBERS[field.type].code
            return unpack_numbers(code, pack_numbers(code, value))
        return list(value)
    except FAULTS as error:
        if isinstance(error, SerializationError):
            raise
        raise array_fault(field, value, root, path) from error


def _default_value(field: Field) -> Any:
    """Return a new default of a field: zero, empty, or a message of defaults."""
    if field.is_array:
        length = field.length or 0
        if field.is_bytes:
            return bytes(length)
        if field.type in NUMBERS and field.type != "bool":
            number = NUMBERS[field.type]
            return array(number.code, bytes(number.size * length))
        return [_default_element(field) for _ in range(length)]
    return _default_element(field)


def _default_element(field: Field) -> Any:
    if field.message is not None:
        return field.message.cls()
    if field.type in STAMPS:
        return Time() if field.type == "time" else Duration()
    if field.type == "string":
        return ""
    if field.type == "bool":
        return False
    return 0.0 if NUMBERS[field.type].is_float else 0
