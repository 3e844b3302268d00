"""The paper's Single Master System: one ROS core, which both machines use."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_fleet.experiments.bench import SERVER
from rce_fleet.experiments.systems.base import RunningWorkload, System, Workload

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce_fleet.experiments.systems.base import Flow


class SingleMaster(System):
    """One core on the server; all programs of both machines are its nodes."""

    name = "single_master"
    title = "SMS"
    has_one_core = True

    async def connect(self, flows: Sequence[Flow]) -> None:
        """Start the core; nodes find each other without being told which topics there are."""
        del flows
        await self.start_core(SERVER)

    async def run(self, workload: Workload) -> RunningWorkload:
        """Run a program as a node."""
        return await self.run_in_graph(workload, SERVER)

    @classmethod
    def wiring(cls, robot: int) -> dict[str, str]:
        """Return the launch file of a robot's machine: all of its names need a namespace."""
        return {
            f"robot{robot}.launch": f"""<launch>
  <group ns="Robot{robot}">
    <param name="tf_prefix" value="Robot{robot}"/>
    <include file="$(find turtlebot_bringup)/launch/minimal.launch"/>
  </group>
</launch>
"""
        }
