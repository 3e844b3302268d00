"""The mode ``single``: one ROS core for everybody, no engine."""

from __future__ import annotations

import shutil

from rce_fleet.demo.bus import read_bus
from rce_fleet.demo.children import Children
from rce_fleet.demo.config import CoreKind, DemoConfig
from rce_fleet.demo.counters import Counters
from rce_fleet.demo.exceptions import DemoError
from rce_fleet.demo.machine import (
    RCE,
    Machine,
    move_client_argv,
    node_names,
    planner_argv,
    station_argv,
    world_argv,
)
from rce_fleet.demo.ports import LOOPBACK
from rce_fleet.demo.programs import START_TIMEOUT


class SingleMaster:
    """Planner, move clients and robots are nodes of one graph, the robots' in namespaces."""

    def __init__(self, config: DemoConfig) -> None:
        self._config = config
        self._uri = config.core_uri or f"http://{LOOPBACK}:{config.ports.core}/"

    async def start(self, children: Children) -> str:
        """Start everything; returns the URL of the page."""
        config, uri = self._config, self._uri
        config.write_scene()
        if not config.core_uri:
            await self._start_core(children)
        here = Machine("here", uri)
        robots = config.scenario.robots
        world = await here.start(children, "world", world_argv(config, uri, dict.fromkeys(robots, uri)))
        await here.start(children, "planner", planner_argv(config), revivable=True)
        station = await here.start(children, "station", station_argv(config, uri), revivable=True)
        for number, robot in enumerate(robots, start=1):
            await here.start(children, f"move_client{number}", move_client_argv(robot), revivable=True)
        page = await children.wait_line(station, "rce ui ready:", START_TIMEOUT)
        await children.wait_line(world, "simulation ready:", START_TIMEOUT)
        return page

    async def count(self) -> Counters:
        """Ask all nodes."""
        return await read_bus([self._uri], node_names(self._config))

    async def _start_core(self, children: Children) -> None:
        config, port = self._config, str(self._config.ports.core)
        home = config.folder / "ros"
        env = {"ROS_HOME": str(home), "ROS_LOG_DIR": str(home / "log"), "ROS_IP": LOOPBACK}
        if config.core is CoreKind.RCE:
            core = await children.start("core", [*RCE, "core", "--port", port], env=env, needed=True)
            await children.wait_line(core, "rce core ready:", START_TIMEOUT)
            return
        program = shutil.which("roscore")
        if program is None:
            raise DemoError("there is no program roscore here (Debian: ros-core)")
        core = await children.start("core", [program, "-p", port], env=env, needed=True)
        await children.wait_line(core, "started core service [/rosout]", START_TIMEOUT)
