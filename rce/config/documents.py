"""Reads JSON or YAML text into plain values, and finds duplicate keys, which a parser would accept."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from rce.config.exceptions import ConfigError, Fault

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

_MAX_SIZE = 4 * 2**20


def read_file(path: Path) -> str:
    """Read a text file, up to a limit of size.

    Raises:
        ConfigError: It cannot be read.
    """
    try:
        with path.open("rb") as file:
            raw = file.read(_MAX_SIZE + 1)
        if len(raw) > _MAX_SIZE:
            raise ConfigError(str(path), [Fault("", f"is longer than {_MAX_SIZE} bytes")])
        return raw.decode("utf-8-sig")
    except OSError as error:
        raise ConfigError(str(path), [Fault("", f"cannot be read: {error.strerror}")]) from error
    except UnicodeDecodeError as error:
        raise ConfigError(str(path), [Fault("", f"is not UTF-8 at byte {error.start}")]) from error


def parse(text: str, source: str) -> Any:
    """Read JSON (text that starts with a brace or a file named ``.json``) or YAML.

    Args:
        text: The text.
        source: Its file's name, for errors.

    Raises:
        ConfigError: It is not JSON or YAML, or has duplicate keys.
    """
    if source.endswith(".json") or (
        text.lstrip().startswith(("{", "[")) and not source.endswith((".yaml", ".yml"))
    ):
        return _parse_json(text, source)
    from rce.config.yaml_documents import parse_yaml  # programs that are handed their settings need none

    return parse_yaml(text, source)


class _Object(dict[str, Any]):
    """A JSON object that knows its duplicate keys."""

    repeated: tuple[str, ...] = ()


def _make_object(pairs: list[tuple[str, Any]]) -> _Object:
    made = _Object(pairs)
    if len(made) != len(pairs):
        keys = [key for key, _ in pairs]
        made.repeated = tuple(key for key in made if keys.count(key) > 1)
    return made


def _parse_json(text: str, source: str) -> Any:
    try:
        value = json.loads(text, object_pairs_hook=_make_object)
    except json.JSONDecodeError as error:
        place = f"line {error.lineno}, column {error.colno}"
        raise ConfigError(source, [Fault(place, f"not valid JSON: {error.msg}")]) from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(source, [Fault("", f"not valid JSON: {error}")]) from error
    faults = list(_repeated_keys(value, ""))
    if faults:
        raise ConfigError(source, faults)
    return value


def _repeated_keys(value: Any, place: str) -> Iterator[Fault]:
    if isinstance(value, _Object):
        for key in value.repeated:
            yield Fault(join(place, key), "is given more than once")
        for key, inner in value.items():
            yield from _repeated_keys(inner, join(place, key))
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from _repeated_keys(inner, join(place, index))


def write_items(data: Mapping[str, Any]) -> str:
    """Write a document as JSON, with a line for each item of its lists."""
    lines = []
    for key, value in data.items():
        if isinstance(value, list | tuple) and value:
            items = ",\n".join(f"        {json.dumps(item)}" for item in value)
            lines.append(f'    "{key}": [\n{items}\n    ]')
        else:
            lines.append(f'    "{key}": {json.dumps(value)}')
    return "{\n" + ",\n".join(lines) + "\n}\n"


def join(place: str, step: str | int) -> str:
    """Extend a place by a key or an index: ``nodes`` and 2 make ``nodes[2]``."""
    if isinstance(step, int):
        return f"{place}[{step}]"
    return f"{place}.{step}" if place else step
