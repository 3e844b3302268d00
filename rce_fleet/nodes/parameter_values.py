"""Reads values of ROS parameters into frozen dataclasses. Pure.

A node declares its parameters as one dataclass: each field is a parameter, its type the parameter's type, its
default the parameter's default, and its ``metadata`` the values that are allowed:

=========== ==============================================================================
key         meaning
=========== ==============================================================================
``minimum`` the least value allowed, for a number and for each number in a list
``maximum`` the greatest value allowed
``above``   the value must be greater than this
``below``   the value must be less than this
``choices`` the values allowed
``name``    the parameter's name, if it differs from the field's
``search``  true: looked for in the node's namespaces from the inside out, as ``searchParam`` does
=========== ==============================================================================

A field may be a ``float`` (an integer is accepted), ``int`` (so is ``3.0``), ``bool``, ``str``, ``Literal``,
an enum of texts, a ``tuple`` or ``list`` of these, a union, or another such dataclass: a namespace.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import reprlib
from collections.abc import Mapping, Sequence
from enum import Enum
from types import NoneType, UnionType
from typing import (
    TYPE_CHECKING,
    Any,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")

KEYS = frozenset({"minimum", "maximum", "above", "below", "choices", "name", "search"})
"""Keys of a field's metadata that have a meaning here."""

CLOSE = 0.75
"""How similar the name of an unknown namespace is to that of a known one that was probably meant, 0..1."""

_NAMES = {float: "a number", int: "an integer", bool: "true or false", str: "text"}
_BOUNDS: tuple[tuple[str, str, Callable[[Any, Any], bool]], ...] = (
    ("minimum", "at least", lambda value, bound: value >= bound),
    ("maximum", "at most", lambda value, bound: value <= bound),
    ("above", "greater than", lambda value, bound: value > bound),
    ("below", "less than", lambda value, bound: value < bound),
)


class Problem(NamedTuple):
    """What is wrong with a parameter."""

    text: str
    is_unknown: bool = False
    """The node does not know the parameter; else its value cannot be used."""


class _UnfitError(ValueError):
    """A value is not what the parameter needs; the text says what it must be."""


@dataclasses.dataclass(frozen=True, slots=True)
class _Declared:
    """A field of a dataclass as a parameter."""

    name: str
    field: str
    type: Any
    metadata: Mapping[str, Any]

    @property
    def namespace(self) -> type[DataclassInstance] | None:
        """The dataclass of the parameters in this namespace; None for a single parameter."""
        return self.type if dataclasses.is_dataclass(self.type) else None


def read_values(
    kind: type[T],
    values: Mapping[str, Any],
    *,
    outer: Mapping[str, Any] | None = None,
    prefix: str = "~",
    unused: Sequence[str] = (),
) -> tuple[T, list[Problem]]:
    """Make a dataclass of the values of parameters. One that cannot be used keeps its default.

    Namespaces that the dataclass does not name are left alone: they belong to other nodes.

    Args:
        kind: The dataclass; it must have a default for each field.
        values: The parameters in the node's private namespace, as a tree.
        outer: Parameters with ``search`` that were found in namespaces outside, by name.
        prefix: Put before the names in the problems' texts.
        unused: Names of parameters that ROS 1's node of this name has, and this one does not use.

    Returns:
        The dataclass, and what was wrong with the values.

    Raises:
        TypeError: The dataclass is not a declaration of parameters.

    Example:
        >>> @dataclass(frozen=True)
        ... class Settings:
        ...     rate: float = field(default=10.0, metadata={"above": 0})
        >>> read_values(Settings, {"rate": -1})
        (Settings(rate=10.0), [Problem(text='parameter ~rate is -1, must be greater than 0; ...)])
    """
    reader = _Reader(prefix, dict(outer or {}))
    _declared(kind)  # refuses a field without a default by its name
    made = reader.read(kind(), values, prefix, unused)
    return made, reader.problems


def searched_names(kind: type[DataclassInstance]) -> frozenset[str]:
    """Return the names of all parameters that are looked for in outer namespaces too."""
    names: set[str] = set()
    for one in _declared(kind):
        if one.namespace is not None:
            names |= searched_names(one.namespace)
        elif one.metadata.get("search"):
            names.add(one.name)
    return frozenset(names)


class _Reader:
    """Reads the values of one node's parameters."""

    def __init__(self, prefix: str, outer: dict[str, Any]) -> None:
        self.problems: list[Problem] = []
        self._prefix = prefix
        self._outer = outer

    def read(self, default: T, values: Mapping[str, Any], prefix: str, unused: Sequence[str] = ()) -> T:
        """Return the parameters of one namespace; ``default`` with the values that can be used."""
        declared = _declared(type(default))
        self._report_unknown(type(default), declared, values, prefix, unused)
        visible = {**self._outer, **values}
        chosen: dict[str, Any] = {}
        for one in declared:
            usual = getattr(default, one.field)
            if one.namespace is not None:
                chosen[one.field] = self._read_namespace(one.name, usual, values, prefix)
                continue
            source = visible if one.metadata.get("search") else values
            if one.name not in source:
                continue
            try:
                chosen[one.field] = _checked(source[one.name], one)
            except _UnfitError as error:
                found = f"parameter {prefix}{one.name} is {reprlib.repr(source[one.name])}"
                self._complain(f"{found}, must be {error}; {reprlib.repr(usual)} is used")
        return self._make(default, chosen, prefix)

    def _read_namespace(self, name: str, default: T, values: Mapping[str, Any], prefix: str) -> T:
        found = values.get(name, {})
        if not isinstance(found, Mapping):
            text = f"{prefix}{name} is {reprlib.repr(found)}, must be a namespace"
            self._complain(f"{text}; the defaults are used")
            found = {}
        before = self._outer
        self._outer = {**before, **values}
        try:
            return self.read(default, found, f"{prefix}{name}/")
        finally:
            self._outer = before

    def _make(self, default: T, chosen: dict[str, Any], prefix: str) -> T:
        """Make the dataclass; if it refuses its values together, leave out the cause, or all."""
        try:
            return dataclasses.replace(default, **chosen)
        except ValueError as error:
            reason = str(error)
        for field in chosen:
            rest = {key: value for key, value in chosen.items() if key != field}
            try:
                made = dataclasses.replace(default, **rest)
            except ValueError:
                continue
            self._complain(f"{prefix}{field}: {reason}; {reprlib.repr(getattr(default, field))} is used")
            return made
        self._complain(f"the parameters in {prefix} do not go together: {reason}; the defaults are used")
        return default

    def _report_unknown(
        self,
        kind: type[DataclassInstance],
        declared: Sequence[_Declared],
        values: Mapping[str, Any],
        prefix: str,
        unused: Sequence[str],
    ) -> None:
        names = [one.name for one in declared]
        inner = searched_names(kind)
        spaces = [one.name for one in declared if one.namespace is not None]
        for name, value in values.items():
            if name in names or name in inner:
                continue
            if name in unused:
                text = f"parameter {prefix}{name} has no effect: this node does not use it"
                self.problems.append(Problem(text, is_unknown=True))
                continue
            is_namespace = isinstance(value, Mapping)
            near = difflib.get_close_matches(
                name, spaces if is_namespace else names, 1, CLOSE if is_namespace else 0.0
            )
            if near or not is_namespace:
                what = "namespace" if is_namespace else "parameter"
                hint = f"; did you mean {prefix}{near[0]}?" if near else ""
                self.problems.append(Problem(f"unknown {what} {prefix}{name}{hint}", is_unknown=True))

    def _complain(self, text: str) -> None:
        self.problems.append(Problem(text))


def _declared(kind: type[DataclassInstance]) -> list[_Declared]:
    try:
        hints = get_type_hints(kind)
    except NameError as error:
        raise TypeError(f"{kind.__name__}: {error}; import the types of parameters at run time") from error
    return list(_each(kind, hints))


def _each(kind: type[DataclassInstance], hints: Mapping[str, Any]) -> Iterator[_Declared]:
    for field in dataclasses.fields(kind):
        if not field.init:
            continue
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise TypeError(f"{kind.__name__}.{field.name}: a parameter must have a default")
        yield _Declared(field.metadata.get("name", field.name), field.name, hints[field.name], field.metadata)


def _checked(value: Any, one: _Declared) -> Any:
    """Return a value as its field's type.

    Raises:
        _UnfitError: It does not fit.
    """
    converted = _converted(value, one.type, one.field)
    choices = one.metadata.get("choices")
    if choices is not None and converted not in choices:
        raise _UnfitError("one of " + ", ".join(map(str, choices)))
    for number in _numbers(converted):
        for key, words, holds in _BOUNDS:
            bound = one.metadata.get(key)
            if bound is not None and not holds(number, bound):
                raise _UnfitError(f"{words} {bound}")
    return converted


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, (list, tuple)):
        for entry in value:
            yield from _numbers(entry)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield value


def _converted(value: Any, wanted: Any, field: str) -> Any:
    origin, arguments = get_origin(wanted), get_args(wanted)
    if origin in (Union, UnionType):
        return _one_of(value, arguments, field)
    if origin is Literal:
        if value in arguments and type(value) in map(type, arguments):
            return value
        raise _UnfitError("one of " + ", ".join(map(str, arguments)))
    if origin in (tuple, list):
        return _listed(value, origin, arguments, field)
    if isinstance(wanted, type) and issubclass(wanted, Enum):
        try:
            return wanted(value)
        except ValueError:
            raise _UnfitError("one of " + ", ".join(str(one.value) for one in wanted)) from None
    if wanted not in _NAMES:
        raise TypeError(f"field {field}: {wanted} cannot be the type of a parameter")
    converted = _scalar(value, wanted)
    if converted is None:
        raise _UnfitError(_NAMES[wanted])
    return converted


def _scalar(value: Any, wanted: type) -> Any:
    """Return a value as a number, truth value or text; None if it is something else."""
    if wanted in (bool, str) or isinstance(value, bool):
        return value if type(value) is wanted else None
    if isinstance(value, str):  # YAML 1.1 reads 1e-3, without a point, as text
        try:
            value = float(value)
        except ValueError:
            return None
    if not isinstance(value, (int, float)) or not math.isfinite(value):
        return None
    if wanted is float:
        return float(value)
    return int(value) if value == int(value) else None


def _one_of(value: Any, types: Sequence[Any], field: str) -> Any:
    if value is None and NoneType in types:
        return None
    wanted = [one for one in types if one is not NoneType]
    unfit: list[str] = []
    for one in sorted(wanted, key=lambda one: one is not type(value)):  # exactly its own type first
        try:
            return _converted(value, one, field)
        except _UnfitError as error:
            unfit.append(str(error))
    raise _UnfitError(" or ".join(unfit))


def _listed(value: Any, origin: type, types: Sequence[Any], field: str) -> Any:
    if not isinstance(value, (list, tuple)):
        raise _UnfitError("a list")
    is_uniform = origin is list or types[-1:] == (Ellipsis,)
    wanted = [types[0]] * len(value) if is_uniform else list(types)
    if len(wanted) != len(value):
        raise _UnfitError(f"a list of {len(wanted)} entries")
    try:
        return origin(_converted(entry, one, field) for entry, one in zip(value, wanted, strict=True))
    except _UnfitError as error:
        raise _UnfitError(f"a list in which each entry is {error}") from None
