"""Logging of all programs of the engine, without passwords, tokens and secrets."""

from __future__ import annotations

import logging
import re
from typing import TYPE_CHECKING

from rce.config.exceptions import LogFileError

if TYPE_CHECKING:
    from pathlib import Path

    from rce.config.settings import EngineSettings

FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"

_TALKATIVE = ("websockets", "aiosqlite", "aiohttp", "asyncio", "httpx", "urllib3")
"""Libraries whose detailed logs contain their data: requests with credentials, rows with hashes."""

_CREDENTIALS = re.compile(
    r"""
    (?P<query> \b (?: password | token | secret ) = ) [^\s&"'#]+
    | (?P<header> \b (?: bearer | basic ) \s+ ) [^\s"']{8,}
    | (?P<token> \b rce_ ) [A-Za-z0-9_-]{40,}
    """,
    re.VERBOSE | re.IGNORECASE,
)


class RedactingFormatter(logging.Formatter):
    """Formats a record, traceback included, with ``***`` in place of anything like a credential."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line or lines of a record."""
        return redact(super().format(record))


def redact(text: str) -> str:
    """Return a text with ``***`` in place of passwords, tokens and secrets in URLs and headers."""
    return _CREDENTIALS.sub(lambda found: f"{found[found.lastgroup or 0]}***", text)


def start_logging(level: int | str, *, line: str = FORMAT, handler: logging.Handler | None = None) -> None:
    """Log to the standard error stream, or elsewhere.

    Args:
        line: The format of a line, as for :mod:`logging`.
        level: The least level that is written. Libraries that would log credentials stay at warnings.
        handler: Where to; None for the standard error stream.
    """
    handler = handler or logging.StreamHandler()
    handler.setFormatter(RedactingFormatter(line))
    logging.basicConfig(level=level, handlers=[handler])
    for name in _TALKATIVE:
        logging.getLogger(name).setLevel(logging.WARNING)


def log_as(program: str, settings: EngineSettings, *, verbose: bool = False) -> None:
    """Log as all programs of the engine do: to the standard error stream, or to a file that is rotated.

    Args:
        program: Name of the program, and of its file.
        settings: The level and the place of the log.
        verbose: Log all.

    Raises:
        LogFileError: The file cannot be written.
    """
    level = logging.DEBUG if verbose else settings.log_level.value.upper()
    handler = None
    if settings.log_dir is not None:
        path = settings.log_dir / f"{program}.log"
        try:
            handler = rotating_file(path, size=settings.log_size, count=settings.log_count)
        except OSError as error:
            raise LogFileError(f"cannot write the log {path}: {error.strerror}") from error
    start_logging(level, handler=handler)


def rotating_file(path: Path, *, size: int, count: int) -> logging.Handler:
    """Return a handler that writes a file and rotates it when it is large.

    Args:
        path: The file; its folder is made.
        size: Bytes at which it is renamed to ``NAME.1``, that to ``NAME.2``, and so on.
        count: How many of these are kept.

    Raises:
        OSError: It cannot be written.
    """
    from logging.handlers import RotatingFileHandler  # loads pickle and more

    path.parent.mkdir(parents=True, exist_ok=True)
    return RotatingFileHandler(
        path, maxBytes=size, backupCount=count, encoding="utf-8", errors="backslashreplace"
    )
