"""The parameters that a user set, kept on the container's parameter server."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from rce.model import ParameterSpec, ParameterValue
from rce.ros import names
from rce.ros.packages import PackageIndex
from rce.ros.substitution import substitute
from rce_container.environment.exceptions import ParameterError

Values = dict[str, ParameterValue]
"""Parameters by their global names."""


class Difference(NamedTuple):
    """The difference between two sets of parameters: delete first, then set."""

    delete: list[str]
    set: Values


def difference(now: Values, desired: Values) -> Difference:
    """Return the difference. An equal value of another type (``1``, ``1.0``, ``True``) is a change."""
    changed = {
        name: value for name, value in desired.items() if name not in now or not _same(now[name], value)
    }
    return Difference([name for name in now if name not in desired], changed)


def evaluate(
    spec: ParameterSpec, packages: PackageIndex, environ: Mapping[str, str]
) -> tuple[str, ParameterValue]:
    """Return a parameter's global name and its value, with the substitutions in strings done.

    Raises:
        ParameterError: The name is not a ROS name, or a substitution cannot be made.
    """

    def filled(value: bool | float | str) -> bool | float | str:
        return substitute(value, packages, environ) if isinstance(value, str) else value

    name = names.canonical(f"/{spec.name}")
    if not names.is_graph_name(name) or name == "/":
        raise ParameterError(f"parameter {spec.name!r}: this is not a ROS name")
    try:
        if isinstance(spec.value, list):
            return name, [filled(item) for item in spec.value]
        return name, filled(spec.value)
    except (LookupError, ValueError, OSError) as error:
        raise ParameterError(f"parameter {spec.name}: {error}") from error


def evaluate_all(
    specs: Iterable[ParameterSpec], packages: PackageIndex, environ: Mapping[str, str]
) -> tuple[Values, list[ParameterError]]:
    """Resolve all parameters; an error in one does not affect the others."""
    values: Values = {}
    faults = []
    for spec in specs:
        try:
            name, value = evaluate(spec, packages, environ)
        except ParameterError as error:
            faults.append(error)
        else:
            values[name] = value
    return values, faults


def _same(one: ParameterValue, other: ParameterValue) -> bool:
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_same, one, other))
    return type(one) is type(other) and one == other
