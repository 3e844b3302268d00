"""Message and service types, and the objects that hold messages."""

from __future__ import annotations

import keyword
from array import array
from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from rce.ros.types.definition import PART_HEADER, SEPARATOR, checksum_text, md5
from rce.ros.types.exceptions import UnknownType
from rce.ros.types.values import BUILTINS, BYTES_TYPES, NUMBERS, STAMPS, Duration, Time

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rce.ros.types.definition import Constant, Definition, RawField

Buffer = bytes | bytearray | memoryview
"""What a serialized message is read from."""

LARGE = 1 << 16
"""Bytes above which a message is read through a view: slicing it copies nothing."""


class Field(NamedTuple):
    """A field of a message type."""

    name: str
    type: str
    """A built-in type (``uint8``, ``string``, ``time`` ...) or a message type; without brackets."""
    is_array: bool
    length: int | None
    """Number of elements of a fixed array; None for a variable array or no array."""
    message: MessageType | None
    """The type of the field's message or messages; None for built-in types."""

    @property
    def declared(self) -> str:
        """The type as a definition writes it, such as ``float64[36]``."""
        if not self.is_array:
            return self.type
        return f"{self.type}[{'' if self.length is None else self.length}]"

    @property
    def is_bytes(self) -> bool:
        """Whether the value is held as ``bytes``."""
        return self.is_array and self.type in BYTES_TYPES


class Message:
    """Base of the generated classes that hold messages; one slot per field."""

    __slots__ = ()
    _type: ClassVar[MessageType]

    def __eq__(self, other: object) -> bool:
        if other.__class__ is not self.__class__:
            return NotImplemented
        slots: tuple[str, ...] = self.__class__.__slots__
        return all(getattr(self, slot) == getattr(other, slot) for slot in slots)

    __hash__ = None  # type: ignore[assignment]  # messages can be changed

    def __repr__(self) -> str:
        slots: tuple[str, ...] = self.__class__.__slots__
        values = ", ".join(f"{slot}={getattr(self, slot)!r}" for slot in slots)
        return f"{self._type.name}({values})"

    if TYPE_CHECKING:
        # Fields are known at run time only.
        def __init__(self, *args: Any, **values: Any) -> None: ...
        def __getattr__(self, name: str) -> Any: ...
        def __setattr__(self, name: str, value: Any) -> None: ...


class MessageType:
    """A ROS message type: its definition and the codec of its messages.

    Attributes:
        name: ``package/Type``.
        fields: The fields in the order of the wire.
        constants: The constants; they are attributes of :attr:`cls` too.
        own_text: The definition without the parts of other types.
    """

    def __init__(self, definition: Definition, resolve: Callable[[str], MessageType]) -> None:
        self.name = definition.name
        self.own_text = definition.text
        self.constants: tuple[Constant, ...] = definition.constants
        self.fields = tuple(_field(raw, definition, resolve) for raw in definition.fields)
        nested = {field.message.name: field.message for field in self.fields if field.message is not None}
        self.checksum_text = checksum_text(definition, lambda name: nested[name].md5sum)
        self.md5sum = md5(self.checksum_text)

    def __repr__(self) -> str:
        return f"<MessageType {self.name} {self.md5sum}>"

    @cached_property
    def definition(self) -> str:
        """The full text: the own text and a part per type that is used, as ROS's ``gendeps --cat`` has it."""
        parts = [self.own_text + "\n"]
        parts += (f"{SEPARATOR}\n{PART_HEADER}{kind.name}\n{kind.own_text}\n" for kind in self.dependencies)
        return "".join(parts).removesuffix("\n")

    @cached_property
    def dependencies(self) -> tuple[MessageType, ...]:
        """Every message type that is used, directly or not, depth first, each once."""
        return tuple({needed.name: needed for needed in self._walk()}.values())

    def _walk(self) -> Iterator[MessageType]:
        for field in self.fields:
            if field.message is not None:
                yield field.message
                yield from field.message.dependencies

    @cached_property
    def min_size(self) -> int:
        """Bytes of the shortest message on the wire."""
        return sum(_min_size(field) for field in self.fields)

    @cached_property
    def cls(self) -> type[Message]:
        """The class that holds messages of this type.

        Its constructor takes the fields by position or by name; a field that is left out has its default:
        zero, empty, or a message of defaults. A field whose name is a Python keyword gets a ``_`` at its end.
        """
        from rce.ros.types.objects import make_class

        return make_class(self)

    @cached_property
    def _codec(self) -> tuple[Callable[[Message], bytes], Callable[[Buffer], Message]]:
        from rce.ros.types.objects import make_codec

        return make_codec(self)

    def new(self, /, **values: Any) -> Message:
        """Make a message; nested messages may be given as dicts, arrays as any sequence.

        Raises:
            SerializationError: There is no such field, or a value cannot be made into what the field holds.
        """
        from rce.ros.types.objects import make_message

        return make_message(self, values, self.name, "")

    def serialize(self, message: Message | Mapping[str, Any]) -> bytes:
        """Turn a message, or a mapping of its fields, into its bytes on the wire.

        Raises:
            SerializationError: A value does not fit its field.
        """
        if isinstance(message, Mapping):
            message = self.new(**message)
        return self._codec[0](message)

    def deserialize(self, buffer: Buffer) -> Message:
        """Read a message from exactly the bytes of ``buffer``; nothing of the result shares its memory.

        Raises:
            SerializationError: The buffer is too short or too long, or a string is not UTF-8.
        """
        return self._codec[1](buffer)


class ServiceType:
    """A ROS service type.

    Attributes:
        name: ``package/Type``.
        request: Type of the requests.
        response: Type of the responses.
        md5sum: Checksum that both sides of a connection compare.
    """

    def __init__(self, name: str, request: MessageType, response: MessageType) -> None:
        self.name = name
        self.request = request
        self.response = response
        self.md5sum = md5(request.checksum_text, response.checksum_text)

    def __repr__(self) -> str:
        return f"<ServiceType {self.name} {self.md5sum}>"


def attribute(name: str) -> str:
    """Return the attribute that holds a field: its name, with a ``_`` at the end of a Python keyword."""
    return f"{name}_" if keyword.iskeyword(name) else name


def default_value(field: Field) -> Any:
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


def _min_size(field: Field) -> int:
    if field.is_array and field.length is None:
        return 4
    return element_min_size(field) * (field.length if field.length is not None else 1)


def element_min_size(field: Field) -> int:
    """Return the bytes of the shortest value, or of the shortest element of an array."""
    if field.message is not None:
        return field.message.min_size
    if field.type in NUMBERS:
        return NUMBERS[field.type].size
    return 8 if field.type in STAMPS else 4


def _field(raw: RawField, definition: Definition, resolve: Callable[[str], MessageType]) -> Field:
    message = None
    if raw.type not in BUILTINS:
        try:
            message = resolve(raw.type)
        except UnknownType as error:
            raise UnknownType(error.name, f"{error.hint} (used at {definition.source}:{raw.line})") from error
    return Field(raw.name, raw.type, raw.is_array, raw.length, message)
