"""Interfaces whose type may be in a package that has yet to arrive, and the connections that need them."""

from __future__ import annotations

from pathlib import Path

import pytest

from rce.control.model import ConnectionSpec, EndpointKind, EndpointSpec, LinkSpec, PackageSpec
from rce.model.specs import InterfaceSpec
from rce_container.environment.user_packages import UserPackages

NAV = PackageSpec(name="nav", version="1.0", sha256="a" * 64, signature="", key="")
GOAL = InterfaceSpec(tag="goal", type="SubscriberInterface", message_type="nav/Goal", addr="/goal")
SAY = InterfaceSpec(tag="say", type="PublisherInterface", message_type="std_msgs/String", addr="/say")
SPEC = EndpointSpec(
    id="user/box",
    kind=EndpointKind.CONTAINER,
    revision=1,
    interfaces=(GOAL, SAY),
    links=(
        LinkSpec(id="own", peer="user/box", token="t", dial=False),
        LinkSpec(id="robot", peer="user/robot", token="t", dial=False),
    ),
    connections=(
        ConnectionSpec(id=1, link="own", interface="goal", peer_interface="say"),
        ConnectionSpec(id=2, link="own", interface="say", peer_interface="goal"),
        ConnectionSpec(id=3, link="robot", interface="goal", peer_interface="say"),
        ConnectionSpec(id=4, link="robot", interface="say", peer_interface="goal"),
    ),
)


@pytest.fixture
def packages(tmp_path: Path) -> UserPackages:
    """Packages of a container to which ``nav`` has yet to come."""
    made = UserPackages(str(tmp_path), ())
    made.apply((NAV,))
    return made


def test_connections_with_a_held_back_end_wait(packages: UserPackages) -> None:
    """Both ends of a connection of the container with itself are here; a peer's tags mean nothing here."""
    held = packages.hold_back(SPEC, ())
    assert held.interfaces == (SAY,)
    assert [one.id for one in held.connections] == [4]


def test_what_exists_or_has_arrived_is_not_held_back(packages: UserPackages, tmp_path: Path) -> None:
    held = packages.hold_back(SPEC, (GOAL,))
    assert (held.interfaces, held.connections) == (SPEC.interfaces, SPEC.connections)
    (tmp_path / NAV.sha256).mkdir()
    assert packages.hold_back(SPEC, ()) is SPEC
