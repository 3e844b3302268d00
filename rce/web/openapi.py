"""Makes the OpenAPI document from a route table, so that it always matches the server."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

from rce import __version__

if TYPE_CHECKING:
    from pydantic import BaseModel

PREFIX = "/api/v1"
_FAILURES: dict[int, str] = {
    HTTPStatus.BAD_REQUEST: "The request cannot be read",
    HTTPStatus.UNAUTHORIZED: "No token, or one that is not good any more; or a wrong password",
    HTTPStatus.FORBIDDEN: "The caller may not do this",
    HTTPStatus.NOT_FOUND: "There is no such thing",
    HTTPStatus.REQUEST_TIMEOUT: "The body did not come in time",
    HTTPStatus.CONFLICT: "It contradicts what there is, or exceeds a limit",
    HTTPStatus.REQUEST_ENTITY_TOO_LARGE: "The body is too large",
    HTTPStatus.MISDIRECTED_REQUEST: "The server is not known by the name in Host",
    HTTPStatus.UNPROCESSABLE_ENTITY: "The request is wrong; the text names each fault",
    HTTPStatus.TOO_MANY_REQUESTS: "Too much at a time; try again after Retry-After seconds",
    HTTPStatus.SERVICE_UNAVAILABLE: "Something that is needed for it cannot be reached now",
}
_REF = "#/components/schemas/{model}"
_KEY_PARAMETER = {
    "name": "Idempotency-Key",
    "in": "header",
    "required": False,
    "description": "A new one for each new request, such as a UUID. A repeat with the same key is not done"
    " again, and gets the answer of the first (409 while that is under way, 422 if it is another request).",
    "schema": {"type": "string", "pattern": "^[!#-~]+$", "maxLength": 200},
}
_REPLAYED = {
    "Idempotent-Replayed": {
        "description": "'true': the request was done before, and this is its answer",
        "schema": {"type": "string"},
    }
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Query:
    """A query parameter."""

    name: str
    description: str
    required: bool = False
    type: str = "string"


@dataclass(frozen=True, slots=True, kw_only=True)
class Operation:
    """A method of a path in the document."""

    name: str
    method: str
    path: str
    """Below :data:`PREFIX`, with ``{name}`` for its parts."""
    summary: str
    group: str
    body: type[BaseModel] | None = None
    reply: type[BaseModel] | None = None
    """None: no content, unless ``media`` says that something is streamed."""
    media: str = "application/json"
    status: int = 200
    also: tuple[int, ...] = ()
    """Other statuses of a success, with the same content."""
    other_media: tuple[str, ...] = ()
    """Other media types of a success, which the request chooses; they are texts."""
    open: bool = False
    """Whether it can be used without a token."""
    query: tuple[Query, ...] = ()
    upload: str = ""
    """Media type of a body that is a file."""
    errors: tuple[int, ...] = ()
    """All other statuses that an answer may have; empty: any."""
    keyed: bool = False
    """Whether repeats with the same ``Idempotency-Key`` are done once."""


def build_document(
    operations: Iterable[Operation], *, title: str, description: str, error: type[BaseModel]
) -> dict[str, Any]:
    """Describe operations as OpenAPI 3.1.

    Args:
        operations: All operations of the server.
        title: Names the server.
        description: Its purpose.
        error: Model of every answer that is not a success.
    """
    from pydantic.json_schema import models_json_schema  # takes memory; loaded on request only

    operations = list(operations)
    models = {model for known in operations for model in (known.body, known.reply) if model} | {error}
    ordered = sorted(models, key=lambda model: model.__name__)
    _, schemas = models_json_schema([(model, "validation") for model in ordered], ref_template=_REF)
    paths: dict[str, dict[str, Any]] = {}
    for known in operations:
        paths.setdefault(PREFIX + known.path, {})[known.method.lower()] = _describe(known, error)
    return {
        "openapi": "3.1.0",
        "info": {"title": title, "version": __version__, "description": description},
        "paths": paths,
        "components": {
            "schemas": schemas["$defs"],
            "securitySchemes": {"bearer": {"type": "http", "scheme": "bearer"}},
        },
        "security": [{"bearer": []}],
    }


def _describe(known: Operation, error: type[BaseModel]) -> dict[str, Any]:
    described: dict[str, Any] = {
        "operationId": known.name,
        "summary": known.summary,
        "tags": [known.group],
        "parameters": [_path_parameter(name) for name in re.findall(r"{(\w+)}", known.path)]
        + [_query_parameter(query) for query in known.query]
        + ([_KEY_PARAMETER] if known.keyed else []),
        "responses": {str(known.status): _success(known)}
        | {str(status): _success(known) for status in known.also}
        | {str(status): _failure(status, error) for status in sorted(known.errors)}
        | ({} if known.errors else {"default": _failure(0, error)}),
    }
    if known.body is not None:
        described["requestBody"] = {"required": True, "content": _content(known.body)}
    if known.upload:
        file = {"schema": {"type": "string", "format": "binary"}}
        described["requestBody"] = {"required": True, "content": {known.upload: file}}
    if known.open:
        described["security"] = []
    return described


def _path_parameter(name: str) -> dict[str, Any]:
    return {"name": name, "in": "path", "required": True, "schema": {"type": "string"}}


def _query_parameter(query: Query) -> dict[str, Any]:
    return {
        "name": query.name,
        "in": "query",
        "required": query.required,
        "description": query.description,
        "schema": {"type": query.type},
    }


def _success(known: Operation) -> dict[str, Any]:
    answer: dict[str, Any] = {"description": known.summary}
    if known.reply is not None:
        answer["content"] = _content(known.reply)
    elif known.media != "application/json":
        answer["content"] = {known.media: {"schema": {"type": "string"}}}
    for media in known.other_media:
        answer.setdefault("content", {})[media] = {"schema": {"type": "string"}}
    if known.keyed:
        answer["headers"] = _REPLAYED
    return answer


def _failure(status: int, error: type[BaseModel]) -> dict[str, Any]:
    text = _FAILURES.get(status, "It was not done, and why")
    answer: dict[str, Any] = {"description": text, "content": _content(error)}
    if status == HTTPStatus.TOO_MANY_REQUESTS:
        seconds = {"description": "Seconds after which to try again", "schema": {"type": "integer"}}
        answer["headers"] = {"Retry-After": seconds}
    return answer


def _content(model: type[BaseModel]) -> dict[str, Any]:
    return {"application/json": {"schema": {"$ref": _REF.format(model=model.__name__)}}}
