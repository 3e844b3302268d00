"""Specs of containers for tests, and of their links to a peer."""

from __future__ import annotations

from typing import Unpack

from rce.control.model import (
    ConnectionSpec,
    EndpointKind,
    EndpointSpec,
    LinkAddress,
    LinkSpec,
)
from rce.model.specs import InterfaceSpec, NodeSpec
from support.parts import SpecParts

MACHINE = "testmachine"


ECHO = NodeSpec(tag="echo", pkg="Test", exe="stringEcho.py")


class ContainerParts(SpecParts, total=False):
    """What :func:`container` makes a spec of."""

    peer: str
    dial: LinkAddress | None


def container(
    id_: str,
    revision: int,
    *,
    peer: str = "",
    dial: LinkAddress | None = None,
    **parts: Unpack[SpecParts],
) -> EndpointSpec:
    """A container's spec; with ``peer``, wired to it over one link."""
    if peer:
        parts["links"], parts["connections"] = wiring(
            peer, dial, [i.tag for i in parts.get("interfaces", ())]
        )
    return EndpointSpec(id=id_, kind=EndpointKind.CONTAINER, revision=revision, **parts)


def wiring(
    peer: str, dial: LinkAddress | None, tags: list[str]
) -> tuple[tuple[LinkSpec, ...], tuple[ConnectionSpec, ...]]:
    """The link to a peer, and a connection over it for each tag, with the interface of the same tag there."""
    link = LinkSpec(id="link", peer=peer, token="token", dial=dial is not None, address=dial or LinkAddress())
    connections = tuple(
        ConnectionSpec(id=number, link="link", interface=tag, peer_interface=tag)
        for number, tag in enumerate(tags, 1)
    )
    return (link,), connections


STRING = "std_msgs/String"


ECHO_INTERFACES = (
    InterfaceSpec(tag="req", type="PublisherInterface", message_type=STRING, addr="stringEchoReq"),
    InterfaceSpec(tag="resp", type="SubscriberInterface", message_type=STRING, addr="stringEchoResp"),
    InterfaceSpec(
        tag="srv", type="ServiceClientInterface", message_type="Test/StringEcho", addr="stringEchoService"
    ),
)
