"""Sends the view and its changes to the pages.

A page first gets ``map``, ``state`` and ``poses``, which are complete, and ``waiting``, the seconds for which
robots have waited, if some do; then ``changes``, numbered from the ``state`` on, and ``poses`` of robots that
moved. A page that misses a number reconnects. A page that asked
for it gets poses as frames (:mod:`rce_fleet.station.pose_frames`).
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Sequence
from typing import Any

from rce_fleet.station.live import Broadcast, Message
from rce_fleet.station.pose_frames import PoseRow, encode_poses
from rce_fleet.station.view import FleetView, ViewChange

POSES_EVERY_S = 0.1
"""Seconds between two messages with poses."""
REPEAT_POSE_S = 1.0
"""Seconds after which an unchanged pose is sent again, to show that the robot is connected."""

_Pose = tuple[float, float, float]


class Feed:
    """Sends the fleet to the pages.

    Attributes:
        pages: The open pages.
        waiting_since: Since when robots wait, monotonic seconds.

    Args:
        view: The state of the fleet.
    """

    def __init__(self, view: FleetView) -> None:
        self.pages = Broadcast(self._tell_all, lambda: self._tell_all(compact=True))
        self._view = view
        self._number = 0
        self._heard: set[str] = set()
        self._any_heard = asyncio.Event()
        self._sent: dict[str, tuple[_Pose, float]] = {}
        self._all: dict[bool, list[Message]] = {}
        self._indices: dict[str, int] = {}
        self.waiting_since: dict[str, float] = {}

    async def run(self) -> None:
        """Send poses in batches until cancelled."""
        while True:
            await self._any_heard.wait()
            self._any_heard.clear()
            self.send_poses(time.monotonic())
            await asyncio.sleep(POSES_EVERY_S)

    def on_change(self, change: ViewChange) -> None:
        """Send a change of the view."""
        if not change:
            return
        self._number += 1
        self._all.clear()
        for robot in change.removed:
            self._sent.pop(robot, None)
            self.waiting_since.pop(robot, None)
        now = time.monotonic()
        for robot in change.robots:
            if self._view.state_of(robot) == "waiting":
                self.waiting_since.setdefault(robot, now)
            else:
                self.waiting_since.pop(robot, None)
        for robot in change.robots:
            if robot not in self._sent and robot in self._view.poses:
                self.on_pose(robot)
        if change.is_new_map:
            self.pages.send_change(_text("map", self._view.map() or {}))
        self.pages.send_change(
            _text(
                "changes",
                {
                    "sequence": self._number,
                    "mode": self._view.mode,
                    "robots": self._robots(change.robots),
                    "removed": change.removed,
                    "blocked": change.blocked,
                    "pending": change.pending,
                    "freed": change.freed,
                    "blocks": self._view.blocks(change.blocks),
                    "removed_blocks": change.removed_blocks,
                },
            )
        )

    def on_pose(self, robot: str) -> None:
        """Add a robot's pose to the next batch."""
        self._heard.add(robot)
        self._any_heard.set()

    def send_poses(self, now: float) -> None:
        """Send the poses of robots that moved, or were not sent for a while; ``now`` is in seconds."""
        moved: dict[str, _Pose] = {}
        for robot in sorted(self._heard):
            if not self._view.knows(robot) or robot not in self._view.poses:
                continue
            pose = self._pose(robot)
            before, sent_at = self._sent.get(robot, (None, 0.0))
            if pose != before or now - sent_at >= REPEAT_POSE_S:
                self._sent[robot] = pose, now
                moved[robot] = pose
        self._heard.clear()
        if moved:
            self._all.clear()
            self.pages.send_forms(lambda: _text("poses", {"poses": moved}), lambda: self._frame(moved, now))

    def on_engine(self, state: dict[str, Any]) -> None:
        """Send the engine's state."""
        self.pages.send("engine", _text("engine", state))

    def on_control(
        self,
        stopped: dict[str, str],
        driven: dict[str, str],
        fleet: str | None = None,
        undelivered: Sequence[str] = (),
    ) -> None:
        """Send who stopped and who drives which robots.

        Args:
            stopped: Who stopped each robot that shall stand.
            driven: Who drives each robot that is driven by hand.
            fleet: Who stopped all robots; None: they are not stopped as a whole.
            undelivered: Robots of ``stopped`` that have not got the stop yet.
        """
        message = {
            "stopped": stopped,
            "driven": driven,
            "fleet_stopped_by": fleet,
            "undelivered": list(undelivered),
        }
        self.pages.send("control", _text("control", message))

    def on_planner(self, away_since: float | None) -> None:
        """Send since when the planner is away, seconds since 1970; None: it is there."""
        self.pages.send("planner", _text("planner", {"away_since": away_since}))

    def on_event(self, text: str, tone: str) -> None:
        """Send an event."""
        self.pages.send_event(_text("event", {"text": text, "tone": tone}))

    def _tell_all(self, *, compact: bool = False) -> list[Message]:
        """Return the complete messages; made once for all pages that need them now.

        Ages of robots in frames grow while nothing else changes, so a frame is made for each page; so does
        the time that robots have waited.
        """
        grid = self._view.map()
        if grid is None:
            return []
        if compact not in self._all:
            names = self._view.robot_ids()
            state = {
                "sequence": self._number,
                "mode": self._view.mode,
                "robots": self._robots(names),
                "blocked": self._view.blocked(),
                "pending": self._view.pending(),
                "blocks": self._view.blocks(),
            }
            self._all[compact] = [_text("map", grid), _text("state", state)]
            if not compact:
                self._all[compact].append(_text("poses", {"poses": self._poses()}))
        now = time.monotonic()
        last: list[Message] = [self._frame(self._poses(), now)] if compact else []
        if self.waiting_since:
            waited = {robot: round(now - since, 1) for robot, since in self.waiting_since.items()}
            last.append(_text("waiting", {"seconds": waited}))
        return [*self._all[compact], *last]

    def _poses(self) -> dict[str, _Pose]:
        return {robot: self._pose(robot) for robot in self._view.robot_ids() if robot in self._view.poses}

    def _robots(self, names: tuple[str, ...] | list[str]) -> list[dict[str, Any]]:
        robots = self._view.robots(names)
        return [
            {key: value for key, value in robot.items() if key != "pose"}
            | {"index": self._index(robot["id"])}
            for robot in robots
        ]

    def _index(self, robot: str) -> int:
        """Return the number of a robot in frames; it keeps it while the station runs."""
        return self._indices.setdefault(robot, len(self._indices))

    def _frame(self, poses: dict[str, _Pose], now: float) -> bytes:
        rows = []
        for robot, pose in poses.items():
            age = self._view.age(robot, now)
            rows.append(PoseRow(self._index(robot), *pose, -1.0 if age is None else age))
        return encode_poses(time.time(), rows)

    def _pose(self, robot: str) -> _Pose:
        pose = self._view.poses[robot]
        return round(pose.x, 3), round(pose.y, 3), round(pose.theta, 3)


def _text(kind: str, message: dict[str, Any]) -> str:
    return json.dumps({"type": kind, **message}, separators=(",", ":"))
