"""Makes the OpenAPI document of the route table, so that it cannot tell anything but what the server does."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from pydantic.json_schema import models_json_schema

from rce import __version__
from rce_master.http.models import Error

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pydantic import BaseModel

    from rce_master.http.routes import Query, Route

PREFIX = "/api/v1"
_REF = "#/components/schemas/{model}"


def build_document(routes: Iterable[Route]) -> dict[str, Any]:
    """Describe all routes as OpenAPI 3.1."""
    routes = list(routes)
    models = {model for route in routes for model in (route.body, route.reply) if model} | {Error}
    ordered = sorted(models, key=lambda model: model.__name__)
    _, schemas = models_json_schema([(model, "validation") for model in ordered], ref_template=_REF)
    paths: dict[str, dict[str, Any]] = {}
    for route in routes:
        paths.setdefault(PREFIX + route.path, {})[route.method.lower()] = _operation(route)
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "RCE master",
            "version": __version__,
            "description": "Control of a robotics cloud.",
        },
        "paths": paths,
        "components": {
            "schemas": schemas["$defs"],
            "securitySchemes": {"bearer": {"type": "http", "scheme": "bearer"}},
        },
        "security": [{"bearer": []}],
    }


def _operation(route: Route) -> dict[str, Any]:
    operation: dict[str, Any] = {
        "operationId": getattr(route.handler, "__name__", route.summary),
        "summary": route.summary + (" (administrators only)" if route.admin else ""),
        "tags": [route.group],
        "parameters": [_path_parameter(name) for name in re.findall(r"{(\w+)}", route.path)]
        + [_query_parameter(query) for query in route.query],
        "responses": {str(route.status): _success(route), "default": _failure()},
    }
    if route.body is not None:
        operation["requestBody"] = {"required": True, "content": _content(route.body)}
    if route.open:
        operation["security"] = []
    return operation


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


def _success(route: Route) -> dict[str, Any]:
    answer: dict[str, Any] = {"description": route.summary}
    if route.reply is not None:
        answer["content"] = _content(route.reply)
    elif route.media != "application/json":
        answer["content"] = {route.media: {"schema": {"type": "string"}}}
    return answer


def _failure() -> dict[str, Any]:
    return {"description": "It was not done, and why", "content": _content(Error)}


def _content(model: type[BaseModel]) -> dict[str, Any]:
    return {"application/json": {"schema": {"$ref": _REF.format(model=model.__name__)}}}
