"""Snapshots of nodes' states between task sets and the master: what is said on a connection for one. Pure.

A container task set dials a WebSocket at :data:`PATH` of the control port for each snapshot. It sends
:class:`Keep`, is told :class:`Ready`, sends the snapshot in binary messages of at most :data:`PIECE` bytes,
and is told :class:`Kept` once the snapshot is acknowledged; or it sends :class:`Fetch`, is told
:class:`Found`, and gets the snapshot in the same way. :class:`Refusal` answers anything and ends it.
"""

from __future__ import annotations

from typing import TypeAlias

import msgspec
from msgspec import Struct

PATH = "/node-states"
PIECE = 256 << 10
"""Bytes."""


class _Message(Struct, frozen=True, kw_only=True, omit_defaults=True, tag_field="t"):
    """Base of all messages."""

    process: str
    """Name of the task set that asks."""
    id: str
    """Endpoint id of the container."""
    node: str
    """Tag of the node."""


class Fetch(_Message, frozen=True, kw_only=True):
    """Asks for the newest snapshot of a node's state."""


class Keep(_Message, frozen=True, kw_only=True):
    """Asks to keep a snapshot of a node's state."""

    incarnation: str
    """Of the container."""
    number: int
    """Grows from snapshot to snapshot of the incarnation: an older one never takes the place of a newer."""
    size: int
    """Bytes."""
    sha256: str
    """In hex."""


class Ready(Struct, frozen=True, kw_only=True, tag=True, tag_field="t"):
    """The snapshot may be sent."""


class Kept(Struct, frozen=True, kw_only=True, tag=True, tag_field="t"):
    """The snapshot is acknowledged: it is the newest one, also for later masters."""


class Found(Struct, frozen=True, kw_only=True, tag=True, tag_field="t"):
    """The newest snapshot follows, or there is none."""

    size: int = 0
    """Bytes."""
    sha256: str = ""
    """In hex; empty: there is none."""


class Refusal(Struct, frozen=True, kw_only=True, tag=True, tag_field="t"):
    """It is not done."""

    reason: str


Question: TypeAlias = Fetch | Keep
Answer: TypeAlias = Ready | Kept | Found | Refusal

encode = msgspec.json.Encoder().encode
read_question = msgspec.json.Decoder(Question).decode
"""Read what a task set asks; raises :class:`msgspec.DecodeError`."""
read_answer = msgspec.json.Decoder(Answer).decode
"""Read what the master answers; raises :class:`msgspec.DecodeError`."""
