"""What the command lines of the task sets have in common."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rce.config.settings import EngineSettings

Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Log more: --log-level debug.")]

_FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"
_SECRETIVE = ("websockets", "aiosqlite")
"""What these tell in detail holds the secret, tokens and hashes."""


def start_logging(settings: EngineSettings, *, verbose: bool = False) -> None:
    """Log to the standard error stream as all programs of the engine do."""
    level = logging.DEBUG if verbose else settings.log_level.value.upper()
    logging.basicConfig(level=level, format=_FORMAT)
    for name in _SECRETIVE:
        logging.getLogger(name).setLevel(logging.WARNING)
