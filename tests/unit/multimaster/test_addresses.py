"""Names and addresses of masters and machines."""

from __future__ import annotations

import pytest

from rce.ros.multimaster import addresses
from rce.ros.multimaster.errors import NoSuchInterfaceError
from rce.ros.multimaster.settings import DiscoverySettings


def test_groups_with_interfaces() -> None:
    assert addresses.split_group("226.0.0.0@eth0") == ("226.0.0.0", "eth0")
    assert addresses.split_group("226.0.0.1") == ("226.0.0.1", "")
    assert addresses.split_group("@eth0") == ("226.0.0.0", "eth0")


async def test_an_interface_can_be_named() -> None:
    assert await addresses.address_of("lo") == await addresses.address_of("127.0.0.1") == "127.0.0.1"
    with pytest.raises(NoSuchInterfaceError):
        await addresses.address_of("192.0.2.77")


async def test_the_environment_names_the_address() -> None:
    assert await addresses.own_address("", "226.0.0.0", {"ROS_IP": "127.0.0.1"}) == "127.0.0.1"
    by_route = await addresses.own_address("", "226.0.0.0", {})
    assert await addresses.own_address("", "226.0.0.0", {"ROS_HOSTNAME": "localhost"}) == by_route


@pytest.mark.parametrize(
    ("uri", "address", "public"),
    [
        ("http://localhost:11311", "10.0.0.1", "http://10.0.0.1:11311/"),
        ("http://127.0.0.1:11312/", "10.0.0.1", "http://10.0.0.1:11312/"),
        ("http://127.0.0.1:11312/", "127.0.0.1", "http://127.0.0.1:11312/"),
        ("http://robot1:11311/", "10.0.0.1", "http://robot1:11311/"),
    ],
)
def test_a_master_on_loopback_gets_a_name_of_its_own(uri: str, address: str, public: str) -> None:
    assert addresses.public_uri(uri, address) == public


def test_masters_are_named_by_host_and_unusual_port() -> None:
    assert addresses.master_name("http://robot1:11311/") == "robot1"
    assert addresses.master_name("http://robot1:11312/") == "robot1_11312"


def test_the_rpc_port_follows_the_master() -> None:
    assert DiscoverySettings().rpc_port_for("http://robot1:11311/") == 11611
    assert DiscoverySettings(rpc_port=5).rpc_port_for("http://robot1:11311/") == 5


def test_robot_hosts_may_have_ports() -> None:
    settings = DiscoverySettings(robot_hosts=("robot1", "robot2:5000"))
    assert settings.robot_addresses == [("robot1", 11511), ("robot2", 5000)]


@pytest.mark.parametrize(
    "host", ["", ":5", "robot:", "robot:x", "robot:0", "robot:65536", "r:1:2", " r", "r:²"]
)
def test_robot_hosts_of_another_form_are_refused(host: str) -> None:
    with pytest.raises(ValueError, match=r"is not HOST or HOST:PORT|a port is a number of 1 to 65535"):
        DiscoverySettings(robot_hosts=(host,))


@pytest.mark.parametrize("hertz", [0, -1, 26, float("nan")])
def test_rates_must_fit_a_heartbeat(hertz: float) -> None:
    with pytest.raises(ValueError, match="heartbeat_hz"):
        DiscoverySettings(heartbeat_hz=hertz)
