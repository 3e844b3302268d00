"""Who blocked cells, and why, in the form of page and API. Pure.

The planner's messages tell times in seconds from the message on; page and API have seconds since 1970.
"""

from __future__ import annotations

from typing import Any, TypeAlias

Block: TypeAlias = dict[str, Any]
"""``cell``, ``user``, ``robot``, ``reason``, ``since`` and ``until``, as in the API."""
_TEXTS = ("cell", "user", "robot", "reason")
_TIMES = ("since", "until")
_NEAR_S = 2.0
"""Times that differ by so much at most are the same: messages take different times on their way."""


def read_block(message: dict[str, Any], now: float) -> Block:
    """Return who blocked a cell, and why, of a ``fleet/BlockedCell`` in its JSON form.

    Args:
        message: The message.
        now: When it came, seconds since 1970.
    """
    return {
        "cell": message["cell"],
        "user": "" if message["sensed"] else message["by"],
        "robot": message["by"] if message["sensed"] else "",
        "reason": message["reason"],
        "since": round(now - message["age"], 1),
        "until": round(now + message["lifetime"], 1) if message["lifetime"] else None,
    }


def is_same(block: Block, known: Block | None) -> bool:
    """Return whether two readings of a cell's block tell the same."""
    if known is None or any(block[part] != known[part] for part in _TEXTS):
        return False
    return all(
        block[part] == known[part]
        or (None not in (block[part], known[part]) and abs(block[part] - known[part]) <= _NEAR_S)
        for part in _TIMES
    )
