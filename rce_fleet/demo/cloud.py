"""The mode ``cloud``: engine, operator station, world and one bridge for each robot."""

from __future__ import annotations

import sys

from rce.config.documents import write_items
from rce_fleet.demo.children import Children, Program
from rce_fleet.demo.config import DemoConfig
from rce_fleet.demo.counters import Counters, read_counters
from rce_fleet.demo.machine import RCE
from rce_fleet.demo.programs import START_TIMEOUT
from rce_fleet.wiring import fleet_config, robot_config


class Cloud:
    """Planner and move clients run in containers; robots are bridged by ``rce-ros``."""

    def __init__(self, config: DemoConfig) -> None:
        self._config = config

    async def start(self, children: Children) -> str:
        """Start everything; returns the URL of the page."""
        config = self._config
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
                [sys.executable, "-m", "rce_client.ros_bridge", str(config.folder / f"robot{number}.config")],
                env={"ROS_MASTER_URI": uris[robot]},
                revivable=True,
            )
            for number, robot in enumerate(config.scenario.robots, start=1)
        ]
        for bridge in bridges:
            await children.wait_line(bridge, "rce-ros ready:", START_TIMEOUT)
        await children.wait_line(world, "simulation ready:", START_TIMEOUT)
        return page

    async def count(self) -> Counters:
        """Ask the master."""
        account = self._config.account
        return await read_counters(account.url, account.user, account.password)

    def _write_files(self) -> None:
        config, account, folder = self._config, self._config.account, self._config.folder
        config.write_scene()
        fleet = fleet_config(account, config.planner_parameters)
        (folder / "fleet.config").write_text(write_items(fleet), encoding="utf-8")
        for number in range(1, len(config.scenario.robots) + 1):
            text = write_items(robot_config(number, account))
            (folder / f"robot{number}.config").write_text(text, encoding="utf-8")

    async def _graphs(self, children: Children, world: Program) -> dict[str, str]:
        """The ROS master of each robot, as the world says them."""
        return {
            robot: await children.wait_line(world, f"robot {robot} ROS_MASTER_URI=", START_TIMEOUT)
            for robot in self._config.scenario.robots
        }

    def _engine_argv(self) -> list[str]:
        config, ports = self._config, self._config.ports
        options = {
            "--state-dir": config.folder / "engine",
            "--http-port": ports.http,
            "--control-port": ports.control,
            "--ws-port": ports.ws,
            "--robot-link-port": ports.robot_link,
            "--container-link-port": ports.container_link,
            **({"--runtime": config.runtime} if config.runtime else {}),
        }
        return [*RCE, "up", "--dev", *(str(part) for item in options.items() for part in item)]

    def _station_argv(self) -> list[str]:
        config = str(self._config.folder / "fleet.config")
        return [sys.executable, "-m", "rce_fleet.station", config, "--port", str(self._config.ports.page)]

    def _world_argv(self) -> list[str]:
        config, account = self._config, self._config.account
        program = [sys.executable, "-m", "rce_fleet.drivers", str(config.scene)]
        return [*program, "--report", str(config.report), "--master", account.url, "--user", account.user]
