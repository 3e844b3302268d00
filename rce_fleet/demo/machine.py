"""A machine of a ROS graph, and what the fleet's programs are called there."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from rce.ros.packages import PackageIndex
from rce_fleet.demo.children import Children, Program
from rce_fleet.demo.config import DemoConfig

RCE = (sys.executable, "-c", "from rce.cli import main; main()")
"""The program ``rce`` of this installation."""


@dataclass(frozen=True, slots=True)
class Machine:
    """Where programs run.

    Attributes:
        name: For people, and for the logs' names.
        core_uri: The ROS master that its nodes join.
        enter: Command before each program's own, which lets it run there.
    """

    name: str
    core_uri: str
    enter: tuple[str, ...] = ()

    async def start(
        self,
        children: Children,
        name: str,
        argv: Iterable[str],
        *,
        needed: bool = False,
        revivable: bool = False,
    ) -> Program:
        """Start a program here, as a node of this machine's graph."""
        return await children.start(
            name, [*self.enter, *argv], env=self._environment(), needed=needed, revivable=revivable
        )

    def _environment(self) -> Mapping[str, str]:
        return {"ROS_MASTER_URI": self.core_uri, "ROS_NAMESPACE": ""}


def planner_argv(config: DemoConfig, **more: Any) -> list[str]:
    """The planner, told of the floor by private parameters, and of ``more``."""
    return [*_executable("fleet_planner.py"), *_parameters({**config.planner_parameters, **more})]


def move_client_argv(robot: str, **parameters: Any) -> list[str]:
    """The move client of a robot, with private parameters."""
    return [*_executable("move_client.py"), f"__ns:={robot}", *_parameters(parameters)]


def station_argv(config: DemoConfig, planner_core: str) -> list[str]:
    """The operator station, in the planner's graph."""
    station = [sys.executable, "-m", "rce_fleet.station"]
    return [*station, "--ros-master", planner_core, "--port", str(config.ports.page)]


def world_argv(config: DemoConfig, planner_core: str, cores: Mapping[str, str]) -> list[str]:
    """The world, whose robots join the graphs of ``cores`` (robot to URI)."""
    program = [sys.executable, "-m", "rce_fleet.drivers", str(config.scene), "--report", str(config.report)]
    joins = [part for robot, uri in cores.items() for part in ("--core", f"{robot}={uri}")]
    return [*program, "--planner-core", planner_core, *joins]


def node_names(config: DemoConfig) -> frozenset[str]:
    """Global names of all nodes of the demo; a graph may have others."""
    robots = [f"/{robot}/{node}" for robot in config.scenario.robots for node in ("robot", "move_client")]
    return frozenset((*robots, "/fleet_planner", "/operator_station", "/world"))


def _parameters(values: Mapping[str, Any]) -> Iterable[str]:
    return (f"_{name}:={json.dumps(value)}" for name, value in values.items())


def _executable(exe: str) -> list[str]:
    return PackageIndex.from_environ().find("fleet").executable(exe)
