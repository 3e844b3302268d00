"""Telling messages of a later release from wrong ones, where messages are JSON objects tagged by ``t``."""

from __future__ import annotations

from typing import Any, NamedTuple, get_args

import msgspec
from msgspec import Struct


class Unknown(NamedTuple):
    """Stands for a message of a later release, which is passed over."""

    name: str


class _Tagged(Struct):
    t: str


_decode = msgspec.json.Decoder(_Tagged).decode


def names_of(union: Any) -> frozenset[str]:
    """Return the tags of a union of messages."""
    return frozenset(kind.__name__ for kind in get_args(union))


def unknown(text: str | bytes, names: frozenset[str]) -> Unknown | None:
    """Look at a message that could not be read.

    Args:
        text: The message.
        names: The tags that are known.

    Returns:
        What it is if its tag is not known; None if it is simply wrong.
    """
    try:
        name = _decode(text).t
    except msgspec.MsgspecError:
        return None
    return None if name in names else Unknown(name[:100])
