"""The paper's Multi Master System: a ROS core on each machine, ``master_discovery`` and ``master_sync``.

Discovery and sync are ours with any software: Debian has no package of fkie's. An adapter for fkie's own
programs has other values of ``discovery`` and ``sync``.
"""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING, ClassVar

from rce_fleet.experiments.bench import SERVER
from rce_fleet.experiments.systems.base import RunningWorkload, System, Workload, core_uri, together

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from rce_fleet.experiments.bench import Bench, Program
    from rce_fleet.experiments.systems.base import Flow, Layout
    from rce_fleet.experiments.systems.software import Software

GROUP = "224.0.0.1"
"""The paper's multicast group."""


def fkie_node(name: str) -> tuple[str, ...]:
    """Return the command line of our program for a node of fkie's: what ``rce run`` becomes for it."""
    program = f"import sys; from rce.ros.cli.fkie_nodes import {name}; sys.exit({name}())"
    return (sys.executable, "-c", program)


class MultiMaster(System):
    """A core on each machine; only the flows are shared."""

    name = "multi_master"
    title = "MMS"
    has_master = True
    discovery: ClassVar[tuple[str, ...]] = fkie_node("master_discovery")
    """Command line of the discovery, to which its parameters are added."""
    sync: ClassVar[tuple[str, ...]] = fkie_node("master_sync")
    """The same of the sync."""

    def __init__(self, bench: Bench, software: Software, layout: Layout) -> None:
        super().__init__(bench, software, layout)
        self._shared: list[Flow] = []
        """What machine 1 shares."""
        self._masters: list[Program] = []
        """Its discovery and sync."""

    async def connect(self, flows: Sequence[Flow]) -> None:
        """Start cores, discovery and sync on all machines; a robot's one shares what is its own."""
        machine_of = self.layout.machine_of
        shared = {
            machine: [flow for flow in flows if machine in (SERVER, machine_of(flow.robot))]
            for machine in (SERVER, *self.layout.clients)
        }
        self._shared = shared[SERVER]
        await together(*(self._machine(machine, own) for machine, own in shared.items()))

    async def kill_master(self) -> None:
        """Kill discovery and sync of machine 1."""
        for program in self._masters:
            await self.bench.kill(program)

    async def restart_master(self) -> None:
        """Start them again, as a supervisor would."""
        await self._share(SERVER, self._shared)

    async def _machine(self, machine: str, flows: Sequence[Flow]) -> None:
        await self.start_core(machine)
        await self._share(machine, flows)

    async def _share(self, machine: str, flows: Sequence[Flow]) -> None:
        environ = {"ROS_MASTER_URI": core_uri(self.bench.address(machine))}
        shared = [f"_sync_topics:={_names(flow for flow in flows if not flow.is_service)}"]
        if any(flow.is_service for flow in flows):
            shared.append(f"_sync_services:={_names(flow for flow in flows if flow.is_service)}")
        for name, words in (
            ("discovery", (*self.discovery, f"_mcast_group:={GROUP}")),
            ("sync", (*self.sync, *shared)),
        ):
            program = await self.bench.start(machine, f"{name}-{machine}", words, environ=environ)
            if machine == SERVER:
                self._masters.append(program)

    async def run(self, workload: Workload) -> RunningWorkload:
        """Run a program as a node of its machine's core."""
        return await self.run_in_graph(workload, workload.machine)

    @classmethod
    def wiring(cls, robot: int) -> dict[str, str]:
        """Return the launch file of a robot's machine: discovery, and what is shared."""
        return {
            f"robot{robot}.launch": f"""<launch>
  <include file="$(find turtlebot_bringup)/launch/minimal.launch"/>
  <node pkg="topic_tools" type="relay" name="scan" args="/scan /Robot{robot}/scan"/>
  <node pkg="fkie_master_discovery" type="master_discovery" name="master_discovery">
    <param name="mcast_group" value="{GROUP}"/>
  </node>
  <node pkg="fkie_master_sync" type="master_sync" name="master_sync">
    <rosparam param="sync_topics">[/Robot{robot}/scan]</rosparam>
  </node>
</launch>
"""
        }


def _names(flows: Iterable[Flow]) -> str:
    return json.dumps([flow.topic for flow in flows])
