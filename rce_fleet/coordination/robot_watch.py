"""Timeouts of robots: one fell silent, did not move, or has not acknowledged a message. Pure."""

from __future__ import annotations

from math import inf, isnan
from typing import TYPE_CHECKING

from rce_fleet.coordination.events import SendCancel, SendCells
from rce_fleet.coordination.robot import Cause, Phase

if TYPE_CHECKING:
    from rce_fleet.coordination.dispatcher import Dispatcher
    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.coordination.robot import RobotRecord
    from rce_fleet.coordination.settings import FleetSettings

_SENDS = 3
"""A robot that is driven by its poses and does not move is sent its cells so often before it is held."""
NO_POSE = "it has sent no pose yet: its localization does not run, or has no map or scans"


class RobotWatch:
    """Handles the timeouts of robots, at the time of the dispatcher's current event.

    Args:
        state: The fleet's state.
        settings: The timeouts.
        dispatcher: Stops robots and sends messages.
    """

    def __init__(self, state: FleetState, settings: FleetSettings, dispatcher: Dispatcher) -> None:
        self._state = state
        self._settings = settings
        self._dispatcher = dispatcher

    def check(self, record: RobotRecord) -> None:
        """Handle timeouts of one robot."""
        now = self._dispatcher.now
        self._judge_by_poses(record)
        heard = record.heard(now, self._settings)
        if record.phase is Phase.SILENT:
            if heard:
                self._state.change(record, Cause.HEARD, "it sends messages again")
                self._dispatcher.hold(record, "it sends messages again")
        elif not heard:
            self._lose(record)
        elif isnan(record.x) and record.reason != NO_POSE:
            record.reason = NO_POSE
            self._state.touch(record)
        elif record.phase is Phase.ACTIVE and self._stalled(record):
            self._start_again(record)
        elif now - record.sent_at >= self._settings.repeat_after:
            self._repeat(record)
            if record.phase is Phase.HOLDING and now - record.held_at >= self._settings.hold_timeout:
                self._dispatcher.avoid(record)

    def _judge_by_poses(self, record: RobotRecord) -> None:
        """Notice a move client that answers nothing; let time pass for its robot, which may send no poses."""
        if not record.pose_only:
            since = self._dispatcher.now - record.reported_at
            if record.report is not None or isnan(record.x) or since < self._settings.pose_only_after:
                return
            record.pose_only = True
            self._state.touch(record)
        if record.phase is Phase.HOLDING:
            record.hear(self._dispatcher.now, self._settings)
            self._dispatcher.to_settle.add(record.id)
        elif record.phase is Phase.ACTIVE:
            self._dispatcher.arrive_by_pose(record, self._dispatcher.now)

    def due(self, record: RobotRecord) -> float:
        """Return when to check a robot next, if no message from it or to it comes before.

        A message that is sent later is also repeated later, so a check every ``repeat_after`` seconds is
        enough.
        """
        now = self._dispatcher.now
        if record.phase is Phase.SILENT:
            is_mute = record.report is None and not isnan(record.x)
            return max(record.reported_at + self._settings.pose_only_after, now) if is_mute else inf
        sent = record.sent_at if self._is_unconfirmed(record) else now
        times = [
            max(sent, now - self._settings.repeat_after) + self._settings.repeat_after,
            min(record.alive_at, record.reported_at) + self._settings.silence_timeout,
        ]
        if self._is_busy(record):
            times.append(max(record.still_since(), record.sent_at) + self._settings.stall_timeout)
        return min(times)

    def _lose(self, record: RobotRecord) -> None:
        robot_first = record.alive_at < record.reported_at
        reason = (
            "the robot sends neither poses nor states of its goals"
            if robot_first
            else "its move client sends no reports"
        )
        self._state.change(record, Cause.LOST, reason)
        self._state.ledger.truncate(record.id)
        self._dispatcher.avoid(record)

    def _is_busy(self, record: RobotRecord) -> bool:
        """Return whether a robot has cells to drive to."""
        granted = self._state.ledger.granted(record.id)
        return record.phase is Phase.ACTIVE and (len(granted) > 1 or not record.centred)

    def _stalled(self, record: RobotRecord) -> bool:
        """Return whether a robot has had cells to drive to for long and has not moved."""
        since = max(record.still_since(), record.sent_at)
        return self._is_busy(record) and self._dispatcher.now - since > self._settings.stall_timeout

    def _start_again(self, record: RobotRecord) -> None:
        """Stop a robot that did not move, to send it anew.

        Of one that is driven by its poses, and is not in its last cell, no pose may show that it stopped: it
        is sent its cells again first. Once it is held the others plan around it.
        """
        is_between = record.pose_only and not self._dispatcher.is_in_last_cell(record)
        if is_between and record.sent_again < _SENDS:
            record.sent_again += 1
            self._dispatcher.send(record, tuple(self._state.ledger.granted(record.id)))
        else:
            self._dispatcher.hold(record, "it did not move")

    def _is_unconfirmed(self, record: RobotRecord) -> bool:
        """Return whether a move client has not acknowledged the last list."""
        if record.pose_only:
            return record.phase is Phase.HOLDING
        return record.report is None or record.report.revision != record.revision

    def _repeat(self, record: RobotRecord) -> None:
        """Send unacknowledged messages again."""
        if not self._is_unconfirmed(record):
            return
        if record.phase is Phase.HOLDING:
            record.sent_at = self._dispatcher.now
            self._dispatcher.out += [SendCancel(record.id), SendCells(record.id, record.revision, ())]
        elif record.phase is Phase.ACTIVE:
            self._dispatcher.send(record, tuple(self._state.ledger.granted(record.id)))
