"""The mode ``cloud``: engine, operator station, world and one bridge for each robot."""

from __future__ import annotations

import sys

from rce.config.documents import write_items
from rce_fleet.demo.children import Children, Program
from rce_fleet.demo.counters import Counters, read_counters
from rce_fleet.demo.machine import RCE
from rce_fleet.demo.play import Play
from rce_fleet.demo.setting import START_TIMEOUT
from rce_fleet.wiring import fleet_config, robot_config


class Cloud:
    """Planner and move clients run in containers; robots are bridged by ``rce-ros``."""

    def __init__(self, play: Play) -> None:
        self._play = play

    async def start(self, children: Children) -> str:
        """Start everything; returns the URL of the page."""
        play = self._play
        self._write_files()
        engine = await children.start("engine", self._engine_argv(), needed=True)
        world = await children.start("world", self._world_argv())
        await children.wait_line(engine, "RCE ready:", START_TIMEOUT)
        station = await children.start("station", self._station_argv(), revivable=True)
        uris = await self._graphs(children, world)
        page = await children.wait_line(station, "rce ui ready:", START_TIMEOUT)
        bridges = [
            await children.start(
                f"robot{number}",
                [sys.executable, "-m", "rce_client.ros_bridge", str(play.folder / f"robot{number}.config")],
                env={"ROS_MASTER_URI": uris[robot]},
                revivable=True,
            )
            for number, robot in enumerate(play.scenario.robots, start=1)
        ]
        for bridge in bridges:
            await children.wait_line(bridge, "rce-ros ready:", START_TIMEOUT)
        await children.wait_line(world, "simulation ready:", START_TIMEOUT)
        return page

    async def count(self) -> Counters:
        """Ask the master."""
        account = self._play.account
        return await read_counters(account.url, account.user, account.password)

    def _write_files(self) -> None:
        play, account, folder = self._play, self._play.account, self._play.folder
        play.write_scene()
        fleet = fleet_config(account, play.planner_parameters)
        (folder / "fleet.config").write_text(write_items(fleet), encoding="utf-8")
        for number in range(1, len(play.scenario.robots) + 1):
            text = write_items(robot_config(number, account))
            (folder / f"robot{number}.config").write_text(text, encoding="utf-8")

    async def _graphs(self, children: Children, world: Program) -> dict[str, str]:
        """The ROS master of each robot, as the world says them."""
        return {
            robot: await children.wait_line(world, f"robot {robot} ROS_MASTER_URI=", START_TIMEOUT)
            for robot in self._play.scenario.robots
        }

    def _engine_argv(self) -> list[str]:
        play, ports = self._play, self._play.ports
        options = {
            "--state-dir": play.folder / "engine",
            "--http-port": ports.http,
            "--control-port": ports.control,
            "--ws-port": ports.ws,
            "--robot-link-port": ports.robot_link,
            "--container-link-port": ports.container_link,
            **({"--runtime": play.runtime} if play.runtime else {}),
        }
        return [*RCE, "up", "--dev", *(str(part) for item in options.items() for part in item)]

    def _station_argv(self) -> list[str]:
        config = str(self._play.folder / "fleet.config")
        return [sys.executable, "-m", "rce_fleet.station", config, "--port", str(self._play.ports.page)]

    def _world_argv(self) -> list[str]:
        play, account = self._play, self._play.account
        program = [sys.executable, "-m", "rce_fleet.drivers", str(play.scene)]
        return [*program, "--report", str(play.report), "--master", account.url, "--user", account.user]
