"""``move_base``'s decisions: when to plan, to drive, to recover and to give up. Pure.

The owner calls :meth:`MoveBase.step` at every control step. When the answer wants a plan, the owner makes one
(in a thread, if it takes long) and hands it to :meth:`MoveBase.take_plan`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from math import hypot
from typing import TYPE_CHECKING

import numpy as np

from rce.lifecycle import LifeCycle
from rce_fleet.geometry.poses import Pose, Twist, compose
from rce_fleet.navigation.costmap.costs import INSCRIBED, UNKNOWN
from rce_fleet.navigation.planners.local_planner import Following, LocalPlanner

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rce_fleet.navigation.costmap.cost_grid import CostGrid
    from rce_fleet.navigation.move_base.parameters import MoveBaseParameters
    from rce_fleet.navigation.move_base.recovery import Recovery
    from rce_fleet.navigation.move_base.situation import Situation
    from rce_fleet.navigation.planners.global_planner import Plan

STANDING = Twist()
TIME_JUMP = 1.0
"""Time that goes back by more than this began anew, with a simulation or a bag, seconds."""
REPLAN_EVERY = 0.5
"""Least time between two plans while the path or the robot is blocked, seconds."""


class State(Enum):
    """What ``move_base`` does."""

    IDLE = "idle"
    """It has no goal; the robot stands."""
    PLANNING = "planning"
    """It waits for a first plan; the robot brakes."""
    CONTROLLING = "controlling"
    """It drives along a path."""
    RECOVERING = "recovering"
    """A recovery behavior moves the robot."""


class Event(Enum):
    """What happens to ``move_base``."""

    GOAL = "goal"
    """A goal came; it replaces the present one."""
    PLANNED = "planned"
    """There is a plan."""
    STUCK = "stuck"
    """There was no plan or no valid command for too long."""
    RECOVERED = "recovered"
    """A recovery behavior ended."""
    END = "end"
    """The goal was reached, given up or cancelled."""


MOVE_BASE: LifeCycle[State, Event] = LifeCycle(
    "move_base",
    {
        State.IDLE: {Event.GOAL: State.PLANNING},
        State.PLANNING: {
            Event.GOAL: State.PLANNING,
            Event.PLANNED: State.CONTROLLING,
            Event.STUCK: State.RECOVERING,
            Event.END: State.IDLE,
        },
        State.CONTROLLING: {
            Event.GOAL: State.PLANNING,
            Event.PLANNED: State.CONTROLLING,
            Event.STUCK: State.RECOVERING,
            Event.END: State.IDLE,
        },
        State.RECOVERING: {
            Event.GOAL: State.PLANNING,
            Event.RECOVERED: State.PLANNING,
            Event.END: State.IDLE,
        },
    },
)


class Ending(Enum):
    """How a goal ended."""

    SUCCEEDED = "succeeded"
    ABORTED = "aborted"


@dataclass(frozen=True)
class Decision:
    """The result of a step.

    Attributes:
        twist: The speeds to drive until the next step.
        wants_plan: A plan to the goal is wanted.
        ending: How the goal ended in this step; None: it did not.
        text: Why it ended, or what a recovery behavior did, or why the robot stands; else empty.
        trajectory: Poses ahead, shape (T, 3), in the local costmap's frame.
    """

    twist: Twist = STANDING
    wants_plan: bool = False
    ending: Ending | None = None
    text: str = ""
    trajectory: NDArray[np.float64] | None = None


class MoveBase:
    """Drives to one goal at a time.

    Args:
        parameters: Times and limits.
        local_planner: Follows paths.
        recoveries: Behaviors in the order in which they are tried.

    Attributes:
        recovered: How often a recovery behavior was started, over all goals.
    """

    def __init__(
        self, parameters: MoveBaseParameters, local_planner: LocalPlanner, recoveries: Sequence[Recovery]
    ) -> None:
        self.parameters = parameters
        self.recovered = 0
        self._local = local_planner
        self._recoveries = tuple(recoveries) if parameters.recovery_behavior_enabled else ()
        self._machine = MOVE_BASE.start(State.IDLE, "")
        self._path = np.empty((0, 3))
        self._next_recovery = 0
        self._stuck_at: Pose | None = None
        """Where the first recovery behavior began, in the global costmap's frame."""
        self._led_away = 0.0
        """How far from there recovery behaviors ended, metres."""
        self._recovery: Recovery | None = None
        self._has_begun = False
        """Whether the recovery behavior was started, in the time that is now."""
        self._cause = ""
        self._ending: tuple[Ending, str] | None = None
        self._asked_at = self._planned_at = self._valid_plan_at = self._valid_control_at = float("-inf")
        self._retries = 0
        self._waits_for_plan = False
        self._moved_at = self._now = 0.0
        self._moved_from: Pose | None = None

    @property
    def state(self) -> State:
        """What it does."""
        return self._machine.state

    @property
    def path(self) -> NDArray[np.float64]:
        """The path that is followed, shape (N, 3), in the global costmap's frame."""
        return self._path

    def start(self, now: float) -> None:
        """Begin to drive to a new goal, in place of the present one."""
        self._machine.advance(Event.GOAL)
        self._path = np.empty((0, 3))
        self._local.follow(self._path)
        self._next_recovery, self._cause, self._ending = 0, "", None
        self._recovery = self._stuck_at = self._moved_from = None
        self._waits_for_plan = False
        self._now = now
        self._begin_times_anew(now)

    def cancel(self) -> None:
        """Drop the goal; the robot stops with the next command. Do nothing without a goal."""
        if self.state is not State.IDLE:
            self._end()

    def take_plan(self, plan: Plan, now: float) -> None:
        """Take the plan that was wanted; a plan that comes too late is ignored."""
        self._waits_for_plan = False
        if self.state not in (State.PLANNING, State.CONTROLLING):
            return
        if plan.found:
            self._machine.advance(Event.PLANNED)
            self._path = plan.path
            self._local.follow(np.empty((0, 3)))
            self._valid_plan_at = now
            self._retries = 0
            return
        self._retries += 1
        limit = self.parameters.max_planning_retries
        late = now - self._valid_plan_at > self.parameters.planner_timeout
        if self.state is State.PLANNING and (late or 0 <= limit < self._retries):
            self._give_up_or_recover(f"failed to find a valid plan: {plan.reason}")

    def step(self, situation: Situation, costs: CostGrid) -> Decision:
        """Return what to do until the next step.

        Args:
            situation: What is known.
            costs: The global costmap.
        """
        passed = situation.now - self._now
        if passed < -TIME_JUMP:
            self._begin_times_anew(situation.now)
            self._has_begun = False
            passed = 0.0
        self._now = situation.now
        if self._ending is not None:
            ending, text = self._ending
            self._ending = None
            return Decision(ending=ending, text=text)
        if self.state is State.IDLE:
            return Decision()
        if situation.problem:
            # This time does not count: the robot stands because it must not drive, not because it cannot.
            self._leave_out(passed)
            self._local.stand()
            return Decision(text=situation.problem)
        if self.state is State.RECOVERING:
            return self._recover(situation)
        self._watch_motion(situation)
        if self.state is State.CONTROLLING:
            return self._control(situation, costs)
        step = self._local.step(situation.pose, situation.measured, situation.obstacles, situation.dt)
        return Decision(step.twist, wants_plan=self._wants_plan(situation.now))

    # Driving

    def _control(self, situation: Situation, costs: CostGrid) -> Decision:
        now, parameters = situation.now, self.parameters
        path = compose(situation.local_from_global.as_array(), self._path)
        if self._local.path is None:
            self._local.follow(path)
        else:
            self._local.move_path(path)
        step = self._local.step(situation.pose, situation.measured, situation.obstacles, situation.dt)
        if step.following is Following.REACHED:
            self._end(Ending.SUCCEEDED, "Goal reached.")
            return self.step(situation, costs)
        is_due = parameters.planner_frequency > 0 and (
            now - self._asked_at >= 1 / parameters.planner_frequency - situation.dt / 2
        )
        wants_plan = False
        if step.following is Following.BLOCKED:
            wants_plan = True
            if now - self._valid_control_at > parameters.controller_timeout:
                self._give_up_or_recover("failed to find a valid control")
                return Decision(step.twist)
        else:
            self._valid_control_at = now
            wants_plan = wants_plan or self._path_is_blocked(costs)
        oscillates = 0 < parameters.oscillation_timeout < now - self._moved_at
        if oscillates:
            self._give_up_or_recover("the robot is oscillating")
            return Decision(step.twist)
        wanted = (is_due and self._wants_plan(now, 0.0)) or (wants_plan and self._wants_plan(now))
        return Decision(step.twist, wants_plan=wanted, trajectory=step.trajectory)

    def _wants_plan(self, now: float, least: float = REPLAN_EVERY) -> bool:
        """Return whether to ask for a plan, at least ``least`` seconds after the last one; note it."""
        if self._waits_for_plan or now - self._asked_at < least:
            return False
        self._waits_for_plan, self._asked_at = True, now
        return True

    def _path_is_blocked(self, costs: CostGrid) -> bool:
        """Return whether the rest of the path leads through cells that the robot cannot enter."""
        path = self._local.path
        if path is None:
            return False
        first = int(np.searchsorted(path.at, path.progress))
        found = costs.costs_at(self._path[first:, :2], outside=UNKNOWN)
        return bool(((found >= INSCRIBED) & (found != UNKNOWN)).any())

    def _watch_motion(self, situation: Situation) -> None:
        """Note when the robot has moved on; then recovery begins with its first behavior again.

        What a recovery behavior drives does not count, nor the way back to where the robot was stuck.
        """
        at, far = situation.global_pose, self.parameters.oscillation_distance
        if self._stuck_at is not None and _distance(at, self._stuck_at) >= self._led_away + far:
            self._next_recovery, self._stuck_at = 0, None
        if self._moved_from is None or _distance(at, self._moved_from) >= far:
            self._moved_at, self._moved_from = situation.now, at

    # Recovering

    def _give_up_or_recover(self, cause: str) -> None:
        self._cause = cause
        if self._next_recovery >= len(self._recoveries):
            tried = "; recovery behaviors did not help" if self._recoveries else ""
            self._end(Ending.ABORTED, f"{cause[0].upper()}{cause[1:]}{tried}.")
            return
        self._machine.advance(Event.STUCK)
        self._recovery = None

    def _recover(self, situation: Situation) -> Decision:
        if self._recovery is None:
            if self._next_recovery == 0:
                self._stuck_at, self._led_away = situation.global_pose, 0.0
            self._recovery = self._recoveries[self._next_recovery]
            self._next_recovery += 1
            self.recovered += 1
            self._has_begun = False
        if not self._has_begun:
            self._recovery.start(situation)
            self._has_begun = True
        step = self._recovery.step(situation)
        if not step.done:
            return Decision(step.twist)
        name = self._recovery.name
        self._machine.advance(Event.RECOVERED)
        self._local.reset()
        self._moved_from = None
        if self._stuck_at is not None:
            self._led_away = max(self._led_away, _distance(situation.global_pose, self._stuck_at))
        self._begin_times_anew(situation.now)
        return Decision(text=f"{self._cause}; recovery '{name}' {step.text}")

    def _begin_times_anew(self, now: float) -> None:
        """Let all limits of time begin now, and want a plan at once."""
        self._valid_plan_at = self._valid_control_at = self._moved_at = now
        self._retries = 0
        self._asked_at = float("-inf")

    def _leave_out(self, seconds: float) -> None:
        """Let all limits of time be reached so much later."""
        self._valid_plan_at += seconds
        self._valid_control_at += seconds
        self._moved_at += seconds

    def _end(self, ending: Ending | None = None, text: str = "") -> None:
        self._machine.advance(Event.END)
        self._local.reset()
        self._path = np.empty((0, 3))
        if ending is not None:
            self._ending = (ending, text)


def _distance(one: Pose, other: Pose) -> float:
    return hypot(one.x - other.x, one.y - other.y)
