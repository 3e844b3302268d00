"""Reads the attributes of one element, with everything substituted."""

from __future__ import annotations

import difflib
import math
from typing import TYPE_CHECKING

from rce.ros.launch.exceptions import LaunchValueError
from rce.ros.launch.substitution import Substitution
from rce.ros.launch.values import truth

if TYPE_CHECKING:
    from rce.ros.launch.plan import LaunchPlan
    from rce.ros.launch.scope import Scope
    from rce.ros.launch.tree import Element

CONDITIONS = ("if", "unless")


class ElementReader:
    """Reads one element.

    Args:
        element: The element.
        scope: Its surroundings.

    All methods raise :class:`LaunchValueError` for a wrong text, and :class:`LookupError` for a package that
    is not there.
    """

    def __init__(self, element: Element, scope: Scope) -> None:
        self.element = element
        self._substitution = Substitution(scope.inputs, scope.file, scope.arguments, scope.anonymous)

    @property
    def applies(self) -> bool:
        """Whether the element's ``if`` or ``unless`` lets it count."""
        given = [name for name in CONDITIONS if name in self.element.attributes]
        if not given:
            return True
        if len(given) > 1:
            raise LaunchValueError("has both if and unless; give one of them")
        try:
            return truth(self.text(given[0]) or "") is (given[0] == "if")
        except LaunchValueError as error:
            raise LaunchValueError(f"{given[0]} {error}") from error

    def check_attributes(self, known: tuple[str, ...], plan: LaunchPlan) -> None:
        """Warn of attributes that the element does not have."""
        for name in self.element.attributes:
            if name not in known and name not in CONDITIONS:
                near = difflib.get_close_matches(name, known, 1)
                hint = f"; did you mean {near[0]}?" if near else ""
                plan.warnings.append(f"{self.element.place}: unknown attribute {name}{hint}")

    def resolve(self, text: str) -> str:
        """Return a text with everything substituted."""
        return self._substitution.resolve(text)

    def text(self, name: str) -> str | None:
        """Return an attribute; None if it is not given."""
        raw = self.element.attributes.get(name)
        return None if raw is None else self.resolve(raw)

    def required(self, name: str) -> str:
        """Return an attribute that must be given and not empty."""
        found = self.text(name)
        if not found:
            raise LaunchValueError(f"needs the attribute {name}")
        return found

    def flag(self, name: str, *, empty_is_false: bool = False) -> bool:
        """Return an attribute that is ``true`` or ``false``; false if it is not given."""
        found = self.text(name)
        if found is None or (empty_is_false and not found):
            return False
        if found.lower() not in ("true", "false"):
            raise LaunchValueError(f"{name} is {found!r}, must be true or false")
        return found.lower() == "true"

    def seconds(self, name: str) -> float:
        """Return an attribute that is a time; 0 if it is not given."""
        found = self.text(name)
        if found is None:
            return 0.0
        try:
            value = float(found)
        except ValueError:
            value = math.nan
        if not 0.0 <= value < math.inf:
            raise LaunchValueError(f"{name} is {found!r}, must be a number of seconds")
        return value
