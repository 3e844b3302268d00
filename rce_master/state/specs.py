"""Builds what task sets are told: the spec of an endpoint."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce.control.model import ConnectionSpec, EndpointSpec, LinkAddress, LinkSpec
from rce.model.specs import ParameterSpec
from rce_master.state import endpoints, packages
from rce_master.state.records import Container, Link

if TYPE_CHECKING:
    from rce_master.state.tables import Tables


def build_spec(tables: Tables, id_: str) -> EndpointSpec:
    """Build the spec of an endpoint from the tables.

    The same tables give the same spec, so a restarted master desires what it desired before.

    Raises:
        KeyError: There is no such endpoint.
    """
    endpoint = tables.endpoints[id_]
    links = sorted(tables.links.by("endpoint", id_), key=lambda link: link.id)
    common = EndpointSpec(
        id=id_,
        kind=endpoint.kind,
        revision=endpoint.revision,
        interfaces=tuple(endpoint.interfaces.values()),
        links=tuple(_link_spec(tables, link, id_) for link in links),
        connections=tuple(spec for link in links for spec in _connection_specs(link, id_)),
    )
    return _with_contents(tables, common, endpoint) if isinstance(endpoint, Container) else common


def _with_contents(tables: Tables, spec: EndpointSpec, container: Container) -> EndpointSpec:
    return EndpointSpec(
        id=spec.id,
        kind=spec.kind,
        revision=spec.revision,
        interfaces=spec.interfaces,
        links=spec.links,
        connections=spec.connections,
        resources=container.resources,
        nodes=tuple(container.nodes.values()),
        packages=packages.package_specs(tables, container),
        parameters=tuple(ParameterSpec(name=n, value=v) for n, v in container.parameters.items()),
    )


def _link_spec(tables: Tables, link: Link, id_: str) -> LinkSpec:
    peer = link.peer(id_)
    dial = peer != id_ and endpoints.dials(tables, link, id_)
    return LinkSpec(
        id=link.id,
        peer=peer,
        token=link.token,
        dial=dial,
        address=endpoints.address(tables, peer) if dial else LinkAddress(),
    )


def _connection_specs(link: Link, id_: str) -> list[ConnectionSpec]:
    return [
        ConnectionSpec(
            id=connection.id,
            link=link.id,
            interface=connection.interface_a if id_ == link.a else connection.interface_b,
            peer_interface=connection.interface_b if id_ == link.a else connection.interface_a,
        )
        for _, connection in sorted(link.connections.items())
    ]
