"""Turns pydantic's errors into faults with paths and this project's texts."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict

from rce.config.documents import join
from rce.config.exceptions import Fault

if TYPE_CHECKING:
    from pydantic import ValidationError


class Strict(BaseModel):
    """Base of the models of user input: no conversions, unknown keys are faults, instances do not change."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, populate_by_name=True)


def faults_of(error: ValidationError, model: type[BaseModel]) -> list[Fault]:
    """Return a fault with its path for every error.

    Args:
        error: Pydantic's error.
        model: The model of the whole document, for suggestions.
    """
    faults = []
    for detail in error.errors(include_url=False):
        steps = detail["loc"]
        place = ""
        for step in steps:
            place = join(place, step)
        faults.append(Fault(place, _problem(detail, model, steps)))
    return list(dict.fromkeys(faults))


def _problem(detail: Any, model: type[BaseModel], steps: tuple[int | str, ...]) -> str:
    match detail["type"]:
        case "missing":
            return "is missing"
        case "extra_forbidden":
            close = difflib.get_close_matches(str(steps[-1]), _keys_beside(model, steps), 1, 0.5)
            return f"is not a known key; did you mean {close[0]!r}?" if close else "is not a known key"
        case "value_error":
            return str(detail["ctx"]["error"])
        case _:
            message = str(detail["msg"])
            return message[:1].lower() + message[1:].replace("dictionary", "object")


def _keys_beside(model: type[BaseModel], steps: tuple[int | str, ...]) -> list[str]:
    """Return the keys that are valid where the unknown one was found."""
    for step in steps[:-1]:
        if isinstance(step, str):
            inner = _inner_model(model, step)
            if inner is None:
                return []
            model = inner
    return [field.alias or name for name, field in model.model_fields.items()]


def _inner_model(model: type[BaseModel], key: str) -> type[BaseModel] | None:
    for name, field in model.model_fields.items():
        if key in (name, field.alias):
            candidates = [field.annotation, *getattr(field.annotation, "__args__", ())]
            for one in candidates[:]:  # a model of its own may read what is annotated: rce.config.items
                candidates += [getattr(mark, "model", None) for mark in getattr(one, "__metadata__", ())]
            return next((c for c in candidates if isinstance(c, type) and issubclass(c, BaseModel)), None)
    return None
