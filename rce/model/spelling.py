"""The spelling of requests on a surface: the names of the fields, and their nesting.

Client protocol, config files and REST API have one :class:`Spelling` each. Its names are made from those of
the attributes by a style; the few that differ are listed. So a new field in :mod:`rce.model.specs` is read
and written everywhere.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import msgspec
from msgspec import NODEFAULT, UNSET, Struct, UnsetType

from rce.model.faults import FaultCode, FieldFault, Path, SpecError
from rce.model.requests import Item, Request, faults_of
from rce.model.specs import Network, Resources
from rce.model.written import HUMAN_PATTERNS, AsWritten

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator


S = TypeVar("S", bound=Struct)
T = TypeVar("T", bound="Request | Item")

_MAX_QUOTED = 80
_NO_CHOICES: Mapping[str, tuple[str, ...]] = {}
_PLACE = re.compile(r"(?s)(.*) - at `(?:key in )?\$(.*)`")
_MISSING = re.compile(r"Object missing required field `([^`]+)`")
_STEP = re.compile(r"\.([^.\[]+)|\[(\d+)\]")
_REPR_PATTERNS = {repr(pattern): text for pattern, text in HUMAN_PATTERNS.items()}


class Field(NamedTuple):
    """A field of a request, also of the specs in it."""

    owner: type[Struct]
    """The spec or request that it belongs to."""
    path: tuple[str, ...]
    """The attributes that lead to it, from the request on."""
    kept: Any
    """The type of the value that the engine keeps."""
    rule: AsWritten
    default: Any
    """Default of the kept value; :data:`msgspec.NODEFAULT` if it must be given."""

    @property
    def name(self) -> str:
        """The attribute's name."""
        return self.path[-1]

    @property
    def required(self) -> bool:
        """Whether it must be given."""
        return self.default is NODEFAULT

    @property
    def written(self) -> Any:
        """The type of the value that users write."""
        return self.rule.type | None if self.default is None else self.rule.type

    @property
    def choices(self) -> tuple[str, ...]:
        """The valid texts of a field with a choice; empty for other fields."""
        return tuple(filter(None, get_args(self.rule.type))) if get_origin(self.rule.type) is Literal else ()

    def is_blank(self, value: Any) -> bool:
        """Return whether a value means "not given"."""
        return value is UNSET or (value is None and self.default is None) or value == self.rule.blank

    def get(self, item: Any) -> Any:
        """Return this field's value in a request."""
        for name in self.path:
            item = getattr(item, name)
        return item


_FIELDS: dict[type[Struct], tuple[Field, ...]] = {}
_SPECS: dict[type[Struct], dict[str, type[Struct]]] = {}


def fields_of(cls: type[Struct]) -> tuple[Field, ...]:
    """List the fields of a spec or a request, those of the specs in it included."""
    if cls not in _FIELDS:
        _FIELDS[cls] = tuple(_find_fields(cls))
    return _FIELDS[cls]


def _specs_in(cls: type[Struct]) -> dict[str, type[Struct]]:
    """Return the attributes of a request that are specs."""
    if cls not in _SPECS:
        hints = get_type_hints(cls).items()
        specs = {name: kind for name, kind in hints if isinstance(kind, type) and issubclass(kind, Struct)}
        _SPECS[cls] = specs
    return _SPECS[cls]


def _find_fields(cls: type[Struct]) -> Iterator[Field]:
    hints = get_type_hints(cls, include_extras=True)
    for one in msgspec.structs.fields(cls):
        if one.name in _specs_in(cls):
            for inner in fields_of(_specs_in(cls)[one.name]):
                yield inner._replace(path=(one.name, *inner.path))
            continue
        hint = hints[one.name]
        kept, *marks = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        rule = next((mark for mark in marks if isinstance(mark, AsWritten)), AsWritten(kept))
        default = one.default_factory() if callable(one.default_factory) else one.default
        yield Field(cls, (one.name,), kept, rule, default)


class _Layout(NamedTuple):
    """The written form of a request."""

    keys: dict[tuple[str, ...], tuple[str, ...]]
    """The keys that lead to a field, by its path."""
    checker: Any
    """Type with which msgspec checks the written form: an attribute for each field, in their order."""


class Spelling:
    """The names of a surface.

    Args:
        style: Makes the name of a field from that of its attribute.
        names: Those that are not made so, by the spec or request and its attribute.
        below: The key below which a request has all but its own tag.
    """

    def __init__(
        self,
        style: Callable[[str], str],
        names: Mapping[tuple[type[Struct], str], str] | None = None,
        below: Mapping[type[Struct], str] | None = None,
    ) -> None:
        self._style = style
        self._names = dict(names or {})
        self._below = dict(below or {})
        self._layouts: dict[type[Struct], _Layout] = {}

    def key(self, field: Field) -> str:
        """Return the name of a field on this surface."""
        return self._names.get((field.owner, field.name)) or self._style(field.name)

    def read(self, cls: type[T], data: Any, place: Path = ()) -> T:
        """Read a request.

        Args:
            cls: Its class.
            data: A JSON object.
            place: Where it stands, for the paths of faults.

        Raises:
            SpecError: The request has faults.
        """
        item, faults = self.try_read(cls, data)
        if item is not None:
            faults += [fault.at(self.path(cls, fault.path)) for fault in faults_of(item)]
        if item is None or faults:
            raise SpecError([fault.below(*place) for fault in faults])
        return item

    def try_read(self, cls: type[T], data: Any) -> tuple[T | None, list[FieldFault]]:
        """Read a request without checks between fields; return it, or its faults."""
        layout = self._layout(cls)
        below = self._below.get(cls)
        if below and isinstance(data, dict) and data.get(below, ...) is None:
            data = {key: value for key, value in data.items() if key != below}
        try:
            made = msgspec.convert(data, layout.checker)
        except msgspec.ValidationError as error:
            return None, [fault_of(str(error), data, self._choices(cls))]
        values = [getattr(made, name) for name in made.__struct_fields__]
        if below:
            inner = values.pop()
            values += [getattr(inner, name) for name in inner.__struct_fields__]
        kept: dict[tuple[str, ...], Any] = {}
        faults = []
        for field, value in zip(fields_of(cls), values, strict=True):
            if field.is_blank(value):
                continue
            try:
                kept[field.path] = field.rule.read(value)
            except ValueError as error:
                faults.append(FieldFault(layout.keys[field.path], FaultCode.INVALID, str(error)))
        return (None, faults) if faults else (_build(cls, kept), [])

    def write(self, item: Request | Item) -> dict[str, Any]:
        """Write a request, without the fields that have their default."""
        layout = self._layout(type(item))
        data: dict[str, Any] = {}
        for field in fields_of(type(item)):
            value = field.get(item)
            if not field.required and value == field.default and type(value) is type(field.default):
                continue
            *outer, key = layout.keys[field.path]
            place = data.setdefault(outer[0], {}) if outer else data
            place[key] = field.rule.write(value)
        return data

    def path(self, cls: type[Struct], attributes: Path) -> Path:
        """Return the path of a field or a spec of a request, as it is spelled here."""
        keys = self._layout(cls).keys
        if attributes in keys:
            return keys[attributes]  # type: ignore[index]  # in the table, so it is all of names
        inner = [path for names, path in keys.items() if names[: len(attributes)] == attributes]
        return inner[0][:-1]

    def _choices(self, cls: type[Struct]) -> dict[str, tuple[str, ...]]:
        return {self.key(field): field.choices for field in fields_of(cls) if field.choices}

    def _layout(self, cls: type[Struct]) -> _Layout:
        if cls not in self._layouts:
            self._layouts[cls] = self._lay_out(cls)
        return self._layouts[cls]

    def _lay_out(self, cls: type[Struct]) -> _Layout:
        fields = fields_of(cls)
        below = self._below.get(cls)
        if not below:
            return _Layout({f.path: (self.key(f),) for f in fields}, self._checker(cls.__name__, fields))
        own, *rest = fields
        keys: dict[tuple[str, ...], tuple[str, ...]] = {own.path: (self.key(own),)}
        keys |= {field.path: (below, self.key(field)) for field in rest}
        inner = self._checker(f"{cls.__name__}Below", rest)
        needed = any(one.required for one in msgspec.structs.fields(cls)[1:])
        last = ("below", inner) if needed else ("below", inner, msgspec.field(default_factory=inner))
        return _Layout(keys, self._checker(cls.__name__, [own], (last, below)))

    def _checker(
        self, name: str, fields: Iterable[Field], last: tuple[tuple[Any, ...], str] | None = None
    ) -> Any:
        """Make the type with which msgspec checks written fields."""
        members: list[Any] = []
        names: dict[str, str] = {}
        for number, field in enumerate(fields):
            written = field.written
            if field.required:
                members.append((f"f{number}", written))
            else:
                members.append((f"f{number}", Union[written, UnsetType], UNSET))  # noqa: UP007 - made at run time
            names[f"f{number}"] = self.key(field)
        if last is not None:
            members.append(last[0])
            names["below"] = last[1]
        return msgspec.defstruct(name, members, kw_only=True, rename=names)


def camel(name: str) -> str:
    """Spell an attribute as the client protocol does: ``max_restarts`` is ``maxRestarts``."""
    first, *rest = name.split("_")
    return first + "".join(part.capitalize() for part in rest)


def _build(cls: type[S], kept: dict[tuple[str, ...], Any]) -> S:
    """Make a request, and the specs in it, from its fields."""
    own: dict[str, Any] = {path[0]: value for path, value in kept.items() if len(path) == 1}
    for name, spec in _specs_in(cls).items():
        own[name] = _build(spec, {path[1:]: value for path, value in kept.items() if path[0] == name})
    if issubclass(cls, Resources) and "network" not in own and own.get("group_ip"):
        own["network"] = Network.GROUP
    return cls(**own)


PLAIN = Spelling(str)
"""The names of the attributes, as programs write them."""


def short(value: Any) -> str:
    """Quote the beginning of a value."""
    text = repr(value[: _MAX_QUOTED + 1] if isinstance(value, str) else value)
    return text if len(text) <= _MAX_QUOTED else f"{text[:_MAX_QUOTED]}..."


def fault_of(text: str, value: Any, choices: Mapping[str, tuple[str, ...]] = _NO_CHOICES) -> FieldFault:
    """Turn an error of msgspec into a fault with this project's text."""
    found = _PLACE.fullmatch(text)
    problem, inner = found.groups() if found else (text, "")
    path = tuple(int(index) if index else key for key, index in _STEP.findall(inner))
    missing = _MISSING.fullmatch(problem)
    if missing:
        return FieldFault((*path, missing[1]), FaultCode.MISSING, "is missing")
    given = value
    for step in path:
        given = given[step]
    words: str | None
    if problem.startswith("Invalid enum value"):
        known = next(
            (choices[step] for step in reversed(path) if isinstance(step, str) and step in choices), ()
        )
        words = f"must be one of {', '.join(known)}" if known else None
    else:
        words = next((words for pattern, words in _REPR_PATTERNS.items() if problem.endswith(pattern)), None)
    if words:
        return FieldFault(path, FaultCode.INVALID, f"{words}, not {short(given)}")
    problem = problem.replace("Expected", "must be", 1).replace(", got", ", not").replace("`", "")
    return FieldFault(path, FaultCode.INVALID, problem)
