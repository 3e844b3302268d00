"""The built-in types of ROS 1 and the values that hold them.

A field's value in a message object is: ``bool``, ``int``, ``float`` or ``str``; :class:`Time` or
:class:`Duration`; another message object. An array of numbers is an :class:`array.array` (compact, typed,
``numpy.asarray`` takes it without copying), ``uint8[]`` and ``char[]`` are ``bytes``, any other array is a
list.
"""

from __future__ import annotations

import time
from functools import total_ordering
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

if TYPE_CHECKING:
    from rce.ros.types.message import MessageType

NANOSECONDS = 1_000_000_000


class Number(NamedTuple):
    """A built-in type of fixed size that one Python number holds."""

    code: str
    """Format character of :mod:`struct`; of :mod:`array` too, except for ``bool``."""
    size: int
    """Bytes on the wire."""
    low: int
    high: int
    """Range of the integer types; both zero for floats."""

    @property
    def is_float(self) -> bool:
        """Whether the type holds a float."""
        return self.code in "fd"


def _integer(code: str, size: int, *, signed: bool) -> Number:
    bits = 8 * size
    return (
        Number(code, size, -(1 << bits - 1), (1 << bits - 1) - 1)
        if signed
        else Number(code, size, 0, (1 << bits) - 1)
    )


NUMBERS = {
    "bool": Number("?", 1, 0, 1),
    "int8": _integer("b", 1, signed=True),
    "uint8": _integer("B", 1, signed=False),
    "byte": _integer("b", 1, signed=True),
    "char": _integer("B", 1, signed=False),
    "int16": _integer("h", 2, signed=True),
    "uint16": _integer("H", 2, signed=False),
    "int32": _integer("i", 4, signed=True),
    "uint32": _integer("I", 4, signed=False),
    "int64": _integer("q", 8, signed=True),
    "uint64": _integer("Q", 8, signed=False),
    "float32": Number("f", 4, 0, 0),
    "float64": Number("d", 8, 0, 0),
}
"""Built-in types that are numbers. ``byte`` is an old name of ``int8``, ``char`` of ``uint8``."""

STAMPS = {"time": ("I", "I"), "duration": ("i", "i")}
"""Built-in types made of seconds and nanoseconds, with their :mod:`struct` characters."""

BUILTINS = frozenset(NUMBERS) | frozenset(STAMPS) | {"string"}
"""Every type name that is not a message."""

BYTES_TYPES = frozenset({"uint8", "char"})
"""Types whose arrays are held as ``bytes``."""


@total_ordering
class _Stamp:
    """Seconds and nanoseconds; the base of :class:`Time` and :class:`Duration`."""

    __slots__ = ("nsecs", "secs")
    __hash__ = None  # type: ignore[assignment]  # mutable, as in ROS's own classes

    def __init__(self, secs: int = 0, nsecs: int = 0) -> None:
        self.secs = secs
        self.nsecs = nsecs

    def to_nsec(self) -> int:
        """Return the whole as nanoseconds."""
        return self.secs * NANOSECONDS + self.nsecs

    def to_sec(self) -> float:
        """Return the whole as seconds."""
        return self.to_nsec() / NANOSECONDS

    def __eq__(self, other: object) -> bool:
        if other.__class__ is not self.__class__:
            return NotImplemented
        assert isinstance(other, _Stamp)
        return self.to_nsec() == other.to_nsec()

    def __lt__(self, other: object) -> bool:
        if other.__class__ is not self.__class__:
            return NotImplemented
        assert isinstance(other, _Stamp)
        return self.to_nsec() < other.to_nsec()

    def __bool__(self) -> bool:
        return bool(self.secs or self.nsecs)

    def __repr__(self) -> str:
        return f"{type(self).__name__}(secs={self.secs}, nsecs={self.nsecs})"


class Time(_Stamp):
    """A point in time, as seconds and nanoseconds since 1970 (UTC). Zero means: not set."""

    __slots__ = ()

    @classmethod
    def from_sec(cls, seconds: float) -> Time:
        """Make a time from seconds since 1970."""
        return cls(*divmod(round(seconds * NANOSECONDS), NANOSECONDS))

    @classmethod
    def now(cls) -> Time:
        """Return the machine's clock (not ``/clock``; a node has its own ``now``)."""
        return cls(*divmod(time.time_ns(), NANOSECONDS))


class Duration(_Stamp):
    """A signed length of time. ``nsecs`` is from 0 to 999 999 999 where this class computes it."""

    __slots__ = ()

    @classmethod
    def from_sec(cls, seconds: float) -> Duration:
        """Make a duration from seconds."""
        return cls(*divmod(round(seconds * NANOSECONDS), NANOSECONDS))


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
