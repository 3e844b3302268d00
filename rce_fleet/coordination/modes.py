"""Robots' modes: whether the planner drives a robot, and if not, how the others treat it. Pure.

A mode is set by a person or a program, for one robot or for the whole fleet. A robot in any other mode than
``automatic`` takes no part in plans, and all others plan around it at once.
"""

from __future__ import annotations

from enum import Enum


class RobotMode(Enum):
    """Who drives a robot."""

    AUTOMATIC = "automatic"
    """The planner drives it."""
    PAUSED = "paused"
    """It is stopped, keeps its goal, and stays in its cell until it is automatic again."""
    STOPPED = "stopped"
    """Emergency stop: as paused, and its granted cells are not used up: its navigation is cancelled."""
    MANUAL = "manual"
    """A person drives it. It claims the cells around its pose, and others in its way are stopped."""
    OUT_OF_SERVICE = "out_of_service"
    """It was taken out of service and stands on the floor: it has no goal, and takes none."""
    DEAD = "dead"
    """It lies dead on the floor where its last pose was: a person says that it does not move any more."""
    LOST = "lost"
    """Its localization does not know where it is. Not set by people: the planner sees it from the poses."""

    @property
    def is_followed(self) -> bool:
        """Whether its cells follow its pose, because the planner does not know where it will drive."""
        return self in _FOLLOWED

    @property
    def is_placed(self) -> bool:
        """Whether a robot that stands still is placed in the cell where its poses are."""
        return not self.is_followed and self is not RobotMode.LOST

    @property
    def takes_goals(self) -> bool:
        """Whether it can be sent to a cell; it may have to wait until it is automatic."""
        return self not in _WITHOUT_GOAL


_FOLLOWED = frozenset({RobotMode.MANUAL, RobotMode.DEAD})
_WITHOUT_GOAL = frozenset({RobotMode.OUT_OF_SERVICE, RobotMode.DEAD})
FLEET_MODES = frozenset({RobotMode.AUTOMATIC, RobotMode.PAUSED, RobotMode.STOPPED})
"""Modes that the fleet as a whole can have. They do not change the robots' own modes."""
WORDS = {
    RobotMode.PAUSED: "paused",
    RobotMode.STOPPED: "stopped by an emergency stop",
    RobotMode.MANUAL: "driven by hand",
    RobotMode.OUT_OF_SERVICE: "out of service",
    RobotMode.DEAD: "dead on the floor",
}
"""The modes as reasons, for people."""


def effective_mode(fleet: RobotMode, robot: RobotMode) -> RobotMode:
    """Return the mode that counts, of the fleet's and the robot's own.

    A robot's own mode counts unless it is automatic; an emergency stop of the fleet also counts for robots
    that are paused.
    """
    if robot is RobotMode.AUTOMATIC or (fleet is RobotMode.STOPPED and robot is RobotMode.PAUSED):
        return fleet
    return robot


def read_mode(text: str) -> RobotMode:
    """Return a mode by its name.

    Raises:
        ValueError: There is no such mode.
    """
    modes = {mode.value: mode for mode in RobotMode if mode is not RobotMode.LOST}
    if text not in modes:
        raise ValueError(f"there is no mode {text!r}; modes are {', '.join(modes)}")
    return modes[text]
