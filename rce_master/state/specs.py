"""Builds what task sets are told: the spec of an endpoint."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce.control.model import ConnectionSpec, EndpointSpec, LinkAddress, LinkSpec
from rce.model.specs import ParameterSpec
from rce_master.state import endpoints, packages
from rce_master.state.records import Container
from rce_master.state.wiring_records import Connection, Link

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
        interfaces=tuple(interface.spec for interface in tables.interfaces.by("endpoint", id_)),
        links=tuple(link_spec(tables, link, id_) for link in links),
        connections=tuple(
            connection_spec(connection, id_)
            for link in links
            for connection in tables.connections.by("link", link.id)
        ),
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


def link_spec(tables: Tables, link: Link, id_: str) -> LinkSpec:
    """Return one end of a link."""
    peer = link.peer(id_)
    dial = peer != id_ and endpoints.dials(tables, link, id_)
    return LinkSpec(
        id=link.id,
        peer=peer,
        token=link.token,
        dial=dial,
        address=endpoints.address(tables, peer) if dial else LinkAddress(),
    )


def connection_spec(connection: Connection, id_: str) -> ConnectionSpec:
    """Return one end of a connection; of a link with one endpoint only, that of the link's end ``a``."""
    is_a = id_ == connection.a
    return ConnectionSpec(
        id=connection.id,
        link=connection.link,
        interface=connection.interface_a if is_a else connection.interface_b,
        peer_interface=connection.interface_b if is_a else connection.interface_a,
    )
