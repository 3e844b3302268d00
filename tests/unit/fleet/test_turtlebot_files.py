"""The files of a TurtleBot: launch file and parameters fit each other and the nodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from rce.ros.launch import LaunchPlan, MachineInputs, load_launch_files
from rce.ros.packages import PackageIndex
from rce_fleet.maps.ros_map import load_map
from rce_fleet.navigation.safety.parameters import SafetyParameters
from rce_fleet.nodes.amcl_parameters import AmclNodeParameters
from rce_fleet.nodes.move_base_parameters import read_settings
from rce_fleet.nodes.obstacle_cells import ObstacleCellsParameters
from rce_fleet.nodes.parameter_values import read_values

FOLDER = Path(__file__).parents[3] / "configs" / "turtlebot"


def plan(**arguments: str) -> LaunchPlan:
    found = load_launch_files([FOLDER / "botmotion.launch"], arguments, inputs=MachineInputs())
    assert found.warnings == []
    return found


def names(found: LaunchPlan) -> list[str]:
    return [node.name for node in found.nodes]


def parameters(found: LaunchPlan, node: str) -> dict[str, Any]:
    """The private parameters of a node as a tree."""
    tree: dict[str, Any] = {}
    for name, value in found.parameters.items():
        if name.startswith(f"{node}/"):
            inner = tree
            *spaces, last = name.removeprefix(f"{node}/").split("/")
            for space in spaces:
                inner = inner.setdefault(space, {})
            inner[last] = value
    return tree


def test_a_robot_of_its_own_master_has_no_namespace() -> None:
    found = plan(robot="Robot1")
    nodes = ["map_server", "velocity_limiter", "amcl", "move_base", "obstacle_cells"]
    # Masters that share /RobotN/amcl_pose must not know two nodes of one name.
    assert names(found) == [*(f"/{name}" for name in nodes), "/pose_relay_Robot1"]
    assert found.nodes[-1].arguments == ("/amcl_pose", "/Robot1/amcl_pose")
    assert found.parameters["/amcl/odom_frame_id"] == "odom"
    assert "/tf_prefix" not in found.parameters


def test_a_robot_begins_at_its_dock_or_where_it_was() -> None:
    given = {"initial_pose_x": "2.5", "initial_cov_xx": "0.01"}
    assert plan(**given).parameters["/amcl/initial_pose_x"] == 2.5
    assert plan(**given).parameters["/amcl/initial_cov_xx"] == 0.01
    stored = plan(**given, stored_pose="true").parameters
    assert not [name for name in stored if "/initial_" in name]


def test_recovery_of_a_lost_place_can_be_turned_off() -> None:
    assert plan().parameters["/amcl/recovery_alpha_fast"] > 0
    alone = plan(recovery="false").parameters
    assert (alone["/amcl/recovery_alpha_slow"], alone["/amcl/recovery_alpha_fast"]) == (0.0, 0.0)


def test_robots_at_one_master_have_namespaces() -> None:
    first, second = plan(tf_prefix="Robot1"), plan(tf_prefix="Robot2", map_server="false")
    nodes = ["velocity_limiter", "amcl", "move_base", "obstacle_cells"]
    assert names(first) == ["/map_server", *(f"/Robot1/{name}" for name in nodes)]
    assert not set(names(first)) & set(names(second))
    assert second.parameters["/Robot2/amcl/base_frame_id"] == "Robot2/base_link"
    assert second.parameters["/Robot2/move_base/local_costmap/global_frame"] == "Robot2/odom"
    assert dict(second.nodes[1].remappings)["static_map"] == "/static_map"


def test_an_offloaded_robot_publishes_a_map_of_its_own() -> None:
    found = names(plan(offload="true", own_map="true"))
    assert sorted(found) == ["/map_server", "/pose_keeper", "/velocity_limiter"]


def test_an_offloaded_robot_keeps_safety_and_its_pose() -> None:
    assert names(plan(offload="true")) == ["/velocity_limiter", "/pose_keeper"]


@pytest.mark.parametrize("tf_prefix", ["", "Robot1"])
def test_the_nodes_take_all_parameters(tf_prefix: str) -> None:
    found = plan(tf_prefix=tf_prefix)
    space = f"/{tf_prefix}".rstrip("/")
    settings, problems = read_settings(parameters(found, f"{space}/move_base"))
    assert problems == []
    assert settings.local_costmap.global_frame == (f"{tf_prefix}/odom" if tf_prefix else "odom")
    _, problems = read_values(AmclNodeParameters, parameters(found, f"{space}/amcl"))
    assert problems == []
    _, problems = read_values(ObstacleCellsParameters, parameters(found, f"{space}/obstacle_cells"))
    assert problems == []
    _, problems = read_values(SafetyParameters, parameters(found, f"{space}/velocity_limiter"))
    assert problems == []


def test_the_nodes_are_there() -> None:
    packages = PackageIndex([])
    for node in plan(robot="Robot1").nodes:
        assert packages.find(node.package).executable(node.type)


def test_the_default_map_is_there() -> None:
    server = plan().nodes[0]
    assert Path(server.arguments[0]).resolve() == FOLDER.parent / "map.yaml"
    assert load_map(server.arguments[0]).data.size
