"""Telling messages of a later release from wrong ones, where messages are JSON objects tagged by ``t``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, NamedTuple, TypeVar, get_args

import msgspec
from msgspec import Struct

T = TypeVar("T")


class Unknown(NamedTuple):
    """Stands for a message of a later release, which is passed over."""

    name: str


class _Tagged(Struct):
    t: str


_tag_of = msgspec.json.Decoder(_Tagged).decode


class TaggedReader(Generic[T]):
    """Reads the messages of a union, and recognizes those of a later release.

    Args:
        union: The union of :class:`msgspec.Struct` types, each tagged by its name.
    """

    def __init__(self, union: Any) -> None:
        self._decode: Callable[[str | bytes], T] = msgspec.json.Decoder(union).decode
        self._names = frozenset(kind.__name__ for kind in get_args(union))

    def read(self, text: str | bytes) -> T | Unknown:
        """Read a message.

        Raises:
            msgspec.DecodeError: The data is not a message; the text names the place.
        """
        try:
            return self._decode(text)
        except msgspec.ValidationError:
            name = self._tag(text)
            if name is None or name in self._names:
                raise
            return Unknown(name[:100])

    @staticmethod
    def _tag(text: str | bytes) -> str | None:
        try:
            return _tag_of(text).t
        except msgspec.MsgspecError:
            return None
