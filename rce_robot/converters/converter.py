"""Converters: messages of one type between their JSON form and their bytes on the wire.

The JSON form of a message is an object of its fields:

- a missing field takes its default; an unknown field is ignored and told of;
- numbers are JSON numbers in the range of the field's type, ``bool`` is true or false, nothing is turned into
  another type (an integer where a float belongs is one); integers of 64 bits are exact;
- ``time`` and ``duration``: see :mod:`rce_robot.converters.stamps`; NaN and infinities:
  :mod:`rce_robot.converters.values`;
- arrays are lists, of the right length where it is fixed;
- ``uint8[]`` and ``char[]`` leave as binary values (views of the message's bytes) and come as binary value,
as
  base64 string or as list;
- messages of classes that have a custom converter (:mod:`rce_robot.converters.custom`) leave in its form and
come in
  its form or as their fields.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rce.ros.types.codegen import FAULTS
from rce.ros.types.faults import read_fault
from rce.ros.types.fields import LARGE
from rce.ros.types.readers import LenientReader
from rce_robot.converters.codec import make_reader, make_writer
from rce_robot.converters.custom import CustomConverter, load_custom_converters
from rce_robot.converters.faults import find_fault, unknown_fields
from rce_robot.exceptions import ConversionError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rce.ros.types import Buffer, MessageType


class Converter:
    """Converts the messages of one type; made once per type, because it compiles a codec.

    Args:
        kind: The type.
        customs: Custom converters by class; None for those that are installed.
    """

    def __init__(self, kind: MessageType, customs: Mapping[str, CustomConverter] | None = None) -> None:
        self.kind = kind
        self._customs = load_custom_converters() if customs is None else customs
        self._read = make_reader(kind, self._customs)
        self._read_lenient = LenientReader(kind.name, lambda: make_reader(kind, self._customs, "replace"))
        self._write = make_writer(kind, self._customs)

    def __repr__(self) -> str:
        return f"<Converter {self.kind.name}>"

    @property
    def is_costly(self) -> bool:
        """Whether a conversion may take long, because it includes a custom converter."""
        names = {self.kind.name, *(needed.name for needed in self.kind.dependencies)}
        return not names.isdisjoint(self._customs)

    def decode(self, value: Any, /) -> tuple[bytes, tuple[str, ...]]:
        """Turn a JSON value into the message's bytes.

        Args:
            value: The robot's value, with binary values in their places.

        Returns:
            The serialized message, and the paths of unknown fields, such as ``header.foo`` or
            ``poses[].bar``, each once.

        Raises:
            ConversionError: It is not a message of the type; names the field.
        """
        notes: list[bool] = []
        try:
            data = self._write(value, notes)
        except FAULTS as error:
            find_fault(self.kind, value, self._customs)
            raise ConversionError(
                self.kind.name, str(error) or "the message does not fit its type"
            ) from error
        if not notes:
            return data, ()
        return data, tuple(dict.fromkeys(unknown_fields(self.kind, value)))

    def encode(self, payload: Buffer, /) -> Any:
        """Turn a message's bytes into its JSON form.

        Returns:
            An object of the fields, or the result of the class's custom converter. Bytes of a string that are
            not UTF-8 become U+FFFD. Binary values in it are
            ``memoryview`` (of ``payload``, which must not change while they are used) or ``bytes``.

        Raises:
            ConversionError: The bytes are not a message of the type.
        """
        if len(payload) > LARGE:
            payload = memoryview(payload)
        try:
            try:
                value, end = self._read(payload, 0)
            except UnicodeDecodeError:
                value, end = self._read_lenient(payload, 0)
        except FAULTS as error:
            raise self._unreadable(payload) from error
        if end != len(payload):
            raise self._unreadable(payload)
        return value

    def _unreadable(self, payload: Buffer) -> ConversionError:
        fault = read_fault(self.kind, payload)
        return ConversionError(fault.field or self.kind.name, fault.reason)


class Converters:
    """The converters of a process, each made once.

    Args:
        customs: Custom converters by class; None for those that are installed.
    """

    def __init__(self, customs: Mapping[str, CustomConverter] | None = None) -> None:
        self._customs = customs
        self._converters: dict[MessageType, Converter] = {}

    def of(self, kind: MessageType) -> Converter:
        """Return the converter of a message type, or of a service's request or response."""
        found = self._converters.get(kind)
        if found is None:
            if self._customs is None:
                self._customs = load_custom_converters()
            found = self._converters[kind] = Converter(kind, self._customs)
        return found
