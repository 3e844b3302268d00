"""The requests of a connection as methods: their keywords are the fields of the protocol's messages."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

import msgspec
import pytest
from msgspec import NODEFAULT, Struct
from msgspec.structs import fields

from rce.protocol.messages import AddInterface, AddNode, ContainerData, ResizeData, type_of
from rce_client.requests import Requests

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce.protocol.messages import Request

RENAMED = {
    "node_tag": "tag",
    "container_tag": "container",
    "endpoint_tag": "endpoint",
    "interface_tag": "tag",
}
METHODS: list[tuple[Callable[..., Any], type[Struct], set[str]]] = [
    (Requests.create_container, ContainerData, {"tag"}),
    (Requests.resize_container, ResizeData, {"tag"}),
    (Requests.add_node, AddNode, set()),
    (Requests.add_interface, AddInterface, set()),
]


class Noted(Requests):
    """Keeps what it is to send, as JSON."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, Any]] = []

    async def request(self, request: Request) -> None:
        self.sent.append((type_of(request), msgspec.json.decode(msgspec.json.encode(request))))


@pytest.mark.parametrize(("method", "struct", "more"), METHODS)
def test_a_method_has_the_fields_of_its_message(
    method: Callable[..., Any], struct: type[Struct], more: set[str]
) -> None:
    """A field that is new in the protocol is a keyword here, with the same default."""
    parameters = dict(inspect.signature(method).parameters)
    del parameters["self"]
    wanted = {RENAMED.get(field.name, field.name): field for field in fields(struct)}
    assert parameters.keys() == wanted.keys() | more
    for name, field in wanted.items():
        if field.default is not NODEFAULT:
            assert parameters[name].default == field.default
            assert type(parameters[name].default) is type(field.default)
        assert parameters[name].annotation not in (inspect.Parameter.empty, "Any")


@pytest.mark.parametrize(
    ("given", "sent"),
    [
        ({}, {}),
        ({"size": 1, "cpu": 0, "memory": 0.0, "special_features": [], "group": ""}, {}),
        ({"size": 2, "cpu": "50%"}, {"size": 2, "cpu": "50%"}),
        ({"special_features": ("gpu", "arm")}, {"specialFeatures": ["gpu", "arm"]}),
        ({"special_features": "gpu arm"}, {"specialFeatures": "gpu arm"}),
        ({"network": "group", "group": "g", "wait": True}, {"network": "group", "group": "g", "wait": True}),
    ],
)
async def test_only_requested_fields_are_sent(given: dict[str, Any], sent: dict[str, Any]) -> None:
    noted = Noted()
    await noted.create_container("c", **given)
    assert noted.sent == [("CC", {"containerTag": "c", "containerData": sent})]


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


async def test_unknown_keywords_are_refused() -> None:
    with pytest.raises(TypeError, match="cpus"):
        await Noted().create_container("c", cpus=2)  # type: ignore[call-arg]
