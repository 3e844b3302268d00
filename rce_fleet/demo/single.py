"""The mode ``single``: one ROS core for everybody, no engine."""

from __future__ import annotations

import shutil

from rce_fleet.demo.bus import read_bus
from rce_fleet.demo.children import Children
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
from rce_fleet.demo.play import CoreKind, Play
from rce_fleet.demo.ports import LOOPBACK
from rce_fleet.demo.setting import START_TIMEOUT


class SingleMaster:
    """Planner, move clients and robots are nodes of one graph, the robots' in namespaces."""

    def __init__(self, play: Play) -> None:
        self._play = play
        self._uri = play.core_uri or f"http://{LOOPBACK}:{play.ports.core}/"

    async def start(self, children: Children) -> str:
        """Start everything; returns the URL of the page."""
        play, uri = self._play, self._uri
        play.write_scene()
        if not play.core_uri:
            await self._start_core(children)
        here = Machine("here", uri)
        robots = play.scenario.robots
        world = await here.start(children, "world", world_argv(play, uri, dict.fromkeys(robots, uri)))
        await here.start(children, "planner", planner_argv(play), revivable=True)
        station = await here.start(children, "station", station_argv(play, uri), revivable=True)
        for number, robot in enumerate(robots, start=1):
            await here.start(children, f"move_client{number}", move_client_argv(robot), revivable=True)
        page = await children.wait_line(station, "rce ui ready:", START_TIMEOUT)
        await children.wait_line(world, "simulation ready:", START_TIMEOUT)
        return page

    async def count(self) -> Counters:
        """Ask all nodes."""
        return await read_bus([self._uri], node_names(self._play))

    async def _start_core(self, children: Children) -> None:
        play, port = self._play, str(self._play.ports.core)
        home = play.folder / "ros"
        env = {"ROS_HOME": str(home), "ROS_LOG_DIR": str(home / "log"), "ROS_IP": LOOPBACK}
        if play.core is CoreKind.RCE:
            core = await children.start("core", [*RCE, "core", "--port", port], env=env, needed=True)
            await children.wait_line(core, "rce core ready:", START_TIMEOUT)
            return
        program = shutil.which("roscore")
        if program is None:
            raise DemoError("there is no program roscore here (Debian: ros-core)")
        core = await children.start("core", [program, "-p", port], env=env, needed=True)
        await children.wait_line(core, "started core service [/rosout]", START_TIMEOUT)
