"""Reads the texts of a user's limits (pure)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce.model import read_cores, read_memory
from rce_master.exceptions import InvalidRequestError

if TYPE_CHECKING:
    from collections.abc import Callable

DEFAULT = "default"
"""The text for the limit of all users."""
_MOST = 10**9


def read_limit(kind: str, value: object) -> float | None:
    """Return a limit as a number; None for the limit of all users.

    Args:
        kind: One of :data:`rce_master.state.limits.KINDS`.
        value: A number, or a text such as ``8G``.

    Raises:
        InvalidRequestError: It is not an amount of this kind.

    Example:
        >>> read_limit("containers", "16"), read_limit("memory", "default")
        (16, None)
    """
    if value == DEFAULT:
        return None
    try:
        return _READERS.get(kind, _count)(value)
    except ValueError as error:
        raise InvalidRequestError(f"{kind}: {error}") from None


def _count(value: object) -> float:
    if isinstance(value, str) and value.isascii() and value.isdecimal() and len(value) <= _DIGITS:
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= _MOST:
        raise ValueError(f"must be a whole number from 0 to {_MOST}, or {DEFAULT}")
    return value


_DIGITS = 20
"""Maximum number of digits. Python reads at most 4300; the largest limit has fewer."""
_READERS: dict[str, Callable[[object], float]] = {
    "cpu": read_cores,
    "memory": read_memory,
    "disk": read_memory,
}
