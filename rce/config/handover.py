"""Settings that one program of the engine hands to the next as a document."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from rce.config.exceptions import ConfigError
from rce.config.loading import load_settings, read_document

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce.config.settings import EngineSettings


def handed_over(arguments: Sequence[str], *, master: bool = False) -> EngineSettings | None:
    """Read a command line that consists of ``--settings JSON`` only.

    Args:
        arguments: The command line without the program.
        master: Whether the settings must say where the master is.

    Returns:
        The settings. None if the command line has anything else, or if the document has a fault: then the
        program's own reader of command lines reads it, and reports the fault.
    """
    match arguments:
        case ["--settings", document]:
            pass
        case _:
            return None
    try:
        settings = load_settings(None, read_document(json.loads(document), "--settings"))
    except (json.JSONDecodeError, ConfigError):
        return None
    return None if master and not settings.master_host else settings
