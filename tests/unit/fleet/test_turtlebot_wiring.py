"""The two wirings of a TurtleBot: on the robot, and in its container; as made and as shipped."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from rce.config.client import ClientConfig, load, loads
from rce.config.documents import write_items
from rce.model.names import Role
from rce.ros.packages import PackageIndex
from rce.ros.substitution import split_arguments
from rce_client.ros_bridge.explain import dot, picture, wires
from rce_fleet.nodes.amcl_parameters import AmclNodeParameters
from rce_fleet.nodes.move_base_parameters import read_settings
from rce_fleet.nodes.parameter_values import read_values
from rce_fleet.turtlebot_wiring import offloaded_config, onboard_config

CONFIGS = Path(__file__).parents[3] / "configs"
STARTS = {1: (0.5, 0.5, 0.0), 2: (7.5, 0.5, 0.0), 3: (0.5, 7.5, 0.0)}


def shipped(name: str) -> ClientConfig:
    return load(CONFIGS / "turtlebot" / f"{name}.config")


def tree(config: ClientConfig, node: str) -> dict[str, Any]:
    """The private parameters of a node."""
    found: dict[str, Any] = {}
    for item in config.parameters:
        name = item.parameter.name
        if name.startswith(f"/{node}/"):
            inner = found
            *spaces, last = name.removeprefix(f"/{node}/").split("/")
            for space in spaces:
                inner = inner.setdefault(space, {})
            inner[last] = item.parameter.value
    return found


def at_robot(config: ClientConfig) -> set[str]:
    """What is connected at the robot."""
    found = set()
    for wire in wires(config):
        ends = ((wire.source, wire.source_name), (wire.target, wire.target_name))
        found |= {name for endpoint, name in ends if endpoint == config.robot}
    return found


@pytest.mark.parametrize("number", STARTS)
def test_shipped_files_are_what_is_made(number: int) -> None:
    folder = CONFIGS / "turtlebot"
    made = {
        f"robot{number}": onboard_config(number),
        f"robot{number}-offload": offloaded_config(number, initial_pose=STARTS[number]),
    }
    for name, config in made.items():
        assert (folder / f"{name}.config").read_text() == write_items(config)


@pytest.mark.parametrize("name", ["robot1", "robot1-offload"])
def test_every_interface_is_connected_with_its_complement(name: str) -> None:
    config = shipped(name)
    interfaces = {item.path: item.interface for item in config.interfaces}
    used = set()
    for link in config.connections:
        a, b = interfaces[link.tag_a], interfaces[link.tag_b]
        assert a.kind.role in (Role.SUBSCRIBER, Role.SERVICE_CLIENT)
        assert b.kind.role is a.kind.role.complement
        assert a.message_type == b.message_type
        used |= {link.tag_a, link.tag_b}
    of_the_station = {path for path in interfaces if "/layer_" in path or "/command_" in path}
    assert used | of_the_station == set(interfaces)


@pytest.mark.parametrize("own_map", [True, False])
def test_the_maps_layer_comes_from_where_the_map_is(own_map: bool) -> None:
    """A container's interface does not receive what another of its interfaces publishes."""
    made = offloaded_config(1, own_map=own_map)
    (endpoint,) = [each["eTag"] for each in made["interfaces"] if each["iTag"] == "layer_Robot1_map"]
    assert endpoint == ("testRobot_1" if own_map else "cTag_01")
    into_box = [each for each in made["bridges"] if each.get("topic") == "/map" and each["to"] == "cTag_01"]
    assert bool(into_box) == own_map


def test_a_robot_with_its_own_nodes_sends_poses_and_cells() -> None:
    config = shipped("robot1")
    assert [item.node.exe for item in config.nodes] == ["move_client.py"]
    own = at_robot(config)
    assert {"/amcl_pose", "/blockedCells", "/freedCells", "/fleet/map", "/move_base/goal"} <= own
    assert not {"/scan", "/odom", "/raw_cmd_vel"} & own


def test_an_offloaded_robot_sends_sensors_and_takes_velocities() -> None:
    config = shipped("robot1-offload")
    up = {"/scan", "/odom", "/tf", "/tf_static", "/initialpose", "/move_base_simple/goal"}
    down = {"/raw_cmd_vel", "/speed_limit", "/amcl_pose", "/last_pose"}
    assert at_robot(config) == {*up, *down, "/battery_state"}
    nodes = [f"{item.node.pkg}/{item.node.exe}" for item in config.nodes]
    assert nodes == [
        *("map_server/map_server", "amcl/amcl", "move_base/move_base"),
        *("fleet/obstacle_cells.py", "fleet/move_client.py"),
    ]


def test_both_wirings_have_the_same_nodes_in_the_fleet() -> None:
    """For the planner it makes no difference where a robot's nodes run."""

    def at_planner(config: ClientConfig) -> set[tuple[str, str]]:
        planner = [item.interface for item in config.interfaces if item.endpoint == "cTag_fleet"]
        return {(one.addr, one.message_type) for one in planner}

    assert at_planner(shipped("robot1")) == at_planner(shipped("robot1-offload"))


def test_the_container_has_all_packages_and_files() -> None:
    packages = PackageIndex([CONFIGS])
    for item in shipped("robot1-offload").nodes:
        assert packages.find(item.node.pkg).executable(item.node.exe)
        for word in split_arguments(item.node.args, packages, {}):
            assert ":=" in word or Path(word).is_file()


def test_the_container_nodes_take_all_parameters() -> None:
    config = shipped("robot2-offload")
    found, problems = read_values(AmclNodeParameters, tree(config, "amcl"))
    assert problems == []
    assert (found.initial_pose_x, found.initial_pose_y, found.initial_pose_a) == STARTS[2]
    assert read_settings(tree(config, "move_base"))[1] == []


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("robot1", "/amcl_pose"),
        ("robot1-offload", "/raw_cmd_vel"),
        ("robot2-offload", "/Robot2/goalNodesList"),
    ],
)
def test_a_wiring_is_explained(name: str, line: str) -> None:
    config = shipped(name)
    assert line in picture(config)
    assert line in dot(config)
    assert any(line in (wire.source_name, wire.target_name) for wire in wires(config))


def test_any_number_of_robots_do_not_get_in_each_others_way() -> None:
    one, two = (loads(write_items(offloaded_config(number))) for number in (1, 12))
    assert not {item.path for item in one.interfaces} & {item.path for item in two.interfaces}
    assert {item.container for item in two.parameters} == {"cTag_12"}
