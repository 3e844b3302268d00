"""Requests of the fleet's API about robots."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Literal

from pydantic import BaseModel

from rce_fleet.api.fleet import FleetModeChange, FleetRobotModel, ProfileModel, RobotChange, RobotList
from rce_fleet.api.tasks import HoldRequest
from rce_fleet.client.requests import ApiRequests, parsed, path_part
from rce_fleet.station.api import Answer, GoalRequest


class _Reached(BaseModel):
    """What an emergency stop has reached."""

    missed: list[str]


class RobotRequests(ApiRequests):
    """Reads robots, pauses them, takes them out of service and sends them by hand."""

    async def robots(
        self, *, states: Iterable[str] = (), activities: Iterable[str] = ()
    ) -> list[FleetRobotModel]:
        """Return robots by name.

        Args:
            states: Only those in one of these states, such as ``driving``; empty: all.
            activities: Only those with one of these activities, such as ``charging``; empty: all.

        Example:
            ```python
            low = [robot.id for robot in await fleet.robots() if (robot.battery or 1) < 0.2]
            ```
        """
        robots: list[FleetRobotModel] = []
        wanted = {"state": ",".join(states), "activity": ",".join(activities)}
        query = {"limit": "500"} | {name: text for name, text in wanted.items() if text}
        while True:
            page = await self._read("/robots", RobotList, query)
            robots += page.robots
            if page.next is None:
                return robots
            query["cursor"] = page.next

    async def robot(self, name: str) -> FleetRobotModel:
        """Return a robot: its task and queue, battery, loads, profile and revision.

        Example:
            ```python
            print((await fleet.robot("Robot1")).battery)
            ```
        """
        return await self._read(f"/robots/{path_part(name)}/manager", FleetRobotModel)

    async def change_robot(
        self, robot: str, profile: ProfileModel | None, *, revision: int | None = None
    ) -> FleetRobotModel:
        """Set what a robot can do; None: the fleet's default.

        Example:
            ```python
            await fleet.change_robot("Robot1", ProfileModel(capabilities=["lift"], payload=20))
            ```
        """
        change = RobotChange(profile=profile)
        return await self._change("PATCH", f"/robots/{path_part(robot)}", FleetRobotModel, change, revision)

    async def pause_robot(self, robot: str, reason: str = "") -> FleetRobotModel:
        """Let a robot stand still; it keeps its task.

        Example:
            ```python
            await fleet.pause_robot("Robot1", "visitors")
            ```
        """
        return await self._robot(robot, "pause", reason)

    async def resume_robot(self, robot: str) -> FleetRobotModel:
        """End the pause of a robot.

        Example:
            ```python
            await fleet.resume_robot("Robot1")
            ```
        """
        return await self._robot(robot, "resume", None)

    async def take_out(self, robot: str, reason: str = "") -> FleetRobotModel:
        """Take a robot out of service; others get its tasks.

        Example:
            ```python
            await fleet.take_out("Robot1", "wheel broken")
            ```
        """
        return await self._robot(robot, "take-out", reason)

    async def put_in(self, robot: str) -> FleetRobotModel:
        """Put a robot into service again.

        Example:
            ```python
            await fleet.put_in("Robot1")
            ```
        """
        return await self._robot(robot, "put-in", None)

    async def send(self, robot: str, cell: int | None) -> None:
        """Send a robot to a cell by hand, without a task; None: stop and stay.

        Example:
            ```python
            await fleet.send("Robot1", 42)
            ```
        """
        body = GoalRequest(cell=cell).model_dump_json()
        await self._transport.request("PUT", f"/robots/{path_part(robot)}/goal", body=body)

    async def set_mode(self, mode: Literal["automatic", "paused"], reason: str = "") -> str:
        """Pause the whole fleet, or let it drive again; return the answer for people.

        Example:
            ```python
            await fleet.set_mode("paused", "fire drill")
            ```
        """
        return (await self._send("PUT", "/mode", Answer, FleetModeChange(mode=mode, reason=reason))).message

    async def emergency_stop(self, robot: str = "", *, stopped: bool = True) -> list[str]:
        """Stop a robot, or all of them, at once and without the planner; or release them.

        Args:
            robot: The robot; empty: all, also those that appear later.
            stopped: False: release them.

        Returns:
            Robots that were not reached; they get it when they come back.

        Example:
            ```python
            missed = await fleet.emergency_stop()
            ```
        """
        path = f"/robots/{path_part(robot)}/emergency-stop" if robot else "/emergency-stop"
        text = await self._transport.request("PUT", path, body=json.dumps({"stopped": stopped}))
        return parsed(_Reached, text).missed

    async def _robot(self, robot: str, action: str, reason: str | None) -> FleetRobotModel:
        body = None if reason is None else HoldRequest(reason=reason)
        return await self._send("POST", f"/robots/{path_part(robot)}/{action}", FleetRobotModel, body)
