"""Builds what the fleet manager knows of the robots from the planner's messages. Pure."""

from __future__ import annotations

import re
from math import inf, isfinite, nan
from typing import Any

from rce_fleet.coordination.following import ChangeFollower
from rce_fleet.coordination.waiting import resting_cell
from rce_fleet.manager.cell_blocks import read_block
from rce_fleet.manager.zones import read_zone
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.lanes import Lane, LaneGraph
from rce_fleet.tasks.facts import NOT_DRIVEN, FleetFacts, RobotFacts
from rce_fleet.tasks.records import TURNED_BY, PlannerRun

_DETAILS = re.compile(r"[^(]*\((.*)\)")
"""A mode as a reason, with what a person gave as reason: ``paused (visitors, by anna)``."""

SLACK = 0.05
"""So far beyond 0 .. 1 a share may be: of a battery that was just charged, or is empty."""
FULL = 4
"""``POWER_SUPPLY_STATUS_FULL`` of ``sensor_msgs/BatteryState``."""


class FactKeeper:
    """Keeps the facts up to date. Messages are in their JSON form.

    Args:
        facts: Updated in place.

    Attributes:
        started: When the planner began, as its messages have it; None: not heard yet.
    """

    def __init__(self, facts: FleetFacts) -> None:
        self._facts = facts
        self._follower = ChangeFollower()
        self._blocked: set[int] = set()
        self._pending: set[int] = set()
        self._batteries: dict[str, float | None] = {}
        self._turned: tuple[Any, float] = (None, 0.0)
        """When a planner took its grid, and the direction of the grid's columns."""
        self.started: Any = None

    @property
    def is_behind(self) -> bool:
        """Whether the complete state is needed."""
        return self._follower.is_behind

    def take_rotation(self, made: dict[str, int], yaw: float) -> None:
        """Take over how a planner's grid is turned, which its state does not say.

        Args:
            made: When the planner took the grid: the ``map_load_time`` of ``/fleet/map``, which is the
                ``started`` of its state.
            yaw: Direction of the columns, radians.
        """
        self._turned = made, yaw

    def knows_rotation(self, answer: dict[str, Any]) -> bool:
        """Return whether it is known how the grid of a ``fleet/GetState`` response is turned."""
        return bool(self._turned[0] == answer["state"]["started"])

    def take_state(self, answer: dict[str, Any], now: float) -> bool:
        """Take over a ``fleet/GetState`` response; return whether it is of another planner than before.

        Args:
            answer: The response.
            now: Seconds since 1970.
        """
        kept = self._follower.take_snapshot(answer)
        state = answer["state"]
        is_other = bool(self.started != state["started"])
        self.started = state["started"]
        self._blocked, self._pending = set(state["blocked"]), set(state["pending"])
        grid = GridMap(
            rows=state["rows"],
            columns=state["columns"],
            cell_size=state["cell_size"],
            origin=(state["origin_x"], state["origin_y"]),
            blocked=frozenset(state["walls"]),
            yaw=self._turned[1] if self.knows_rotation(answer) else 0.0,
        )
        if self._facts.grid is None or grid != self._facts.grid:
            self._facts.grid = grid
        lanes = tuple(read_lane(lane) for lane in state.get("lanes", ()))
        self._facts.lanes = LaneGraph(lanes) if lanes else None
        present = {robot["id"] for robot in state["robots"]}
        for name in self._facts.robots.keys() - present:
            self._facts.robots[name].state = "joining"
            self._facts.robots[name].reason = "the planner does not know it"
            self._facts.robots[name].is_known = False
            self._facts.robots[name].goal = None  # a planner that was restarted has none yet
            self._note_away(self._facts.robots[name], now)
        for robot in state["robots"]:
            self._take_robot(robot, now)
        self._facts.zones = {zone["id"]: read_zone(zone, now) for zone in state["zones"]}
        told = state.get("blocks", ())  # planners of earlier releases tell none
        self._facts.blocks = {block["cell"]: read_block(block, now) for block in told}
        self._facts.mode = state["mode"]
        self._note_map()
        self._facts.is_live = True
        for message in kept:
            self._apply(message, now)
        self._facts.is_current = not self._follower.is_behind
        return is_other

    @property
    def run(self) -> PlannerRun:
        """The planner whose state was taken over."""
        grid, started = self._facts.grid, self.started
        if grid is None or started is None:
            return PlannerRun()
        size = f"{grid.rows} x {grid.columns} cells of {grid.cell_size:g} m"
        floor = f"{size} at {grid.origin}{TURNED_BY}{grid.yaw:g} rad"
        return PlannerRun(f"{started['secs']}.{started['nsecs']:09d}", floor)

    def take_changes(self, message: dict[str, Any], now: float) -> None:
        """Take over a ``fleet/FleetChanges``."""
        if message["started"] == self.started:
            self._facts.mode = message["mode"]
        if self._follower.take_changes(message):
            self._apply(message, now)
        self._facts.is_current = not self._follower.is_behind

    def take_battery(self, robot: str, percentage: float, charge: float, capacity: float, status: int) -> str:
        """Take over a ``sensor_msgs/BatteryState``; return what is wrong with it, or an empty text.

        A percentage that is not a share does not count; charge and capacity may tell the level.

        Args:
            robot: Whose battery.
            percentage: Share, 0 .. 1; not a number if it is not measured.
            charge: Ampere hours that are left.
            capacity: Ampere hours of the full battery.
            status: ``power_supply_status``; 4: it is full, also if it is worn and holds less than new.
        """
        is_share = -SLACK <= percentage <= 1.0 + SLACK
        share = percentage if is_share else charge / capacity if capacity > 0 else nan
        level = min(1.0, max(0.0, share)) if isfinite(share) else None
        self._batteries[robot] = level = 1.0 if status == FULL else level
        known = self._facts.robots.get(robot)
        if known is not None:
            known.battery = level
        if is_share or not isfinite(percentage):
            return ""
        instead = "charge and capacity count" if level is not None else "the level counts as not known"
        return f"percentage is {percentage:g}, not a share of 0 .. 1: {instead}"

    # Inner

    def _apply(self, message: dict[str, Any], now: float) -> None:
        for name in message["removed"]:
            self._facts.robots.pop(name, None)
        for robot in message["robots"]:
            self._take_robot(robot, now)
        for zone in message["removed_zones"]:
            self._facts.zones.pop(zone, None)
        for zone in message["zones"]:
            self._facts.zones[zone["id"]] = read_zone(zone, now)
        for cell in message.get("removed_blocks", ()):
            self._facts.blocks.pop(cell, None)
        for block in message.get("blocks", ()):
            self._facts.blocks[block["cell"]] = read_block(block, now)
        if message["blocked"] or message["pending"] or message["freed"]:
            freed = set(message["freed"])
            blocked, pending = set(message["blocked"]), set(message["pending"])
            self._blocked = (self._blocked - freed - pending) | blocked
            self._pending = (self._pending - freed - blocked) | pending
            self._note_map()

    def _note_map(self) -> None:
        walls = self._facts.grid.blocked if self._facts.grid is not None else frozenset()
        self._facts.pending = frozenset(self._pending)
        shut = frozenset(walls | self._blocked | self._pending)
        if shut != self._facts.shut:
            self._facts.shut = shut
            self._facts.map_revision += 1

    def _take_robot(self, robot: dict[str, Any], now: float) -> None:
        name = robot["id"]
        known = self._facts.robots.get(name)
        if known is None:
            known = RobotFacts(name, battery=self._batteries.get(name), moved_at=now)
            self._facts.robots[name] = known
        cell = robot["cell"] if robot["cell"] >= 0 else None
        goal = robot["goal"] if robot["goal"] >= 0 else None
        could_not_move = known.state in NOT_DRIVEN and robot["state"] not in NOT_DRIVEN
        if (cell, goal) != (known.cell, known.goal) or could_not_move:
            known.moved_at = now
        known.cell, known.goal = cell, goal
        known.state, known.reason = robot["state"], robot["reason"]
        known.barred_by = resting_cell(known.reason)
        details = _DETAILS.fullmatch(known.reason)
        if robot["mode"] != known.mode:
            known.mode_reason = ""
        if details is not None and robot["mode"] in NOT_DRIVEN:
            known.mode_reason = details[1]
        known.mode, known.is_known = robot["mode"], True
        self._note_away(known, now)

    def _note_away(self, robot: RobotFacts, now: float) -> None:
        if robot.is_there:
            robot.away_since = inf
        elif robot.away_since == inf:
            robot.away_since = now


def read_lane(message: dict[str, Any]) -> Lane:
    """Return the lane of a ``fleet/Lane``."""
    return Lane(**{**message, "cells": tuple(message["cells"])})
