"""What the command lines of the task sets have in common."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Annotated

import typer

from rce.config import logs

if TYPE_CHECKING:
    from rce.config.settings import EngineSettings

Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Log more: --log-level debug.")]


def start_logging(settings: EngineSettings, *, verbose: bool = False) -> None:
    """Log to the standard error stream as all programs of the engine do."""
    level = logging.DEBUG if verbose else settings.log_level.value.upper()
    logs.start_logging(level)
