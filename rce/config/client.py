"""The config file of ``rce-ros``: the robot, and its containers, nodes and connections in the cloud.

Keys are those of the RoboEarth Cloud Engine's files (``docs/protocol.md``).
"""

from __future__ import annotations

import contextlib
import ipaddress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import urlsplit

from pydantic import AfterValidator, BeforeValidator, Field, SecretStr, ValidationError, model_validator

from rce.config import client_checks
from rce.config.bridges import Bridge, expand
from rce.config.documents import parse, read_file
from rce.config.exceptions import ConfigError, Fault
from rce.config.items import Container, Interface, ItemOf, Link, Name, Node, Parameter
from rce.config.validation import Strict, faults_of
from rce.masters import split_addresses
from rce.model import (
    AddInterface,
    AddNode,
    ConfigureComponents,
    ConfigureConnections,
    Connection,
    CreateContainer,
    DeleteParameter,
    DestroyContainer,
    InterfaceSpec,
    RemoveInterface,
    RemoveNode,
    Request,
    SetParameter,
)

if TYPE_CHECKING:
    from collections.abc import Mapping


def _check_urls(given: Any) -> Any:
    """Take one address or a list of them; return them as one text, separated by commas."""
    urls = given if isinstance(given, list | tuple) and given else [given]
    if not all(isinstance(url, str) for url in urls):
        raise ValueError("must be the master's address such as http://master:9000/, or a list of addresses")
    parts = [part for url in urls for part in split_addresses(url) or ("",)]
    return ",".join(map(_check_url, parts))


def _check_url(url: str) -> str:
    try:
        parts = urlsplit(url)
        valid = parts.scheme in ("http", "https") and _is_host(parts.hostname or "") and parts.port != 0
        valid = valid and url.isprintable() and " " not in url
    except ValueError:
        valid = False
    if not valid:
        raise ValueError("must be the master's address such as http://master:9000/")
    return url


def _is_host(host: str) -> bool:
    with contextlib.suppress(ValueError):
        return bool(ipaddress.ip_address(host))
    return all(character.isalnum() or character in "-._" for character in host) and host.strip(".") != ""


def _check_authority(text: str) -> str:
    if text and not Path(text).expanduser().is_file():
        raise ValueError(f"there is no file {text}; copy authority.pem from the engine's certificates folder")
    return text


class ClientConfig(Strict):
    """The contents of one robot's file.

    Beside ``url`` the file may have ``urls``, a list of further masters; programs that know ``url`` only
    can read the same file.
    """

    @model_validator(mode="before")
    @classmethod
    def _join_urls(cls, document: Any) -> Any:
        if not isinstance(document, dict) or "urls" not in document:
            return document
        rest = {key: value for key, value in document.items() if key != "urls"}
        more = document["urls"]
        if not isinstance(more, list | tuple) or not all(isinstance(url, str) for url in more):
            raise ValueError("urls must be a list of masters' addresses, such as [http://master2:9000/]")
        first = rest.get("url", [])
        found = [*(first if isinstance(first, list | tuple) else [first]), *more]
        if found:
            rest["url"] = list(dict.fromkeys(found)) if all(isinstance(url, str) for url in found) else found
        return rest

    url: Annotated[str, BeforeValidator(_check_urls)]
    """The master's address; several, which are separated by commas here and may be a list in the file, are
    tried in turn."""
    user: Name = Field(alias="userID")
    password: SecretStr = SecretStr("")
    """The user's password; empty if there is a token."""
    token: SecretStr = SecretStr("")
    """The robot's own token, as ``rce robot add`` gives it."""
    robot: Name = Field(alias="robotID")
    authority: Annotated[str, AfterValidator(_check_authority)] = ""
    """File with the authority that issued the engine's certificate; the system's authorities if empty."""
    containers: tuple[Container, ...] = Field(default=(), strict=False)
    nodes: tuple[Node, ...] = Field(default=(), strict=False)
    parameters: tuple[Parameter, ...] = Field(default=(), strict=False)
    interfaces: tuple[Interface, ...] = Field(default=(), strict=False)
    """Those that the file lists, and those that its bridges need."""
    connections: tuple[Link, ...] = Field(default=(), strict=False)
    """Those that the file lists, and those that its bridges need."""
    bridges: tuple[Bridge, ...] = Field(default=(), strict=False)
    """The short form of interfaces and connections."""

    @property
    def untyped(self) -> dict[int, Bridge]:
        """The bridges without a type, by their index."""
        return {index: bridge for index, bridge in enumerate(self.bridges) if bridge.type is None}

    @property
    def robot_interfaces(self) -> tuple[InterfaceSpec, ...]:
        """The interfaces of the robot itself."""
        return tuple(item.interface for item in self.interfaces if item.endpoint == self.robot)

    @property
    def authority_file(self) -> Path | None:
        """The certificate of the authority to trust; None for the system's authorities."""
        return Path(self.authority).expanduser() if self.authority else None

    def setup(self) -> list[Request]:
        """Return the requests that make everything, in the order in which they must be sent."""
        requests: list[Request] = [*self.containers]
        if self.nodes or self.parameters or self.interfaces:
            requests.append(
                ConfigureComponents(
                    set_param=self.parameters, add_nodes=self.nodes, add_interfaces=self.interfaces
                )
            )
        if self.connections:
            requests.append(ConfigureConnections(connect=self.connections))
        return requests

    def teardown(self) -> list[Request]:
        """Return the requests that remove everything again, in order."""
        requests: list[Request] = []
        if self.connections:
            requests.append(ConfigureConnections(disconnect=self.connections))
        if self.nodes or self.parameters or self.interfaces:
            requests.append(
                ConfigureComponents(
                    remove_interfaces=tuple(
                        RemoveInterface(endpoint=item.endpoint, tag=item.interface.tag)
                        for item in self.interfaces
                    ),
                    remove_nodes=tuple(
                        RemoveNode(container=item.container, tag=item.node.tag) for item in self.nodes
                    ),
                    delete_param=tuple(
                        DeleteParameter(container=item.container, name=item.parameter.name)
                        for item in self.parameters
                    ),
                )
            )
        requests += [DestroyContainer(tag=item.tag) for item in self.containers]
        return requests


def load(path: Path) -> ClientConfig:
    """Read a config file, JSON or YAML.

    Raises:
        ConfigError: It cannot be read, or has faults; every fault is listed.
    """
    return loads(read_file(path), str(path))


def loads(
    text: str, source: str = "config", *, types: Mapping[int, str] | None = None, draft: bool = False
) -> ClientConfig:
    """Read a config from text.

    Args:
        text: JSON or YAML.
        source: Name of the file, for errors.
        types: Types of bridges that give none, by index.
        draft: Leave bridges out whose type is not known, instead of refusing the file.

    Raises:
        ConfigError: It has faults; every fault is listed.
    """
    data = parse(text, source)
    if not isinstance(data, dict):
        raise ConfigError(
            source, [Fault("", "must be an object with the keys url, userID, password, robotID")]
        )
    try:
        config, faults = ClientConfig.model_validate(data), []
    except ValidationError as error:
        config, faults = None, faults_of(error, ClientConfig)
    faults += client_checks.credential_faults(data)
    parts = client_checks.Parts.salvage(data, _ITEMS)
    if config is not None:
        known = types or {}
        wiring = expand(config.bridges, known, config.robot, config.interfaces, config.connections)
        unknown = config.untyped.keys() - known.keys()
        faults += wiring.faults
        if not draft:
            faults += [Fault(f"bridges[{index}].type", _NO_TYPE) for index in sorted(unknown)]
        parts = client_checks.Parts(
            config.robot,
            complete=not unknown,
            containers=list(enumerate(config.containers)),
            nodes=list(enumerate(config.nodes)),
            parameters=list(enumerate(config.parameters)),
            interfaces=list(enumerate(wiring.interfaces)),
            connections=list(enumerate(wiring.connections)),
            origins=wiring.origins,
        )
        made = {"interfaces": tuple(wiring.interfaces), "connections": tuple(wiring.connections)}
        config = config.model_copy(update=made)
    faults += client_checks.check(parts)
    if faults or config is None:
        raise ConfigError(source, faults)
    return config


_NO_TYPE = "is missing; only rce-ros can read it, from the robot's ROS graph"

_ITEMS: dict[str, ItemOf[Any]] = {
    "containers": ItemOf(CreateContainer),
    "nodes": ItemOf(AddNode),
    "parameters": ItemOf(SetParameter),
    "interfaces": ItemOf(AddInterface),
    "connections": ItemOf(Connection),
}
