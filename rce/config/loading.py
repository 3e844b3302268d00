"""Combines the engine's settings: defaults, the file, and the command line, which overrides it.

One program of the engine hands its settings to the next as a document (:func:`handed_over`).
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from rce.config.documents import parse, read_file
from rce.config.exceptions import ConfigError, Fault
from rce.config.fields import read_section, sections_of, write_section
from rce.config.settings import LOOPBACK, PROGRAM_SECTIONS, EngineSettings

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


_LOOPBACK_ONLY: dict[str, Any] = {
    "master_host": LOOPBACK,
    "master": {"bind": LOOPBACK},
    "robot": {"bind": LOOPBACK, "public_host": LOOPBACK},
    "container": {"bind": LOOPBACK},
}


def load_settings(path: Path | None = None, *over: dict[str, Any]) -> EngineSettings:
    """Read the engine's settings.

    In development mode every program binds loopback only, whatever the file says; the command line
    overrides that.

    Args:
        path: A YAML (or JSON) file; all defaults if None.
        over: Values that were read already (:func:`read_document`), each layer over those before it.

    Raises:
        ConfigError: The file cannot be read, or has faults; every fault is listed.

    Example::

        settings = load_settings(Path("engine.yaml"), {"master": {"http_port": 0}})
    """
    found = {} if path is None else read_document(parse(read_file(path), str(path)), str(path))
    if any(layer.get("dev") for layer in (found, *over)):
        found = _merge(found, _LOOPBACK_ONLY)
    for layer in over:
        found = _merge(found, layer)
    sections = {name: kind(**found.get(name, {})) for name, kind in sections_of(EngineSettings).items()}
    return EngineSettings(**found | sections)


def read_document(data: Any, source: str) -> dict[str, Any]:
    """Check a document of settings.

    Args:
        data: Plain values, as JSON or YAML gives them.
        source: Where they come from, for errors.

    Returns:
        The values that it sets, section by section.

    Raises:
        ConfigError: The document has faults; every fault is listed.
    """
    if data is not None and not isinstance(data, dict):
        raise ConfigError(
            source, [Fault("", "must be a mapping with the keys master, robot, container, ...")]
        )
    faults: list[Fault] = []
    found = read_section(EngineSettings, data, "", faults, PROGRAM_SECTIONS)
    if faults:
        raise ConfigError(source, list(dict.fromkeys(faults)))
    return found


def as_document(settings: EngineSettings) -> dict[str, Any]:
    """Return the settings as plain values for another program: only the differences to its defaults."""
    base = load_settings(None, {"dev": settings.dev})
    return write_section(settings, base) | ({"dev": True} if settings.dev else {})


def _merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        inner = key in sections_of(EngineSettings)
        merged[key] = merged.get(key, {}) | value if inner else value
    return merged


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
