"""Values in launch files: typed texts and YAML, as ``roslaunch`` and ``rosparam`` read them. Pure."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import yaml

from rce.ros.launch.exceptions import LaunchValueError
from rce.ros.launch.expressions import evaluate

MAX_INTEGER = 2**31 - 1
"""Integers of XML-RPC have 32 bits."""


def convert(text: str, kind: str) -> Any:
    """Return a text as a value.

    Args:
        text: The text.
        kind: ``auto``, ``str``, ``string``, ``int``, ``double``, ``bool``, ``boolean`` or ``yaml``.

    Raises:
        LaunchValueError: It is not such a value.
    """
    match kind.strip().lower():
        case "auto":
            return _automatic(text)
        case "str" | "string":
            return text
        case "int":
            return _number(text, int, "an integer")
        case "double":
            return _number(text, float, "a number")
        case "bool" | "boolean":
            return truth(text)
        case "yaml":
            return read_yaml(text)
        case _:
            raise LaunchValueError(f"has type {kind!r}, must be auto, str, int, double, bool or yaml")


def truth(text: str) -> bool:
    """Return a condition: ``true``, ``false``, ``1`` or ``0``.

    Raises:
        LaunchValueError: It is something else.
    """
    found = {"true": True, "1": True, "false": False, "0": False}.get(text.strip().lower())
    if found is None:
        raise LaunchValueError(f"is {text!r}, must be true or false")
    return found


def _number(text: str, kind: type[int | float], what: str) -> Any:
    try:
        return kind(text)
    except ValueError:
        raise LaunchValueError(f"is {text!r}, must be {what}") from None


def _automatic(text: str) -> Any:
    """Return a text with a point as a number, else as an integer, a truth value or text, whichever fits."""
    try:
        if "." in text:
            return float(text)
        if "_" not in text:
            return int(text)
    except ValueError:
        pass
    return {"true": True, "false": False}.get(text.lower(), text)


class _Loader(yaml.SafeLoader):
    """Reads YAML with ``rosparam``'s angles: ``deg(180)``, ``rad(pi)``, ``!degrees 180``, ``!radians pi``."""


def _angle(prefix: str, factor: float) -> Any:
    def construct(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> float:
        text = str(loader.construct_scalar(node)).strip()
        inner = text[len(prefix) : -1] if text.startswith(prefix) else text
        try:
            return float(evaluate(inner, {"pi": math.pi}, {})) * factor
        except (ValueError, TypeError) as error:
            raise LaunchValueError(f"{text} is not an angle: {error}") from error

    return construct


_Loader.add_constructor("!degrees", _angle("deg(", math.pi / 180))
_Loader.add_constructor("!radians", _angle("rad(", 1.0))
_Loader.add_implicit_resolver("!degrees", re.compile(r"^deg\([^\)]*\)$"), ["d"])
_Loader.add_implicit_resolver("!radians", re.compile(r"^rad\([^\)]*\)$"), ["r"])


def read_yaml(text: str) -> Any:
    """Return a YAML document's value.

    Raises:
        LaunchValueError: It is not YAML, or holds something that ROS parameters cannot hold.
    """
    try:
        return yaml.load(text, _Loader)  # noqa: S506 - a safe loader
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise LaunchValueError(f"is not valid YAML: {error}") from error


def check(name: str, value: Any) -> Any:
    """Return a parameter's value if a parameter server can hold it.

    Raises:
        LaunchValueError: It cannot.
    """
    if isinstance(value, Mapping):
        for key, entry in value.items():
            if not isinstance(key, str):
                raise LaunchValueError(f"parameter {name}: the key {key!r} must be text; write it in quotes")
            check(f"{name}/{key}", entry)
    elif isinstance(value, list):
        for entry in value:
            check(name, entry)
    elif isinstance(value, int) and not -MAX_INTEGER - 1 <= value <= MAX_INTEGER:
        raise LaunchValueError(f"parameter {name} is {value}; integers have 32 bits, write it as {value}.0")
    elif not isinstance(value, (bool, int, float, str, bytes)):
        what = "empty" if value is None else f"a {type(value).__name__}"
        raise LaunchValueError(f"parameter {name} is {what}; write text in quotes")
    return value
