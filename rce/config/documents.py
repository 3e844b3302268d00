"""Reads JSON or YAML text into plain values, and finds what a parser would let pass: keys that come twice."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import yaml

from rce.config.exceptions import ConfigError, Fault

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterator
    from pathlib import Path

_MAX_SIZE = 4 * 2**20
_MAX_ALIASES = 100


def read_file(path: Path) -> str:
    """Read a text file of bearable size.

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
        ConfigError: It is no JSON or YAML, or has keys that come twice.
    """
    if source.endswith(".json") or (
        text.lstrip().startswith(("{", "[")) and not source.endswith((".yaml", ".yml"))
    ):
        return _parse_json(text, source)
    return _parse_yaml(text, source)


class _Object(dict[str, Any]):
    """A JSON object that knows which of its keys came twice."""

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
        raise ConfigError(source, [Fault(place, f"no valid JSON: {error.msg}")]) from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(source, [Fault("", f"no valid JSON: {error}")]) from error
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


def join(place: str, step: str | int) -> str:
    """Extend a place by a key or an index: ``nodes`` and 2 make ``nodes[2]``."""
    if isinstance(step, int):
        return f"{place}[{step}]"
    return f"{place}.{step}" if place else step


class _Loader(yaml.SafeLoader):
    """Refuses keys that come twice, and files that blow up by aliases."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._aliases = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.events.AliasEvent):
            self._aliases += 1
            if self._aliases > _MAX_ALIASES:
                mark = self.get_mark()
                raise yaml.MarkedYAMLError(problem="too many aliases", problem_mark=mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen = set()
        for key_node, _ in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, list | dict) or key in seen:
                problem = (
                    f"key {key!r} is given more than once"
                    if not isinstance(key, list | dict)
                    else "no valid key"
                )
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)


def _parse_yaml(text: str, source: str) -> Any:
    try:
        loader = _Loader(text)
        try:
            return loader.get_single_data()
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        place = f"line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        raise ConfigError(source, [Fault(place, f"no valid YAML: {error.problem}")]) from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(source, [Fault("", f"no valid YAML: {error}")]) from error
