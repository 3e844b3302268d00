"""The table that servers and OpenAPI documents are made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest
from pydantic import BaseModel

from rce.web.openapi import Query, build_document
from rce.web.routes import Route, RouteTable


class Thing(BaseModel):
    name: str


class Problem(BaseModel):
    error: str


def things() -> RouteTable[Route[Any]]:
    table: RouteTable[Route[Any]] = RouteTable("things", Route)

    @table.route("GET", "/things/{name}", "One thing", reply=Thing, errors=(404,))
    def get_thing() -> None: ...

    @table.route("PUT", "/things/{name}", "Change it", name="change", group="changes", body=Thing, status=204)
    def put_thing() -> None: ...

    return table


def test_routes_keep_their_order_and_handlers() -> None:
    assert [(route.method, route.handler.__name__) for route in things()] == [
        ("GET", "get_thing"),
        ("PUT", "put_thing"),
    ]


def test_a_route_is_told_as_it_was_declared() -> None:
    get, put = (route.operation for route in things())
    assert (get.name, get.group, get.reply, get.errors) == ("get_thing", "things", Thing, (404,))
    assert (put.name, put.group, put.body, put.status) == ("change", "changes", Thing, 204)


def test_the_document_has_every_route() -> None:
    operations = [route.operation for route in things()]
    document = build_document(operations, title="Things", description="", error=Problem)
    assert set(document["paths"]["/api/v1/things/{name}"]) == {"get", "put"}


def test_a_derived_route_tells_more() -> None:
    @dataclass(frozen=True, slots=True, kw_only=True)
    class Guarded(Route[Any]):
        admin: bool = False

        def told(self) -> dict[str, Any]:
            return {"summary": f"{self.summary} (admins)"} if self.admin else {}

    table = RouteTable("things", Guarded)
    query = (Query(name="user", description="Whose"),)
    handler = table.route("GET", "/all", "All things", admin=True, query=query)(print)
    assert handler is print
    (route,) = table
    assert route.admin
    assert route.operation.summary == "All things (admins)"
    assert route.operation.query == query


def test_a_method_of_a_path_has_one_handler() -> None:
    table = things()
    with pytest.raises(ValueError, match=r"two handlers for GET /things/\{name\}"):
        table.route("GET", "/things/{name}", "Again")
