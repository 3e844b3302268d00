"""Reads YAML text into plain values."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import yaml

from rce.config.exceptions import ConfigError, Fault

if TYPE_CHECKING:
    from collections.abc import Hashable

_MAX_ALIASES = 100


class _Loader(yaml.SafeLoader):
    """Refuses duplicate keys, and files that grow too large by aliases."""

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


def parse_yaml(text: str, source: str) -> Any:
    """Read YAML.

    Args:
        text: The text.
        source: Its file's name, for errors.

    Raises:
        ConfigError: It is not YAML, or has duplicate keys.
    """
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
