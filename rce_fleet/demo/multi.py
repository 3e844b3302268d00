"""The mode ``multi``: a ROS core for each robot and one for the planner, which share a few topics."""

from __future__ import annotations

import sys
from collections.abc import Iterable

from rce.ros.multimaster.addresses import DEFAULT_GROUP
from rce_fleet.demo.bus import read_bus
from rce_fleet.demo.children import Children, Program
from rce_fleet.demo.config import DemoConfig
from rce_fleet.demo.counters import Counters
from rce_fleet.demo.machine import (
    RCE,
    Machine,
    move_client_argv,
    node_names,
    planner_argv,
    station_argv,
    world_argv,
)
from rce_fleet.demo.network import Network, Site, make_network
from rce_fleet.demo.programs import START_TIMEOUT

PLANNER = "planner"
"""Name of the planner's machine."""
FROM_ROBOT = ("amcl_pose", "goalNodesList")
"""What the planner's machine takes of each robot's, in the robot's namespace; lists are answered there."""
TO_ROBOT = ("goalNodesList", "cancelGoal")
"""What a robot's machine takes of the planner's, in the robot's namespace."""


class MultiMaster:
    """Each robot's machine has its core, map and move client; discovery and sync run on every machine.

    The world has none: what it simulates is each robot's hardware, a node that joins the robot's core.
    """

    def __init__(self, config: DemoConfig) -> None:
        self._config = config
        self._cores: list[str] = []

    async def start(self, children: Children) -> str:
        """Start everything; returns the URL of the page."""
        config, robots = self._config, self._config.scenario.robots
        config.write_scene()
        network = await make_network(config.machines, [PLANNER, *robots], children)
        self._cores = [site.core_uri for site in network.sites]
        await _start_cores(network, children)
        planner, *others = network.sites
        uris = {site.name: site.core_uri for site in others}
        outside = Machine("outside", planner.core_uri)
        floor = Machine("floor", planner.core_uri, enter=network.enter_world)
        world = await floor.start(children, "world", world_argv(config, planner.core_uri, uris))
        station = await outside.start(
            children, "station", station_argv(config, planner.core_uri), revivable=True
        )
        argv = planner_argv(config, answers=True)
        await _machine_of(planner).start(children, "planner", argv, revivable=True)
        for number, site in enumerate(others, start=1):
            argv = move_client_argv(site.name, answers=True, **config.map_parameters)
            await _machine_of(site).start(children, f"move_client{number}", argv, revivable=True)
        await _join_machines(network, robots, children)
        page = await children.wait_line(station, "rce ui ready:", START_TIMEOUT)
        await children.wait_line(world, "simulation ready:", START_TIMEOUT)
        return page

    async def count(self) -> Counters:
        """Ask all nodes."""
        return await read_bus(self._cores, node_names(self._config))


def sync_argv(machine: str, robots: Iterable[str]) -> list[str]:
    """The sync of a machine: what it takes, and of whom."""
    if machine == PLANNER:
        # The robots' hardware is a node of another machine, the world.
        topics = [f"/{robot}/{name}" for robot in robots for name in FROM_ROBOT]
        return [*_command("sync"), "--topics", ",".join(topics), "--sync-remote-nodes"]
    topics = [f"/{machine}/{name}" for name in TO_ROBOT]
    return [*_command("sync"), "--topics", ",".join(topics), "--hosts", PLANNER]


def discovery_argv(site: Site, network: Network) -> list[str]:
    """The discovery of a machine."""
    options = {
        "--name": site.name,
        "--mcast-group": f"{DEFAULT_GROUP}@{site.address}",
        "--mcast-port": network.multicast_port,
        "--rpc-addr": site.address,
        "--rpc-port": site.rpc_port,
    }
    return [*_command("discovery"), *(str(part) for item in options.items() for part in item)]


def _command(name: str) -> list[str]:
    """A command of ``rce``, without the others."""
    return [sys.executable, "-c", f"import typer; from rce.cli.{name} import {name}; typer.run({name})"]


def _machine_of(site: Site) -> Machine:
    return Machine(site.name, site.core_uri, site.enter)


async def _start_cores(network: Network, children: Children) -> None:
    cores: list[Program] = []
    for site in network.sites:
        argv = [*RCE, "core", "--port", str(site.core_port), "--bind", site.address, "--no-log"]
        cores.append(await _machine_of(site).start(children, f"core-{site.name}", argv, needed=True))
    for core in cores:
        await children.wait_line(core, "rce core ready:", START_TIMEOUT)


async def _join_machines(network: Network, robots: Iterable[str], children: Children) -> None:
    """Let machines find each other, and take of each other what they need."""
    discoveries = [
        await _machine_of(site).start(
            children, f"discovery-{site.name}", discovery_argv(site, network), revivable=True
        )
        for site in network.sites
    ]
    for site, discovery in zip(network.sites, discoveries, strict=True):
        await children.wait_line(discovery, "rce discovery ready:", START_TIMEOUT)
        await _machine_of(site).start(
            children, f"sync-{site.name}", sync_argv(site.name, robots), revivable=True
        )
