"""Adapters of the systems: the configs of robots are right, and what is not there is named."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any, cast

import pytest

from rce.ros.types import TypeRegistry
from rce_client.ros_bridge.robot_file import RobotFile
from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.bench import CLIENT, SERVER, Bench
from rce_fleet.experiments.experiment import PAPER_SYSTEMS
from rce_fleet.experiments.systems.base import Flow, Layout
from rce_fleet.experiments.systems.cloud import Cloud
from rce_fleet.experiments.systems.registry import system_of
from rce_fleet.experiments.systems.software import RCE, software_of

FLOWS = [Flow("/Robot1/scan", "sensor_msgs/LaserScan"), Flow("/back", "std_msgs/String", to=CLIENT)]


def cloud(layout: Layout) -> Cloud:
    bench = cast("Bench", SimpleNamespace(address={SERVER: "10.89.0.1", CLIENT: "10.89.0.2"}.__getitem__))
    return Cloud(bench, RCE, layout)


@pytest.mark.parametrize("layout", [Layout(), Layout(containers="each"), Layout(server_graph=True)])
def test_a_robots_config_is_a_legal_file(layout: Layout) -> None:
    file = RobotFile("robot2.config", json.dumps(cloud(layout).config(2, FLOWS)), TypeRegistry())
    assert file.draft.robot == "robot2"
    assert not file.draft.untyped


def test_containers_are_shared_or_not() -> None:
    def containers(layout: Layout, robot: int) -> Any:
        return cloud(layout).config(robot, FLOWS)["containers"]

    assert containers(Layout(robots=2), 1) == [{"cTag": "box"}]
    assert containers(Layout(robots=2), 2) == []
    assert containers(Layout(robots=2, containers="each"), 2) == [{"cTag": "box2"}]


def test_the_papers_systems_are_there() -> None:
    assert [system_of(name).title for name in PAPER_SYSTEMS] == ["SMS", "MMS", "CRS"]
    for name in PAPER_SYSTEMS:
        files = system_of(name).wiring(7)
        assert files
        assert all("7" in file for file in files)


def test_what_is_not_there_is_named() -> None:
    with pytest.raises(ExperimentError, match="there is no system peer; there is cloud"):
        system_of("peer")
    with pytest.raises(ExperimentError, match="there is no software ros2; there is ros, roscpp, rce"):
        software_of("ros2")
