"""Builds what task sets are told: the spec of an endpoint."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce.control import ConnectionSpec, EndpointContents, EndpointSpec, LinkAddress, LinkSpec, SpecPatch
from rce.model import ParameterSpec
from rce_master.state import endpoints, packages, volumes
from rce_master.state.records import Container, Endpoint
from rce_master.state.wiring_records import Connection, Link

if TYPE_CHECKING:
    from rce_master.state.changes import Touched
    from rce_master.state.tables import Tables


def build_copy_spec(tables: Tables, id_: str) -> EndpointSpec:
    """Build the spec of the copy of a container that is being handed over.

    It has no interfaces, links and connections before its nodes are up.

    Raises:
        KeyError: There is no such container, or it has no copy.
    """
    if tables.moves[id_].linking_since is None:
        return build_spec(tables, id_, with_wiring=False)
    spec = build_spec(tables, id_)
    epoch = tables.moves[id_].epoch
    return replace(spec, links=tuple(_copy_end(tables, link, epoch) for link in spec.links))


def _copy_end(tables: Tables, link: LinkSpec, epoch: int) -> LinkSpec:
    """Return a copy's end of a link; the copies of two containers that move together are linked."""
    peer = _copy_address(tables, link.peer)
    address = peer if link.dial and peer is not None else link.address
    return replace(link, copy=True, address=address, next=None, epoch=epoch if link.dial else 0)


def _copy_address(tables: Tables, id_: str) -> LinkAddress | None:
    """Tell where the copy of a container accepts links; None without a copy that makes its links."""
    move = tables.moves.get(id_)
    if move is None or move.linking_since is None or move.status is None:
        return None
    return move.status.address


def build_spec(tables: Tables, id_: str, *, with_wiring: bool = True) -> EndpointSpec:
    """Build the spec of an endpoint from the tables.

    The same tables give the same spec, so a restarted master desires what it desired before.

    Args:
        tables: The tables.
        id_: The endpoint.
        with_wiring: Whether interfaces, links and connections are in it.

    Raises:
        KeyError: There is no such endpoint.
    """
    endpoint = tables.endpoints[id_]
    if not with_wiring:
        bare = EndpointSpec(id=id_, kind=endpoint.kind, revision=endpoint.revision)
        return _with_contents(tables, bare, endpoint)
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
    return _with_contents(tables, common, endpoint)


def _with_contents(tables: Tables, spec: EndpointSpec, endpoint: Endpoint) -> EndpointSpec:
    contents = _contents(tables, endpoint)
    return replace(
        spec,
        resources=contents.resources,
        nodes=contents.nodes,
        parameters=contents.parameters,
        packages=contents.packages,
        volumes=contents.volumes,
    )


def _contents(tables: Tables, endpoint: Endpoint) -> EndpointContents:
    if not isinstance(endpoint, Container):
        return EndpointContents()
    return EndpointContents(
        resources=endpoint.resources,
        nodes=tuple(endpoint.nodes.values()),
        parameters=tuple(ParameterSpec(name=n, value=v) for n, v in endpoint.parameters.items()),
        packages=packages.package_specs(tables, endpoint),
        volumes=volumes.placements(tables, endpoint),
    )


def build_patch(tables: Tables, id_: str, touched: Touched) -> SpecPatch:
    """Build what is desired now of the parts of an endpoint that changed; what is not there is removed.

    Raises:
        KeyError: There is no such endpoint.
    """
    endpoint = tables.endpoints[id_]
    interfaces = {tag: tables.interface(id_, tag) for tag in touched.interfaces}
    links = {link_id: tables.links.get(link_id) for link_id in touched.links}
    connections = {number: tables.connections.get(str(number)) for number in touched.connections}
    return SpecPatch(
        id=id_,
        base=touched.since,
        revision=endpoint.revision,
        interfaces=tuple(spec for spec in interfaces.values() if spec is not None),
        links=tuple(link_spec(tables, link, id_) for link in links.values() if link is not None),
        connections=tuple(connection_spec(one, id_) for one in connections.values() if one is not None),
        removed_interfaces=tuple(tag for tag, spec in interfaces.items() if spec is None),
        removed_links=tuple(link_id for link_id, link in links.items() if link is None),
        removed_connections=tuple(number for number, one in connections.items() if one is None),
        contents=_contents(tables, endpoint) if touched.contents else None,
    )


def link_spec(tables: Tables, link: Link, id_: str) -> LinkSpec:
    """Return one end of a link."""
    peer = link.peer(id_)
    dial = peer != id_ and endpoints.dials(tables, link, id_)
    moves_too = _copy_address(tables, id_) is not None
    return LinkSpec(
        id=link.id,
        peer=peer,
        token=link.token,
        dial=dial,
        address=endpoints.address(tables, peer) if dial else LinkAddress(),
        next=_copy_address(tables, peer) if dial and not moves_too else None,
        epoch=tables.endpoints[id_].epoch if dial else 0,
        peer_epoch=0 if dial or peer == id_ else tables.endpoints[peer].epoch,
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
