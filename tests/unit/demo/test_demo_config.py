"""What is run, and what the planner is told."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rce.config.client import loads
from rce.config.documents import write_items
from rce_fleet.demo.config import DemoConfig
from rce_fleet.demo.resources import Ports
from rce_fleet.demo.robots import RobotGraph, client_config, cloud_arguments, dock_of, launch_argv
from rce_fleet.demo.ros_modes import (
    PLANNER,
    move_client_argv,
    node_names,
    planner_argv,
    sync_argv,
    world_argv,
)
from rce_fleet.demo.scenario import choose_scenario
from rce_fleet.demo.traffic import received
from rce_fleet.wiring import fleet_config

CONFIG = DemoConfig(choose_scenario(3, 0), 0, Ports(), Path("/folder"))


def test_the_planner_is_not_told_of_hidden_boxes() -> None:
    parameters, scenario = CONFIG.planner_parameters, CONFIG.scenario
    assert parameters["walls"] == sorted(scenario.grid.blocked)
    assert parameters["blocked"] == list(scenario.known_boxes)
    assert not {*parameters["walls"], *parameters["blocked"]}.intersection(scenario.hidden_boxes)
    loads(write_items(fleet_config(None, parameters)))


def test_the_planner_gets_its_parameters_on_its_command_line() -> None:
    argv = planner_argv(CONFIG)
    assert f"_walls:={sorted(CONFIG.scenario.grid.blocked)}" in argv
    assert "_rows:=8" in argv
    assert any(word.endswith("fleet_planner.py") for word in argv)


def test_each_robot_of_the_world_joins_its_own_core() -> None:
    argv = world_argv(CONFIG, "http://c:1/", {"Robot1": "http://a:1/", "Robot2": "http://b:1/"})
    joins = [argv[place + 1] for place, word in enumerate(argv) if word == "--core"]
    assert joins == ["Robot1=http://a:1/", "Robot2=http://b:1/"]
    assert argv[argv.index("--planner-core") + 1] == "http://c:1/"
    assert "--no-namespaces" not in argv
    assert "--no-namespaces" in world_argv(CONFIG, "http://c:1/", {}, namespaces=False)


def test_robot_starts_at_its_dock_and_later_where_it_was() -> None:
    """A launch gives the robot the pose of its start; one that follows lets it keep the stored pose."""
    argv = launch_argv(CONFIG, dock_of(CONFIG, "Robot2"), {"robot": "Robot2"})
    scenario = CONFIG.scenario
    x, y = scenario.grid.centre(scenario.starts[1])
    assert {f"initial_pose_x:={x}", f"initial_pose_y:={y}", "map:=/folder/map.yaml"} <= {*argv}
    assert f"initial_pose_a:={scenario.headings[1]}" in argv
    assert argv[-1] == "robot:=Robot2"


def test_offloaded_robot_brings_its_map_and_starts_at_its_dock() -> None:
    config = replace(CONFIG, offload=True)
    made = loads(write_items(dict(client_config(config, 2, dock_of(config, "Robot2")))))
    nodes = {item.node.exe for item in made.nodes}
    assert nodes == {"amcl", "move_base", "obstacle_cells.py", "move_client.py"}
    parameters = {item.parameter.name: item.parameter.value for item in made.parameters}
    assert parameters["/amcl/use_map_topic"] is True
    x, y = config.scenario.grid.centre(config.scenario.starts[1])
    assert (parameters["/amcl/initial_pose_x"], parameters["/amcl/initial_pose_y"]) == (x, y)
    ends = {item.path: item.interface.addr for item in made.interfaces}
    assert {"/map", "/diagnostics"} <= {*ends.values()}
    assert "own_map:=True" in launch_argv(
        config, dock_of(config, "Robot2"), cloud_arguments(config, "Robot2")
    )


def test_move_client_without_namespace_finds_the_robots_topics() -> None:
    argv = move_client_argv("Robot1", namespace=False, answers=True)
    assert {"__ns:=Robot1", "move_base/goal:=/move_base/goal", "blockedCells:=/blockedCells"} <= {*argv}
    assert "_answers:=true" in argv
    assert not any("move_base" in word for word in move_client_argv("Robot1"))


def test_only_the_demos_own_nodes_are_counted() -> None:
    shared = node_names([RobotGraph("Robot1", "http://a:1/", prefix="Robot1")])
    assert {"/Robot1/robot", "/Robot1/amcl", "/Robot1/move_client", "/map_server"} <= shared
    alone = node_names([RobotGraph("Robot1", "http://a:1/")])
    assert {"/robot", "/amcl", "/Robot1/move_client", "/fleet_planner"} <= alone


def test_received_counts_sum_topics_and_connections() -> None:
    """Received messages are summed over topics and connections."""
    pose = ["/Robot1/amcl_pose", [[1, 999, 7, -1, True], [2, 999, 5, -1, True]]]
    answer = [1, "bus stats", [[["/map", 10, [[9, 10, 1, True]]]], [pose, ["/map", []]], []]]
    assert received(answer) == 12


def test_robots_machine_syncs_only_its_own_topics() -> None:
    argv = sync_argv("Robot1", ["Robot1", "Robot2"])
    assert argv[argv.index("--hosts") + 1] == PLANNER
    topics = argv[argv.index("--topics") + 1].split(",")
    assert topics == ["/Robot1/goalNodesList", "/Robot1/cancelGoal", "/fleet/map", "/fleet/state"]


def test_planners_machine_syncs_two_topics_per_robot() -> None:
    argv = sync_argv(PLANNER, ["Robot1", "Robot2"])
    topics = argv[argv.index("--topics") + 1].split(",")
    assert topics == [f"/Robot{n}/{name}" for n in (1, 2) for name in ("amcl_pose", "goalNodesList")]
