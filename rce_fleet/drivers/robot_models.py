"""Models of robots from YAML files."""

from __future__ import annotations

import dataclasses
import difflib
import json
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter, ValidationError

from rce.config import ConfigError, Fault
from rce.config.documents import join, parse, read_file
from rce_fleet.simulation.models import RobotModel

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

MODELS = Path(__file__).with_name("models")
"""The models that ship with the project."""
DEFAULT_MODEL = "disc"
BASE = "base"
"""Key of a scene's model that names the model that it changes."""


def shipped_models() -> list[str]:
    """Return the names of the models that ship with the project."""
    return sorted(path.stem for path in MODELS.glob("*.yaml"))


@cache
def load_model(name: str, sensor: str = "") -> RobotModel:
    """Return a model that ships with the project.

    Args:
        name: Such as ``turtlebot2``.
        sensor: The sensor that makes ``/scan``; empty for the model's own choice.

    Raises:
        ConfigError: There is no such model, or it has no such sensor.

    Example:
        ``world.place_robot("Robot1", Pose(1.0, 1.0, 0.0), load_model("turtlebot2", "lidar"))``
    """
    return ModelShelf({}).model(name, {"sensor": sensor} if sensor else {}, place="model")


class ModelShelf:
    """The models that a scene can name: those of the project, and the scene's own.

    Args:
        own: The scene's own models by name: what each changes of its ``base``.
        source: The scene's file, for errors.
    """

    def __init__(self, own: Mapping[str, Mapping[str, Any]], source: str = "model") -> None:
        self._own = own
        self._source = source

    def model(self, name: str, changes: Mapping[str, Any], *, place: str) -> RobotModel:
        """Return a model with changes.

        Args:
            name: Name of the model.
            changes: What is different, as in a model's file.
            place: Where in the scene this is, for errors.

        Raises:
            ConfigError: The model is unknown, or a value is wrong.
        """
        document = _merged(self._document(name, place, ()), changes)
        try:
            # Only from JSON does pydantic make strict dataclasses of objects.
            return TypeAdapter(RobotModel).validate_json(json.dumps(document, default=str))
        except ValidationError as error:
            raise ConfigError(self._source, list(_faults(error, place))) from error

    def _document(self, name: str, place: str, using: tuple[str, ...]) -> dict[str, Any]:
        if name in using:
            raise ConfigError(self._source, [Fault(place, f"the model {name} is based on itself")])
        if name in self._own:
            own = dict(self._own[name])
            base = str(own.pop(BASE, DEFAULT_MODEL))
            return _merged(self._document(base, join(f"models.{name}", BASE), (*using, name)), own)
        if name not in shipped_models():
            known = ", ".join(sorted({*shipped_models(), *self._own}))
            raise ConfigError(
                self._source, [Fault(place, f"there is no robot model {name!r}; known: {known}")]
            )
        path = MODELS / f"{name}.yaml"
        document: dict[str, Any] = parse(read_file(path), str(path))
        return document


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``base`` with the values of ``changes``; objects in both are merged likewise."""
    merged = dict(base)
    for key, value in changes.items():
        old = merged.get(key)
        merged[key] = _merged(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return merged


def _faults(error: ValidationError, place: str) -> Iterator[Fault]:
    for detail in error.errors(include_url=False):
        where = place
        for step in detail["loc"]:
            where = join(where, step)
        match detail["type"]:
            case "unexpected_keyword_argument":
                yield Fault(where, f"is not a known key{_suggestion(detail['loc'])}")
            case "value_error":
                yield Fault(where, str(detail["ctx"]["error"]))
            case _:
                message = str(detail["msg"])
                yield Fault(where, f"{message[:1].lower()}{message[1:]}, not {detail['input']!r}")


def _suggestion(steps: tuple[int | str, ...]) -> str:
    """Return a hint with the nearest known key, for an unknown one."""
    kind: Any = RobotModel
    hints = {
        field.name: field.default_factory
        for field in dataclasses.fields(kind)
        if field.default_factory is not dataclasses.MISSING
    }
    inner = hints.get(str(steps[0])) if len(steps) > 1 else kind
    if isinstance(inner, type) and dataclasses.is_dataclass(inner):
        names = [field.name for field in dataclasses.fields(inner)]
        close = difflib.get_close_matches(str(steps[-1]), names, 1, 0.5)
        return f"; did you mean {close[0]!r}?" if close else f"; known: {', '.join(names)}"
    return ""
