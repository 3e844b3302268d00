"""Limits on the data of one client, and on the time that the engine waits for the rest of a message."""

from __future__ import annotations

from dataclasses import dataclass

MAX_MESSAGE_ID_LENGTH = 255
"""Longest ``msgID`` of a data message, in characters."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of one connection."""

    max_text: int = 16 * 2**20
    """Longest text frame: characters if given as ``str``, else bytes."""
    max_elements: int = 200_000
    """Objects, lists and members of objects in one text; counted before it is parsed."""
    max_values: int = 2_000_000
    """All values in one text, those in lists too."""
    max_request: int = 2**20
    """The same for messages other than data messages: one master carries out the requests of all robots."""
    max_binary: int = 64 * 2**20
    """Longest binary frame in bytes, with its id."""
    max_depth: int = 64
    """Deepest nesting of objects and lists; the message itself is depth 1."""
    max_pending_bytes: int = 128 * 2**20
    """Bytes kept of incomplete messages."""
    max_pending: int = 256
    """How many incomplete messages and unclaimed binary values are kept."""
    max_references: int = 4096
    """How many binary values one message may have."""
    expiry: float = 60.0
    """Seconds after which incomplete messages are dropped."""


DEFAULT_LIMITS = Limits()
