"""How all programs of the engine log, so that no password, token or secret gets into a log."""

from __future__ import annotations

import logging
import re

FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"

_TALKATIVE = ("websockets", "aiosqlite", "aiohttp", "asyncio", "httpx", "urllib3")
"""Libraries that tell in detail what they carry: requests with credentials, rows with hashes."""

_CREDENTIALS = re.compile(
    r"""
    (?P<query> \b (?: password | token | secret ) = ) [^\s&"'#]+
    | (?P<header> \b (?: bearer | basic ) \s+ ) [^\s"']{8,}
    | (?P<token> \b rce_ ) [A-Za-z0-9_-]{40,}
    """,
    re.VERBOSE | re.IGNORECASE,
)


class RedactingFormatter(logging.Formatter):
    """Formats a record, traceback included, with ``***`` in place of what looks like a credential."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line or lines of a record."""
        return redact(super().format(record))


def redact(text: str) -> str:
    """Return a text with ``***`` in place of passwords, tokens and secrets in URLs and headers."""
    return _CREDENTIALS.sub(lambda found: f"{found[found.lastgroup or 0]}***", text)


def start_logging(level: int | str, *, line: str = FORMAT) -> None:
    """Log to the standard error stream.

    Args:
        line: How a line looks, as :mod:`logging` writes formats.
        level: The least level that is written. Libraries that would tell credentials stay at warnings.
    """
    handler = logging.StreamHandler()
    handler.setFormatter(RedactingFormatter(line))
    logging.basicConfig(level=level, handlers=[handler])
    for name in _TALKATIVE:
        logging.getLogger(name).setLevel(logging.WARNING)
