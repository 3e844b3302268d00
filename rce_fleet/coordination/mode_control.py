"""Sets robots' modes, and has the others plan around robots that are not driven by the planner."""

from __future__ import annotations

from math import isnan
from typing import TYPE_CHECKING

from rce_fleet.coordination.events import ModeSet, Reply
from rce_fleet.coordination.modes import FLEET_MODES, WORDS, RobotMode
from rce_fleet.coordination.robot import Cause, Phase

if TYPE_CHECKING:
    from rce_fleet.coordination.dispatcher import Dispatcher
    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.coordination.robot import RobotRecord


class ModeControl:
    """Changes modes.

    Args:
        state: The fleet's state.
        dispatcher: Stops robots and makes new plans.
    """

    def __init__(self, state: FleetState, dispatcher: Dispatcher) -> None:
        self._state = state
        self._dispatcher = dispatcher

    def set_mode(self, event: ModeSet) -> Reply:
        """Set the mode of a robot or of the fleet."""
        state = self._state
        if event.robot is None:
            return self._set_fleet(event)
        found = state.robots.get(event.robot)
        if found is None:
            return Reply(False, f"robot {event.robot} is unknown")
        if event.mode is RobotMode.DEAD and isnan(found.x):
            return Reply(False, f"{found.id} has sent no pose, so its place is not known: remove it instead")
        was = state.mode_of(found)
        found.mode, found.mode_reason = event.mode, _words(event, event.mode)
        if not event.mode.takes_goals:
            found.goal = found.rest = None
        self._apply(found, was, state.reason_of(found))
        is_overruled = state.mode_of(found) is not event.mode
        return Reply(
            True,
            f"{found.id} is {event.mode.value}"
            + (f"; the fleet is {state.mode.value}" if is_overruled else ""),
        )

    def set_lost(self, record: RobotRecord, why: str) -> None:
        """Note that a robot's localization does not know where it is (``why``), or knows it again (empty).

        Until then it stands, if the planner drives it, and keeps its cells: its poses do not show its place.
        """
        was = self._state.mode_of(record)
        record.lost = why
        self._apply(record, was, why)
        if record.phase is Phase.HOLDING and self._state.mode_of(record) is RobotMode.LOST:
            record.reason = why

    def _set_fleet(self, event: ModeSet) -> Reply:
        """Set the mode of the fleet; robots that have a mode of their own keep it."""
        state = self._state
        if event.mode not in FLEET_MODES:
            known = ", ".join(sorted(mode.value for mode in FLEET_MODES))
            return Reply(False, f"the fleet cannot be {event.mode.value}; its modes are {known}")
        before = {robot: state.mode_of(record) for robot, record in state.robots.items()}
        state.mode, state.mode_reason = event.mode, _words(event, event.mode)
        for robot in sorted(before):
            self._apply(state.robots[robot], before[robot], state.reason_of(state.robots[robot]))
        return Reply(True, f"the fleet is {event.mode.value}")

    def _apply(self, record: RobotRecord, was: RobotMode, reason: str) -> None:
        """Carry out a change of the mode that counts for a robot."""
        state, dispatcher = self._state, self._dispatcher
        mode = state.mode_of(record)
        state.touch(record)
        if mode is was:
            return
        if mode.is_followed:
            self._follow(record, reason)
        elif mode is RobotMode.AUTOMATIC:
            self._resume(record)
        elif record.phase is Phase.ACTIVE or (was.is_followed and record.phase is Phase.HOLDING):
            dispatcher.hold(record, reason)
            dispatcher.avoid(record)
        elif record.phase is Phase.STANDING:
            record.reason = reason

    def _follow(self, record: RobotRecord, reason: str) -> None:
        """Let a robot's cells follow its pose from now on."""
        state, dispatcher = self._state, self._dispatcher
        if record.phase is not Phase.SILENT:
            dispatcher.hold(record, reason)
        record.reason = reason
        if record.pose_only:  # It may not have heard; of a dead one a person says that it does not drive.
            is_dead = state.mode_of(record) is RobotMode.DEAD
            record.earlier = frozenset() if is_dead else record.earlier | state.ledger.claims(record.id)
        state.ledger.unplace(record.id)
        dispatcher.watch(record)

    def _resume(self, record: RobotRecord) -> None:
        """Let the planner drive a robot again, from where it stands."""
        state, dispatcher = self._state, self._dispatcher
        if record.phase is Phase.STANDING:
            state.change(record, Cause.RESUMED, "")
            if dispatcher.has_room(record):
                dispatcher.send(record, tuple(state.ledger.granted(record.id)))
                dispatcher.require([record.id])
            else:
                dispatcher.hold(record, "another robot is in its way")
        elif record.phase is Phase.HOLDING:
            dispatcher.hold(record, "it joins again")
        dispatcher.require(other.id for other in state.robots.values() if other.unreachable)


def _words(event: ModeSet, mode: RobotMode) -> str:
    """Return a mode with its reason and author, for people."""
    details = ", ".join(filter(None, (event.reason, f"by {event.by}" if event.by else "")))
    return WORDS.get(mode, "") + (f" ({details})" if details else "")
