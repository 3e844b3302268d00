"""What the command lines of the task sets have in common."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Annotated

import typer

from rce.config import logs

if TYPE_CHECKING:
    from rce.config.settings import EngineSettings

Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Log more: --log-level debug.")]


def start_logging(settings: EngineSettings, program: str, *, verbose: bool = False) -> None:
    """Log as all programs of the engine do: to the standard error stream, or to a file that is rotated.

    Args:
        settings: They say what is logged, and where.
        program: Name of the program, and of its file.
        verbose: Log all.

    Raises:
        typer.Exit: The file cannot be written; why was told.
    """
    level = logging.DEBUG if verbose else settings.log_level.value.upper()
    handler = None
    if settings.log_dir is not None:
        path = settings.log_dir / f"{program}.log"
        try:
            handler = logs.rotating_file(path, size=settings.log_size, count=settings.log_count)
        except OSError as error:
            typer.echo(f"{program}: cannot write the log {path}: {error.strerror}", err=True)
            raise typer.Exit(1) from None
    logs.start_logging(level, handler=handler)
