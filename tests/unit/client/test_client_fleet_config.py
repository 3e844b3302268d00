"""The fleet's configs, as made and as shipped."""

from __future__ import annotations

from pathlib import Path

import pytest

from rce.config.client import ClientConfig, load, loads
from rce.config.documents import write_items
from rce.model.names import Role
from rce_client.ros_bridge.explain import wires
from rce_fleet.station.commands.kinds import COMMANDS
from rce_fleet.station.layers.kinds import TOPICS
from rce_fleet.wiring import FleetAccount, fleet_config, robot_config

CONFIGS = Path(__file__).parents[3] / "configs"


@pytest.mark.parametrize("number", [1, 2, 3])
def test_shipped_robot_files_are_what_is_made(number: int) -> None:
    assert (CONFIGS / f"robot{number}.config").read_text() == write_items(robot_config(number))


def test_the_shipped_operator_file_is_what_is_made() -> None:
    assert (CONFIGS / "fleet.config").read_text() == write_items(fleet_config())


@pytest.mark.parametrize(("robots", "memory"), [(3, 0), (250, 0), (400, 712), (1000, 1012)])
def test_a_large_fleet_asks_for_memory(robots: int, memory: int) -> None:
    """Planner and manager of a thousand robots were ended for memory at the limit of one slot."""
    (container,) = loads(write_items(fleet_config(robots=robots))).containers
    assert container.resources.memory == memory << 20


@pytest.mark.parametrize("name", ["test", "robot1-long", "robot1", "robot2", "robot3", "fleet"])
def test_shipped_files_are_valid(name: str) -> None:
    load(CONFIGS / f"{name}.config")


def test_the_long_form_says_the_same_as_the_short_one() -> None:
    long, short = (load(CONFIGS / f"{name}.config") for name in ("robot1-long", "robot1"))
    assert not long.bridges
    assert set(wires(long)) == set(wires(short))
    assert (long.containers, long.nodes) == (short.containers, short.nodes)


def made(number: int) -> ClientConfig:
    return loads(write_items(robot_config(number, FleetAccount(url="http://cloud:1/", user="u"))))


@pytest.mark.parametrize("number", [1, 12, 100])
def test_any_number_of_robots(number: int) -> None:
    config = made(number)
    assert config.robot == f"testRobot_{number}"
    assert config.nodes[0].node.namespace == f"Robot{number}"
    assert {item.interface.addr for item in config.interfaces if item.endpoint == "cTag_fleet"} == {
        "/fleet/map",
        *(
            f"/Robot{number}/{topic}"
            for topic in (
                *("amcl_pose", "battery_state", "blockedCells", "goalNodesList", "cancelGoal"),
                "moveClient/status",
            )
        ),
    }


def test_robots_do_not_get_in_each_others_way() -> None:
    one, two = made(1), made(2)
    assert not {item.tag for item in one.containers} & {item.tag for item in two.containers}
    assert not {item.path for item in one.interfaces} & {item.path for item in two.interfaces}


def test_every_interface_is_connected_with_its_complement() -> None:
    config = made(1)
    interfaces = {item.path: item.interface for item in config.interfaces}
    used = set()
    for link in config.connections:
        a, b = interfaces[link.tag_a], interfaces[link.tag_b]
        assert (a.kind.role, b.kind.role) == (Role.SUBSCRIBER, Role.PUBLISHER)
        assert a.message_type == b.message_type
        used |= {link.tag_a, link.tag_b}
    offered = {path for path in interfaces if "/layer_" in path or "/command_" in path}
    assert len(offered) == len(TOPICS) + len(COMMANDS)
    assert used == set(interfaces) - offered
