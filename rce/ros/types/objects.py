"""Messages as objects: their classes, their codec, and which field is at fault when a codec fails."""

from __future__ import annotations

import keyword
import struct
import sys
from array import array
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rce.ros.types.codegen import FAULTS, Code, ReaderBuilder, WriterBuilder
from rce.ros.types.exceptions import SerializationError
from rce.ros.types.message import Message, default_value
from rce.ros.types.values import NUMBERS, STAMPS, Duration, Time

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rce.ros.types.codegen import Reader
    from rce.ros.types.message import Buffer, Field, MessageType

_SIGNED, _UNSIGNED, _FLOATS = frozenset("bhilq"), frozenset("BHILQ"), frozenset("fd")
_BOOL_BYTES = {False: 0, True: 1}
_UNSET: Any = object()


def attribute(name: str) -> str:
    """Return the attribute that holds a field: its name, with a ``_`` at the end of a Python keyword."""
    return f"{name}_" if keyword.iskeyword(name) else name


def make_class(kind: MessageType) -> type[Message]:
    """Make the class that holds messages of ``kind``."""
    slots = tuple(attribute(field.name) for field in kind.fields)
    code = Code()
    unset = code.bind(_UNSET)
    arguments = []
    for slot, field in zip(slots, kind.fields, strict=True):
        default = default_value(field)
        if isinstance(default, (bool, int, float, str, bytes)):
            arguments.append(f"{slot}={code.bind(default)}")
            code.line(f"self.{slot} = {slot}")
        else:
            arguments.append(f"{slot}={unset}")
            make = code.bind(lambda field=field: default_value(field))
            code.line(f"self.{slot} = {make}() if {slot} is {unset} else {slot}")
    code.line("pass")
    init = code.compile(f"__init__({', '.join(['self', *arguments])})", f"class of {kind.name}")
    body: dict[str, Any] = {attribute(constant.name): constant.value for constant in kind.constants}
    body |= {"__slots__": slots, "__init__": init, "_type": kind, "__doc__": f"A message of type {kind.name}."}
    return type(kind.name.rpartition("/")[2], (Message,), body)


def make_codec(kind: MessageType) -> tuple[Callable[[Message], bytes], Callable[[Buffer], Message]]:
    """Make the functions that serialize and deserialize objects of ``kind``."""
    write, read, cls = _writer_of(kind), _reader_of(kind), kind.cls

    def serialize(message: Message) -> bytes:
        if message.__class__ is not cls:
            message = _same_type(kind, message)
        try:
            data: bytes = write(message, None)
        except FAULTS as error:
            find_fault(kind, message, kind.name)
            raise SerializationError(kind.name, "", str(error) or "the message does not fit its type") from error
        return data

    def deserialize(buffer: Buffer) -> Message:
        try:
            message, end = read(buffer, 0)
        except FAULTS as error:
            raise read_fault(kind, buffer) from error
        if end != len(buffer):
            raise read_fault(kind, buffer)
        result: Message = message
        return result

    return serialize, deserialize


def _same_type(kind: MessageType, message: object) -> Message:
    """Accept a message of an equal type of another registry."""
    if isinstance(message, Message) and message._type.md5sum == kind.md5sum:  # noqa: SLF001
        return message
    name = message._type.name if isinstance(message, Message) else type(message).__name__  # noqa: SLF001
    raise SerializationError(kind.name, "", f"a {name} is not a {kind.name}")


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

    def message(self, code: Code, kind: MessageType, values: Sequence[str]) -> str:
        return f"{code.bind(kind.cls)}({', '.join(values)})"


class _ObjectWriting:
    """Values are taken from the attributes of message objects."""

    def open(self, code: Code, kind: MessageType, holder: str) -> None:
        pass

    def close(self, code: Code, kind: MessageType, holder: str) -> None:
        pass

    def take(self, code: Code, field: Field, holder: str) -> str:
        del code
        return f"{holder}.{attribute(field.name)}"

    def number(self, code: Code, field: Field, value: str) -> tuple[str, str]:
        if field.type == "bool":
            return "B", f"{code.bind(_BOOL_BYTES)}[{value}]"
        return NUMBERS[field.type].code, value

    def stamp(self, code: Code, field: Field, value: str) -> tuple[str, str]:
        del field
        variable = code.variable()
        code.line(f"{variable} = {value}")
        return f"{variable}.secs", f"{variable}.nsecs"

    def octets(self, code: Code, value: str) -> str:
        return f"{code.bind(pack_octets)}({value})"

    def numbers(self, code: Code, field: Field, value: str) -> str:
        return f"{code.bind(pack_bools if field.type == 'bool' else pack_numbers)}({_number_arguments(field, value)})"

    def sequence(self, code: Code, value: str) -> str:
        del code
        return value


def _number_arguments(field: Field, value: str) -> str:
    return value if field.type == "bool" else f"{NUMBERS[field.type].code!r}, {value}"


def _reader_of(kind: MessageType) -> Reader:
    return ReaderBuilder(_ObjectReading(), _reader_of).build(kind)


def _writer_of(kind: MessageType) -> Any:
    return WriterBuilder(_ObjectWriting(), _writer_of).build(kind)


def unpack_numbers(code: str, chunk: Buffer) -> array[Any]:
    """Read an array of numbers from its bytes on the wire."""
    values = array(code, bytes(chunk))
    if sys.byteorder == "big":
        values.byteswap()
    return values


def pack_numbers(code: str, values: Any) -> bytes:
    """Turn a sequence, an array or a numpy array of numbers into its bytes on the wire."""
    if not (values.__class__ is array and values.typecode == code):
        try:
            view = memoryview(values)
        except TypeError:
            values = array(code, list(values))
        else:
            fits = view.ndim == 1 and view.itemsize == struct.calcsize(code) and _same_kind(code, view.format)
            values = view if fits else array(code, list(values))
    if sys.byteorder == "big":
        values = array(code, values)
        values.byteswap()
    data: bytes = values.tobytes()
    return data


def _same_kind(code: str, other: str) -> bool:
    return any(code in kind and other in kind for kind in (_SIGNED, _UNSIGNED, _FLOATS))


def pack_bools(values: Any) -> bytes:
    """Turn a sequence of bools into its bytes on the wire."""
    return bytes([_BOOL_BYTES[value] for value in values])


def pack_octets(values: Any) -> bytes:
    """Turn bytes, an object that holds bytes, or a sequence of integers from 0 to 255 into bytes."""
    if values.__class__ is bytes:
        data: bytes = values
        return data
    try:
        view = memoryview(values)
    except TypeError:
        return bytes(list(values))
    return view.tobytes() if view.itemsize == 1 else bytes(list(values))


# -- messages from loose values ----------------------------------------------------------------------------------


def make_message(kind: MessageType, values: Mapping[str, Any], root: str, path: str) -> Message:
    """Make a message of a mapping of its fields; nested messages may be mappings too."""
    fields = {field.name: field for field in kind.fields}
    arguments = {}
    for name, value in values.items():
        field = fields.get(name) or fields.get(name.removesuffix("_"))
        if field is None:
            raise SerializationError(root, path + name, f"{kind.name} has no such field; it has {', '.join(fields) or 'none'}")
        arguments[attribute(field.name)] = _loose(field, value, root, path + field.name)
    return kind.cls(**arguments)


def _loose(field: Field, value: Any, root: str, path: str) -> Any:
    kind = field.message
    if not field.is_array:
        return make_message(kind, value, root, path + ".") if kind is not None and isinstance(value, Mapping) else value
    try:
        if kind is not None:
            return [
                make_message(kind, item, root, f"{path}[{index}].") if isinstance(item, Mapping) else item
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
        raise _array_fault(field, value, root, path) from error


# -- who is to blame ---------------------------------------------------------------------------------------------


def find_fault(kind: MessageType, message: Any, root: str, path: str = "") -> None:
    """Walk a message that could not be serialized.

    Raises:
        SerializationError: Of the first field whose value does not fit. Returns if there is none.
    """
    for field in kind.fields:
        where = path + field.name
        try:
            value = getattr(message, attribute(field.name))
        except AttributeError:
            raise SerializationError(root, where, f"{_short(message)} is not a {kind.name}") from None
        if field.is_array:
            fault = _array_fault(field, value, root, where)
            if fault.reason:
                raise fault
        else:
            _check_element(field, value, root, where)


def _array_fault(field: Field, value: Any, root: str, path: str) -> SerializationError:
    """Return the fault of an array; its reason is empty if there is none."""
    try:
        items = list(value)
    except TypeError:
        return SerializationError(root, path, f"{_short(value)} is not a {field.declared}")
    if isinstance(value, str):
        return SerializationError(root, path, f"{_short(value)} is not a {field.declared}")
    if field.length is not None and len(items) != field.length:
        return SerializationError(root, path, f"has {len(items)} elements, {field.declared} has {field.length}")
    for index, item in enumerate(items):
        try:
            _check_element(field, item, root, f"{path}[{index}]")
        except SerializationError as fault:
            return fault
    return SerializationError(root, path, "")


def _check_element(field: Field, value: Any, root: str, path: str) -> None:
    if field.message is not None:
        if not isinstance(value, Message):
            raise SerializationError(root, path, f"{_short(value)} is not a {field.type}")
        find_fault(field.message, value, root, path + ".")
        return
    reason = scalar_fault(field.type, value)
    if reason:
        raise SerializationError(root, path, reason)


def scalar_fault(type_name: str, value: Any) -> str:
    """Tell why ``value`` does not fit a built-in type; empty if it does."""
    try:
        if type_name == "string":
            value.encode()
        elif type_name in STAMPS:
            struct.pack("<" + "".join(STAMPS[type_name]), value.secs, value.nsecs)
        elif type_name == "bool":
            _BOOL_BYTES[value]
        else:
            struct.pack("<" + NUMBERS[type_name].code, value)
    except UnicodeEncodeError as error:
        return f"cannot be written as UTF-8: {error.reason}"
    except (struct.error, OverflowError, *FAULTS):
        number = NUMBERS.get(type_name)
        if number is not None and isinstance(value, (int, float)) and (number.is_float or isinstance(value, int)):
            return f"{_short(value)} is out of the range of {type_name}"
        return f"{_short(value)} is not a {type_name}"
    return ""


def _short(value: object) -> str:
    """Return a repr that fits a line and costs no more than that."""
    if isinstance(value, (str, bytes)):
        value = value[:41]
    elif isinstance(value, int) and value.bit_length() > 200:  # noqa: PLR2004  # str() of huge integers is refused
        return f"an integer of {value.bit_length()} bits"
    elif not isinstance(value, (int, float)):
        return f"a {type(value).__name__}" if value is not None else "None"
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."  # noqa: PLR2004


def read_fault(kind: MessageType, buffer: Buffer) -> SerializationError:
    """Find out why ``buffer`` is not a message of ``kind``."""
    try:
        end = _walk(kind, memoryview(buffer).cast("B"), 0, kind.name, "")
    except SerializationError as fault:
        return fault
    return SerializationError(kind.name, "", f"{len(buffer) - end} bytes too many: {len(buffer)}, the message has {end}")


def _walk(kind: MessageType, buffer: memoryview, position: int, root: str, path: str) -> int:
    for field in kind.fields:
        position = _walk_field(field, buffer, position, root, path + field.name)
    return position


def _walk_field(field: Field, buffer: memoryview, position: int, root: str, path: str) -> int:
    if not field.is_array:
        return _walk_element(field, buffer, position, root, path)
    count = field.length
    if count is None:
        count, position = _length(buffer, position, root, path)
    if field.message is None and field.type != "string":
        size = 8 if field.type in STAMPS else NUMBERS[field.type].size
        return _skip(buffer, position, count * size, root, path)
    if field.message is not None and field.message.min_size == 0 and count:
        raise SerializationError(root, path, f"has {count} elements without content")
    for index in range(count):
        position = _walk_element(field, buffer, position, root, f"{path}[{index}]")
    return position


def _walk_element(field: Field, buffer: memoryview, position: int, root: str, path: str) -> int:
    if field.message is not None:
        return _walk(field.message, buffer, position, root, path + ".")
    if field.type == "string":
        size, position = _length(buffer, position, root, path)
        end = _skip(buffer, position, size, root, path)
        try:
            str(buffer[position:end], "utf-8")
        except UnicodeDecodeError as error:
            raise SerializationError(root, path, f"is not UTF-8: {error.reason}") from None
        return end
    return _skip(buffer, position, 8 if field.type in STAMPS else NUMBERS[field.type].size, root, path)


def _length(buffer: memoryview, position: int, root: str, path: str) -> tuple[int, int]:
    end = _skip(buffer, position, 4, root, path)
    return int.from_bytes(buffer[position:end], "little"), end


def _skip(buffer: memoryview, position: int, size: int, root: str, path: str) -> int:
    end = position + size
    if end > len(buffer):
        raise SerializationError(root, path, f"the message ends after {len(buffer)} bytes, {end - len(buffer)} are missing")
    return end
