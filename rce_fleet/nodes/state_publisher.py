"""Publishes the fleet's state: changes at once, the complete state on request and at a low rate.

``/fleet/changes`` has numbered changes; ``/fleet/get_state`` answers with the complete state and the number
of the last change in it. ``/fleet/state`` has the complete state, latched, for programs that read only one
topic. Its rate falls with the size of the fleet: up to 20 robots after each change, 800 robots every 4 s.
"""

from __future__ import annotations

import time
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from rce.ros.types import Message, Time
from rce_fleet.nodes.block_messages import block_fields
from rce_fleet.nodes.zone_messages import zone_fields

if TYPE_CHECKING:
    from rce.ros.node import Node, Publisher, Service
    from rce_fleet.coordination.changes import FleetChanges
    from rce_fleet.coordination.planner import FleetPlanner
    from rce_fleet.coordination.snapshot import RobotSnapshot
    from rce_fleet.planning.grid import GridMap
    from rce_fleet.planning.lanes import LaneGraph

STATE = "fleet/FleetState"
STATE_TOPIC = "/fleet/state"
CHANGES = "fleet/FleetChanges"
CHANGES_TOPIC = "/fleet/changes"
GET_STATE = "fleet/GetState"
GET_STATE_SERVICE = "/fleet/get_state"
WHOLE_ROBOTS_PER_S = 200.0
"""Maximum number of robots per second in complete states."""
REPEAT_S = 1.0
"""Seconds without a change after which the number of the last one is published again."""


class StatePublisher:
    """Publishes the fleet's state.

    Args:
        node: Running node.
        planner: The planner, with the state.

    Attributes:
        service: Returns the complete state, once :meth:`start` has been called.
    """

    service: Service

    def __init__(self, node: Node, planner: FleetPlanner) -> None:
        self._node = node
        self._planner = planner
        self._started = Time.now()
        self._whole_at = 0.0
        self._is_whole_due = False
        self._changes_at = 0.0
        self._state: Publisher
        self._changes: Publisher

    async def start(self) -> None:
        """Advertise topics and service, and publish the current state."""
        node = self._node
        self.service = await node.advertise_service(GET_STATE_SERVICE, GET_STATE, self.get_state)
        self._state = await node.advertise(STATE_TOPIC, STATE, latch=True)
        self._changes = await node.advertise(CHANGES_TOPIC, CHANGES)
        self.publish_whole()

    @property
    def started(self) -> Time:
        """When the planner began, with its grid."""
        return self._started

    def restart(self, planner: FleetPlanner) -> None:
        """Publish the state of another planner, as after a restart."""
        self._planner = planner
        self._started = Time.now()

    def update(self, now: float) -> None:
        """Publish what is due at ``now``, in seconds; call it a few times per second."""
        changes = self._planner.take_changes()
        if changes is not None or now - self._changes_at >= REPEAT_S:
            self._changes_at = now
            fields = changes_fields(self._started, changes, self._planner.sequence, now)
            self._changes.publish(fields | fleet_fields(self._planner))
        self._is_whole_due |= changes is not None
        pause = len(self._planner.state.robots) / WHOLE_ROBOTS_PER_S
        if self._is_whole_due and now - self._whole_at >= pause:
            self._whole_at, self._is_whole_due = now, False
            self.publish_whole()

    def publish_whole(self) -> None:
        """Publish the complete state now."""
        self._state.publish(state_fields(self._started, self._planner, time.monotonic()))

    def get_state(self, request: Message) -> dict[str, Any]:
        """Answer a ``fleet/GetState`` request."""
        del request
        state = state_fields(self._started, self._planner, time.monotonic())
        return {"sequence": self._planner.sequence, "state": state}


def state_fields(started: Time, planner: FleetPlanner, now: float = 0.0) -> dict[str, Any]:
    """Return the fields of a ``fleet/FleetState``.

    Args:
        started: When the planner began.
        planner: The planner.
        now: The planner's time, seconds.
    """
    grid, snapshot = planner.state.grid, planner.snapshot()
    walls = sorted(grid.blocked)
    return {
        "started": started,
        **_map_fields(grid),
        "blocked": sorted({*walls, *snapshot.blocked}),
        "pending": list(snapshot.pending),
        "walls": walls,
        "robots": [robot_fields(robot) for robot in snapshot.robots],
        "planner": planner.settings.planner,
        "zones": [zone_fields(zone, now) for _, zone in sorted(planner.state.zones.zones.items())],
        "lanes": [] if planner.state.zones.lanes is None else lane_fields(planner.state.zones.lanes),
        "blocks": [block_fields(cell, block, now) for cell, block in snapshot.blocks],
        **fleet_fields(planner),
    }


def lane_fields(lanes: LaneGraph) -> list[dict[str, Any]]:
    """Return the fields of a ``fleet/Lane`` for each lane."""
    return [{**asdict(lane), "cells": list(lane.cells)} for lane in lanes.lanes]


def fleet_fields(planner: FleetPlanner) -> dict[str, Any]:
    """Return the fields of the fleet that states and changes have in common."""
    return {"mode": planner.state.mode.value, "zones_revision": planner.state.zones.revision}


def changes_fields(
    started: Time, changes: FleetChanges | None, sequence: int, now: float = 0.0
) -> dict[str, Any]:
    """Return the fields of a ``fleet/FleetChanges``; without changes, those of a repeated number.

    Args:
        started: When the planner began.
        changes: The changes.
        sequence: Number of the last change.
        now: The planner's time, seconds.
    """
    if changes is None:
        return {"started": started, "sequence": sequence}
    return {
        "started": started,
        "sequence": changes.sequence,
        "robots": [robot_fields(robot) for robot in changes.robots],
        "removed": list(changes.removed),
        "blocked": list(changes.blocked),
        "pending": list(changes.pending),
        "freed": list(changes.freed),
        "zones": [zone_fields(zone, now) for zone in changes.zones],
        "removed_zones": list(changes.removed_zones),
        "blocks": [block_fields(cell, block, now) for cell, block in changes.blocks],
        "removed_blocks": list(changes.removed_blocks),
    }


def robot_fields(robot: RobotSnapshot) -> dict[str, Any]:
    """Return the fields of a ``fleet/RobotState``."""
    return {
        "id": robot.id,
        "state": robot.state.value,
        "reason": robot.reason,
        "cell": _or_none(robot.cell),
        "goal": _or_none(robot.goal),
        "plan": list(robot.plan),
        "granted": list(robot.granted),
        "replans": robot.replans,
        "mode": robot.mode,
        "pose_only": robot.pose_only,
    }


def _map_fields(grid: GridMap) -> dict[str, Any]:
    return {
        "rows": grid.rows,
        "columns": grid.columns,
        "cell_size": grid.cell_size,
        "origin_x": grid.origin[0],
        "origin_y": grid.origin[1],
    }


def _or_none(cell: int | None) -> int:
    """Return a cell as in messages: -1 for none."""
    return -1 if cell is None else cell
