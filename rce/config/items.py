"""The items that a robot's file lists: containers, nodes, parameters, interfaces and connections.

Each is a request of :mod:`rce.model.requests`, spelled with the keys of the RoboEarth Cloud Engine's files
(``docs/protocol.md``). The pydantic models that read them are made from their fields.
"""

from __future__ import annotations

import re
import types
from typing import TYPE_CHECKING, Annotated, Any, Generic, TypeVar, get_args, get_origin

import msgspec
from msgspec import Meta, Struct
from pydantic import AfterValidator, BeforeValidator, create_model
from pydantic import Field as Option
from pydantic_core import core_schema

from rce.config.validation import Strict
from rce.model import (
    AddInterface,
    AddNode,
    Connection,
    CreateContainer,
    InterfaceSpec,
    Item,
    NodeSpec,
    SetParameter,
    join_path,
    written,
)
from rce.model.spelling import Field, Spelling, camel, fault_of, fields_of
from rce.model.written import HUMAN_PATTERNS, AsWritten

if TYPE_CHECKING:
    from collections.abc import Callable

    from pydantic import GetCoreSchemaHandler
    from pydantic_core.core_schema import CoreSchema

T = TypeVar("T", bound=CreateContainer | Item)

SPELLING = Spelling(
    camel,
    {
        (CreateContainer, "tag"): "cTag",
        (AddNode, "container"): "cTag",
        (NodeSpec, "tag"): "nTag",
        (NodeSpec, "state_services"): "state",
        (SetParameter, "container"): "cTag",
        (AddInterface, "endpoint"): "eTag",
        (InterfaceSpec, "tag"): "iTag",
        (InterfaceSpec, "type"): "iType",
        (InterfaceSpec, "message_type"): "iCls",
    },
)
"""The names of the fields in config files."""


class ItemOf(Generic[T]):
    """Has pydantic read an item of a file: ``Annotated[AddNode, ItemOf(AddNode)]``."""

    def __init__(self, cls: type[T]) -> None:
        self._cls = cls

    @property
    def model(self) -> type[Strict]:
        """The pydantic model of its keys."""
        return model_of(self._cls)

    def read(self, data: object) -> T:
        """Read an item.

        Raises:
            ValidationError: The item has a fault.
        """
        return self._make(self.model.model_validate(data))

    def _make(self, item: Strict) -> T:
        made, faults = SPELLING.try_read(self._cls, item.model_dump(by_alias=True, exclude_unset=True))
        if made is None:
            raise ValueError("; ".join(map(str, faults)))
        return made

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(
            self._make,
            handler.generate_schema(self.model),
            serialization=core_schema.plain_serializer_function_ser_schema(SPELLING.write),
        )


Container = Annotated[CreateContainer, ItemOf(CreateContainer)]
Node = Annotated[AddNode, ItemOf(AddNode)]
Parameter = Annotated[SetParameter, ItemOf(SetParameter)]
Interface = Annotated[AddInterface, ItemOf(AddInterface)]
Link = Annotated[Connection, ItemOf(Connection)]


_MODELS: dict[type[Any], type[Strict]] = {}


def model_of(cls: type[Any]) -> type[Strict]:
    """Make the pydantic model of an item from its fields."""
    if cls not in _MODELS:
        options: dict[str, Any] = {}
        for field in fields_of(cls):
            # Fields that are not given are left out of the result, so the default here has no effect.
            default = ... if field.required else None
            options[field.name] = (_annotation(field), Option(default, alias=SPELLING.key(field)))
        _MODELS[cls] = create_model(cls.__name__, __base__=Strict, **options)
    return _MODELS[cls]


def _annotation(field: Field) -> Any:
    """Return pydantic's annotation of the values that users may write in a field."""
    rule = field.rule
    if field.choices:
        return Annotated[Any, BeforeValidator(_one_of(field.choices))]
    if get_origin(rule.type) is list or (isinstance(rule.type, type) and issubclass(rule.type, Struct)):
        return Annotated[Any, AfterValidator(_specs(rule))]
    if rule.words:
        return Annotated[Any, AfterValidator(_fitting(rule))]
    if get_origin(rule.type) is tuple:
        items: Any = types.GenericAlias(tuple, (_text_or_number(get_args(rule.type)[0]), ...))
        return Annotated[items, Option(strict=False)]
    if get_origin(rule.type) is Annotated or rule.type is bool:
        return Annotated[_text_or_number(rule.type), AfterValidator(_checked(rule.read))]
    return Annotated[Any, AfterValidator(_checked(rule.read))]


def _text_or_number(kind: Any) -> Any:
    """Return pydantic's annotation of a type of one value, from msgspec's."""
    if kind is bool:
        return bool
    plain, meta = get_args(kind)
    if plain is str:
        return Annotated[str, AfterValidator(_matching(meta))]
    return Annotated[plain, Option(ge=meta.ge, le=meta.le)]


def _matching(meta: Meta) -> Callable[[str], str]:
    pattern = re.compile(meta.pattern or "")

    def check(text: str) -> str:
        if not pattern.match(text):
            raise ValueError(HUMAN_PATTERNS[pattern.pattern])
        if meta.max_length is not None and len(text) > meta.max_length:
            raise ValueError(f"must have at most {meta.max_length} characters")
        return text

    return check


def _one_of(choices: tuple[str, ...]) -> Callable[[Any], Any]:
    def check(value: Any) -> Any:
        if value not in choices:
            raise ValueError(f"must be one of {', '.join(choices)}")
        return value

    return check


def _checked(read: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Check a value with its reader; the value stays as it was written."""

    def check(value: Any) -> Any:
        read(value)
        return value

    return check


def _specs(rule: AsWritten) -> Callable[[Any], Any]:
    """Check a spec or a list of specs, such as volumes; it stays as it was written."""

    def check(value: Any) -> Any:
        try:
            rule.read(msgspec.convert(value, rule.type))
        except msgspec.ValidationError as error:
            fault = fault_of(str(error), value)
            raise ValueError(f"{join_path(fault.path)} {fault.problem}".strip()) from error
        return value

    return check


def _fitting(rule: AsWritten) -> Callable[[Any], Any]:
    """Check a value whose rule has words for a wrong type; it stays as it was written."""

    def check(value: Any) -> Any:
        try:
            rule.read(msgspec.convert(value, rule.type))
        except msgspec.ValidationError as error:
            raise ValueError(rule.words) from error
        return value

    return check


Name = Annotated[str, AfterValidator(_matching(get_args(written.Name)[1]))]
RosName = Annotated[str, AfterValidator(_matching(get_args(written.RosName)[1]))]
MessageTypeName = Annotated[str, AfterValidator(_matching(get_args(written.MessageTypeName)[1]))]
