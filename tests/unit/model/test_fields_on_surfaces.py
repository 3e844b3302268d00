"""Each field of a request arrives on every surface: protocol, config file, REST API and control channel.

The library's keywords are compared with the fields in ``tests/unit/client/test_client_requests.py``.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from enum import Enum
from typing import Any, get_origin

import msgspec
import pytest
import yaml

from rce.config import items
from rce.config.client import loads
from rce.control.messages import ClientRequest, Put, decode_to_master, decode_to_task_set, encode
from rce.control.model import EndpointKind, EndpointSpec
from rce.model import StateServices, Volume
from rce.model.requests import (
    AddInterface,
    AddNode,
    ConfigureComponents,
    ConfigureConnections,
    Connection,
    CreateContainer,
    Item,
    Request,
    ResizeContainer,
    SetParameter,
)
from rce.model.spelling import PLAIN, Field, Spelling, fields_of
from rce.protocol.messages import type_of
from rce.protocol.requests import SPELLING as PROTOCOL
from rce.protocol.requests import read_request, write_request
from rce_master.http import api_control, api_read, spec_models
from rce_master.http.model import Model

SAMPLES: dict[str, Any] = {
    "type": "PublisherInterface",
    "message_type": "a/B",
    "group_ip": "10.0.0.2",
    "tag_a": "a/x",
    "tag_b": "b/x",
    "volumes": (Volume(name="x", path="/data", size=64 << 20),),
    "state_services": StateServices(save="~save", restore="~restore", every=2.5),
    "value": [1, 2.5, "x", True],
}
"""Where any value of the type will not do."""
REQUESTS: list[type[Request | Item]] = [
    CreateContainer,
    ResizeContainer,
    AddNode,
    SetParameter,
    AddInterface,
    Connection,
]
FIELDS = [(cls, field) for cls in REQUESTS for field in fields_of(cls)]


def sample(field: Field) -> Any:
    """Make a value of a field that is not its default."""
    if field.name in SAMPLES:
        return SAMPLES[field.name]
    kept = field.kept
    if isinstance(kept, type) and issubclass(kept, Enum):
        return list(kept)[-1]
    if get_origin(kept) is tuple:
        return ("x",)
    if isinstance(field.default, bool):
        return not field.default
    return "x" if kept is str else 7


def filled(cls: type[Request | Item]) -> Request | Item:
    """Make a request in which every field differs from its default."""
    given = {field.name: field.rule.write(sample(field)) for field in fields_of(cls)}
    return PLAIN.read(cls, given)


def whole(item: Request | Item) -> Request:
    """Make a request that holds an item."""
    match item:
        case AddNode():
            return ConfigureComponents(add_nodes=(item,))
        case SetParameter():
            return ConfigureComponents(set_param=(item,))
        case AddInterface():
            return ConfigureComponents(add_interfaces=(item,))
        case Connection():
            return ConfigureConnections(connect=(item,))
        case CreateContainer() | ResizeContainer():
            return item
        case _:
            raise AssertionError(item)


@pytest.mark.parametrize("cls", REQUESTS)
def test_filled_request_has_no_defaults(cls: type[Request | Item]) -> None:
    """What the other tests compare says something of every field."""
    item = filled(cls)
    assert [field.name for field in fields_of(cls) if field.get(item) == field.default] == []


@pytest.mark.parametrize("cls", REQUESTS)
@pytest.mark.parametrize("spelling", [PROTOCOL, items.SPELLING, spec_models.SPELLING, PLAIN])
def test_fields_return_from_every_spelling(cls: type[Request | Item], spelling: Spelling) -> None:
    item = filled(cls)
    data = json.loads(json.dumps(spelling.write(item)))
    assert spelling.read(cls, data) == item


@pytest.mark.parametrize("cls", REQUESTS)
def test_fields_return_from_the_client_protocol(cls: type[Request | Item]) -> None:
    request = whole(filled(cls))
    data = json.loads(json.dumps(write_request(request)))
    assert read_request(type_of(request), data) == request


@pytest.mark.parametrize("cls", REQUESTS)
def test_fields_return_from_the_control_channel(cls: type[Request | Item]) -> None:
    asked = ClientRequest(request=1, id="u/r", type="CN", data=None, content=whole(filled(cls)))
    assert decode_to_master(encode(asked)) == asked


def test_specs_return_from_the_control_channel() -> None:
    create, node, interface = filled(CreateContainer), filled(AddNode), filled(AddInterface)
    assert isinstance(create, CreateContainer)
    assert isinstance(node, AddNode)
    assert isinstance(interface, AddInterface)
    spec = EndpointSpec(
        id="u/c",
        kind=EndpointKind.CONTAINER,
        revision=1,
        resources=create.resources,
        nodes=(node.node,),
        interfaces=(interface.interface,),
    )
    assert decode_to_task_set(encode(Put(endpoint=spec))) == Put(endpoint=spec)


def test_older_names_stay_on_the_control_channel() -> None:
    """Task sets of the release before read them."""
    interface = filled(AddInterface)
    assert isinstance(interface, AddInterface)
    sent = msgspec.to_builtins(interface.interface)
    assert sent == {"tag": "x", "type": "PublisherInterface", "cls": "a/B", "addr": "x", "queue_size": 7}


@pytest.mark.parametrize("write", [json.dumps, yaml.safe_dump])
def test_fields_return_from_a_config_file(write: Callable[[object], str]) -> None:
    keys: dict[str, type[Request | Item]] = {
        "containers": CreateContainer,
        "nodes": AddNode,
        "parameters": SetParameter,
        "interfaces": AddInterface,
    }
    wanted = {key: filled(cls) for key, cls in keys.items()}
    file: dict[str, Any] = {
        "url": "http://127.0.0.1:9000/",
        "userID": "u",
        "password": "p",
        "robotID": "robot",
    }
    written = {key: [json.loads(json.dumps(items.SPELLING.write(item)))] for key, item in wanted.items()}
    written["nodes"][0]["after"] = ["other"]  # a node cannot come after itself
    config = loads(write(file | written))
    read = {key: getattr(config, key)[0] for key in keys}
    node = wanted.pop("nodes")
    assert isinstance(node, AddNode)
    assert read.pop("nodes") == AddNode(
        container="x", node=msgspec.structs.replace(node.node, after=("other",))
    )
    assert read == wanted


@pytest.mark.parametrize(
    ("cls", "model", "in_path"),
    [
        (CreateContainer, spec_models.ContainerIn, ()),
        (ResizeContainer, spec_models.ResizeIn, ("container",)),
        (AddNode, spec_models.NodeIn, ("container",)),
        (SetParameter, spec_models.ParameterIn, ("container",)),
        (AddInterface, spec_models.InterfaceIn, ("endpoint",)),
        (Connection, spec_models.ConnectionIn, ()),
    ],
)
def test_fields_are_in_the_bodies_of_the_rest_api(
    cls: type[Request | Item], model: type[Model], in_path: tuple[str, ...]
) -> None:
    data = json.loads(json.dumps(spec_models.SPELLING.write(filled(cls))))
    assert model.model_json_schema()["properties"].keys() | set(in_path) == data.keys()
    body = model.model_validate({key: value for key, value in data.items() if key not in in_path})
    sent = body.model_dump(exclude_unset=True) | {key: data[key] for key in in_path}
    assert spec_models.SPELLING.read(cls, sent) == filled(cls)


def test_fields_are_in_the_answers_of_the_rest_api() -> None:
    node, interface, create = filled(AddNode), filled(AddInterface), filled(CreateContainer)
    assert isinstance(node, AddNode)
    assert isinstance(interface, AddInterface)
    assert isinstance(create, CreateContainer)
    for model, spec in (
        (spec_models.NodeOut, node.node),
        (spec_models.InterfaceOut, interface.interface),
        (spec_models.RequestedOut, create.resources),
    ):
        shown = spec_models.shown(spec)
        assert shown.keys() <= model.model_json_schema()["properties"].keys()
        assert len(shown) == len(fields_of(type(spec)))


def test_every_route_takes_the_models_that_are_tested_here() -> None:
    taken = {route.body for route in api_control.routes if route.body is not None}
    assert {model.__name__ for model in taken} == {
        "ContainerIn", "ResizeIn", "NodeIn", "ParameterIn", "InterfaceIn", "ConnectionIn",
    }  # fmt: skip
    assert {"NodesOut", "InterfacesOut", "ContainersOut"} <= {
        route.reply.__name__ for route in api_read.routes if route.reply is not None
    }


NEW_FIELD = """
import json, sys
from importlib.abc import InspectLoader, MetaPathFinder
from importlib.machinery import PathFinder
from importlib.util import spec_from_loader

class Changed(MetaPathFinder, InspectLoader):
    def find_spec(self, name, path=None, target=None):
        if name != "rce.model.specs":
            return None
        self.file = PathFinder.find_spec(name, path).origin
        return spec_from_loader(name, self)

    def get_source(self, name):
        source = open(self.file).read()
        line = '    image: Annotated[str, '
        assert source.count(line) == 1
        return source.replace(line, '    gpu_count: Annotated[int, _TIMES] = 0\\n' + line)

sys.meta_path.insert(0, Changed())

from rce.config.client import loads
from rce.control.messages import ClientRequest, decode_to_master, encode
from rce.model.requests import CreateContainer
from rce.model.spelling import PLAIN
from rce.protocol.requests import read_request, write_request
from rce.web.openapi import build_document
from rce_master.http import api_control, api_read
from rce_master.http.models import Error
from rce_master.requests import read

sent = PLAIN.read(CreateContainer, {"tag": "c", "gpu_count": 2})
wire = write_request(sent)
asked = decode_to_master(
    encode(ClientRequest(request=1, id="u/r", type="CC", data=None, content=read_request("CC", wire)))
)
(command,), _ = read("u", asked)
file = {"url": "http://h:9000/", "userID": "u", "password": "p", "robotID": "r"}
config = loads(json.dumps(file | {"containers": [{"cTag": "c", "gpuCount": 2}]}))
operations = [route.operation for table in (api_control.routes, api_read.routes) for route in table]
document = build_document(operations, title="t", description="d", error=Error)
schemas = document["components"]["schemas"]
try:
    read_request("CC", {"containerTag": "c", "containerData": {"gpuCount": -1}})
except Exception as error:
    fault = str(error)
print(json.dumps({
    "wire": wire,
    "command": command.resources.gpu_count,
    "config": config.containers[0].resources.gpu_count,
    "rest": [name for name in ("ContainerIn", "RequestedOut") if "gpu_count" in schemas[name]["properties"]],
    "fault": fault,
}))
"""
"""A program in which a container has one field more, by one more line in ``rce/model/specs.py``."""


@pytest.mark.slow
def test_new_field_of_a_container_is_one_line() -> None:
    """It is read, checked, sent, stored in the command, described and shown; nothing else was changed."""
    done = subprocess.run([sys.executable, "-c", NEW_FIELD], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {
        "wire": {"containerTag": "c", "containerData": {"gpuCount": 2}},
        "command": 2,
        "config": 2,
        "rest": ["ContainerIn", "RequestedOut"],
        "fault": "data.containerData.gpuCount: must be int >= 0",
    }
