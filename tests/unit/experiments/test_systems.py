"""Adapters of the systems: the configs of robots are right, and what is not there is named."""

from __future__ import annotations

import json
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, cast

import pytest

from rce.ros.types import TypeRegistry
from rce_client.ros_bridge.robot_file import RobotFile
from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.bench import CLIENT, SERVER, Bench
from rce_fleet.experiments.experiment import PAPER_SYSTEMS
from rce_fleet.experiments.isolation import to_add
from rce_fleet.experiments.systems.base import Flow, Layout, RunningWorkload, System, Workload
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


class RobotMaster(System):
    """One core, on the robots' machine; as docs/how-to/add-a-system.md has it."""

    name = "robot_master"
    title = "RMS"

    async def connect(self, flows: Sequence[Flow]) -> None:
        del flows
        await self.start_core(CLIENT)

    async def run(self, workload: Workload) -> RunningWorkload:
        return await self.run_in_graph(workload, CLIENT)


class Machines:
    """A bench on which programs start at once; notes which were killed."""

    def __init__(self) -> None:
        self.killed: list[object] = []

    def address(self, machine: str) -> str:
        return f"{machine}.local"

    async def start(self, machine: str, *_: object, **__: object) -> str:
        return f"core of {machine}"

    async def kill(self, program: object) -> None:
        self.killed.append(program)


async def test_a_core_is_killed_where_one_was_started(monkeypatch: pytest.MonkeyPatch) -> None:
    machines = Machines()
    system = RobotMaster(cast("Bench", machines), RCE, Layout())
    await system.connect([])
    with pytest.raises(
        ExperimentError, match=r"RMS: no core was started on server; .*core_machine \(client\)"
    ):
        await system.kill_core()
    monkeypatch.setattr(RobotMaster, "core_machine", CLIENT)
    await system.kill_core()
    assert machines.killed == ["core of client"]


def test_what_a_robot_needs_may_be_unknown() -> None:
    """Isolation leaves its counts out then, after all else was measured."""
    assert to_add(RobotMaster.wiring(2)) == []


def test_what_is_not_there_is_named() -> None:
    with pytest.raises(ExperimentError, match="there is no system peer; there is cloud"):
        system_of("peer")
    with pytest.raises(ExperimentError, match="there is no software ros2; there is ros, roscpp, rce"):
        software_of("ros2")
