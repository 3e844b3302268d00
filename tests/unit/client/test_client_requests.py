"""The requests of a connection as methods: their keywords are the fields of the specs."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from rce.model.requests import AddInterface, AddNode, CreateContainer, Item, Request, ResizeContainer
from rce.model.spelling import fields_of
from rce.protocol.messages import type_of
from rce.protocol.requests import write_request
from rce_client.requests import Requests

if TYPE_CHECKING:
    from collections.abc import Callable


METHODS: list[tuple[Callable[..., Any], type[Request | Item]]] = [
    (Requests.create_container, CreateContainer),
    (Requests.resize_container, ResizeContainer),
    (Requests.add_node, AddNode),
    (Requests.add_interface, AddInterface),
]
RENAMED = {"type": "interface_type"}


class Noted(Requests):
    """Keeps what it is to send, as JSON."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, Any]] = []

    async def request(self, request: Request) -> None:
        self.sent.append((type_of(request), msgspec.json.decode(msgspec.json.encode(write_request(request)))))


@pytest.mark.parametrize(("method", "request_type"), METHODS)
def test_a_method_has_the_fields_of_its_request(
    method: Callable[..., Any], request_type: type[Request | Item]
) -> None:
    """A field that is new in the specs is a keyword here, with the same default as users write it."""
    parameters = dict(inspect.signature(method).parameters)
    del parameters["self"]
    wanted = {RENAMED.get(field.name, field.name): field for field in fields_of(request_type)}
    assert parameters.keys() == wanted.keys()
    for name, field in wanted.items():
        assert parameters[name].annotation not in (inspect.Parameter.empty, "Any")
        if not field.required:
            given = parameters[name].default
            assert field.is_blank(given) or field.rule.read(given) == field.default


@pytest.mark.parametrize(
    ("given", "sent"),
    [
        ({}, {}),
        ({"size": 1, "cpu": 0, "memory": 0.0, "special_features": [], "group": ""}, {}),
        ({"size": 2, "cpu": "50%"}, {"size": 2, "cpu": 0.5}),
        ({"special_features": ("gpu", "arm")}, {"specialFeatures": ["gpu", "arm"]}),
        ({"special_features": "gpu arm"}, {"specialFeatures": ["gpu", "arm"]}),
        ({"memory": 256, "bandwidth": "10Mbit"}, {"memory": 256, "bandwidth": 1_250_000}),
        ({"memory": "1000B"}, {"memory": "1000B"}),
        ({"network": "group", "group": "g", "wait": True}, {"network": "group", "group": "g", "wait": True}),
    ],
)
async def test_only_requested_fields_are_sent(given: dict[str, Any], sent: dict[str, Any]) -> None:
    noted = Noted()
    await noted.create_container("c", **given)
    data = {"containerData": sent} if sent else {}
    assert noted.sent == [("CC", {"containerTag": "c", **data})]


@pytest.mark.parametrize(
    ("given", "sent"),
    [
        ({}, {}),
        ({"restart": "never", "max_restarts": 5, "after": [], "heartbeat_timeout": float("5")}, {}),
        ({"after": ["a", "b"], "heartbeat_timeout": 2.5}, {"after": ["a", "b"], "heartbeatTimeout": 2.5}),
        ({"after": "map"}, {"after": ["map"]}),
        ({"restart": "always", "max_restarts": 0}, {"restart": "always", "maxRestarts": 0}),
    ],
)
async def test_a_node_is_sent_without_its_defaults(given: dict[str, Any], sent: dict[str, Any]) -> None:
    noted = Noted()
    await noted.add_node("c", "n", "p", "e", **given)
    node = {"containerTag": "c", "nodeTag": "n", "pkg": "p", "exe": "e", **sent}
    assert noted.sent == [("CN", {"addNodes": [node]})]


async def test_an_amount_that_cannot_be_read_is_an_error_at_once() -> None:
    noted = Noted()
    with pytest.raises(ValueError, match=r"^cpu: must be a number of cores"):
        await noted.create_container("c", cpu="half")
    with pytest.raises(ValueError, match=r"^restart: must be one of never, on-failure, always"):
        await noted.add_node("c", "n", "p", "e", restart="sometimes")  # type: ignore[arg-type]  # what a type checker would refuse
    assert noted.sent == []


async def test_unknown_keywords_are_refused() -> None:
    with pytest.raises(TypeError, match="cpus"):
        await Noted().create_container("c", cpus=2)  # type: ignore[call-arg]  # what a type checker would refuse
