"""Message and service types."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any

from rce.ros.types.definition import (
    PART_HEADER,
    SEPARATOR,
    Constant,
    Definition,
    RawField,
    checksum_text,
    md5,
)
from rce.ros.types.exceptions import BadDefinitionError, UnknownTypeError
from rce.ros.types.fields import Buffer, Field, min_size, repetitions
from rce.ros.types.objects import make_class, make_codec, make_message
from rce.ros.types.sizes import make_size
from rce.ros.types.values import BUILTINS, Message

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

MAX_ELEMENTS = 1 << 21
"""Most values in a message of defaults: arrays of arrays multiply what each may ask for."""

MAX_HOLLOW_ELEMENTS = 16
"""Most messages without content in one message, beside those in variable arrays."""


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
        self._check_elements(definition)
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
        return sum(min_size(field) for field in self.fields)

    @cached_property
    def elements(self) -> int:
        """Values in a message of defaults, nested messages included: what fixed arrays ask for."""
        return sum(
            repetitions(field) * (1 + (field.message.elements if field.message is not None else 0))
            for field in self.fields
        )

    @cached_property
    def hollow_elements(self) -> int:
        """Messages in one of this type that take no byte on the wire: its length does not bound them."""
        return sum(
            repetitions(field) * (field.message.hollow_elements + (field.message.min_size == 0))
            for field in self.fields
            if field.message is not None
        )

    def _check_elements(self, definition: Definition) -> None:
        """Refuse a type whose fixed arrays would fill the memory, or whose messages read for seconds.

        Raises:
            BadDefinitionError: It holds too many elements.
        """
        if self.elements > MAX_ELEMENTS:
            problem = (
                f"its fixed arrays have {self.elements} elements in all, at most {MAX_ELEMENTS} are allowed"
            )
            raise BadDefinitionError(definition.source, 0, problem)
        if self.hollow_elements > MAX_HOLLOW_ELEMENTS:
            problem = (
                f"it holds {self.hollow_elements} messages without content,"
                f" at most {MAX_HOLLOW_ELEMENTS} are allowed"
            )
            raise BadDefinitionError(definition.source, 0, problem)

    @cached_property
    def cls(self) -> type[Message]:
        """The class that holds messages of this type.

        Its constructor takes the fields by position or by name; a field that is left out has its default:
        zero, empty, or a message of defaults. A field whose name is a Python keyword gets a ``_`` at its end.
        """
        return make_class(self)

    @cached_property
    def _codec(self) -> tuple[Callable[[Message], bytes], Callable[[Buffer], Message]]:
        return make_codec(self)

    @cached_property
    def size(self) -> Callable[[Message], int]:
        """Returns the bytes that a message of :attr:`cls` has on the wire, without writing it.

        Text counts as one byte a character. It does not fail: of a message that cannot be written, it returns
        :attr:`min_size`.
        """
        return make_size(self)

    def new(self, /, **values: Any) -> Message:
        """Make a message; nested messages may be given as dicts, arrays as any sequence.

        Raises:
            SerializationError: A field does not exist, or a value cannot be converted to the field's type.
        """
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

        Bytes of a string that are not UTF-8 become U+FFFD, as in rospy.

        Raises:
            SerializationError: The buffer is too short or too long.
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


def _field(raw: RawField, definition: Definition, resolve: Callable[[str], MessageType]) -> Field:
    message = None
    if raw.type not in BUILTINS:
        try:
            message = resolve(raw.type)
        except UnknownTypeError as error:
            raise UnknownTypeError(
                error.name, f"{error.hint} (used at {definition.source}:{raw.line})"
            ) from error
    return Field(raw.name, raw.type, raw.is_array, raw.length, message)
