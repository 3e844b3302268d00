"""The planner's record of a robot, and the robot's life cycle."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from math import hypot, inf
from typing import TYPE_CHECKING

from rce.lifecycle import LifeCycle, remember
from rce_fleet.coordination.deadlines import ROUNDING
from rce_fleet.coordination.modes import RobotMode
from rce_fleet.coordination.move_client import ClientReport, ClientState
from rce_fleet.exceptions import TransitionError

if TYPE_CHECKING:
    from rce_fleet.coordination.settings import FleetSettings

_SIGNS = 2
"""So many signs of life it takes at least until a robot without poses stands still."""


class Phase(Enum):
    """Phase of a robot's life cycle."""

    HOLDING = "holding"
    """It is stopped, and gets a cell once it stands still. Every robot begins here."""
    ACTIVE = "active"
    """It has a cell, takes part in plans and is granted cells."""
    STANDING = "standing"
    """It has a cell and stays there, because it is not in automatic mode. The others plan around it."""
    SILENT = "silent"
    """It gives no sign of life, or its move client no report. It keeps its cells: it may stand in each."""


class Cause(Enum):
    """Causes of a change of phase."""

    SETTLED = "settled"
    """It stands still, and has a cell."""
    STAYED = "stayed"
    """It stands still and has a cell, and its mode keeps it there."""
    RESUMED = "resumed"
    """It is in automatic mode again."""
    HELD = "held"
    """It is ordered to stop."""
    LOST = "lost"
    """The robot or its move client sends no messages any more."""
    HEARD = "heard"
    """It sends messages again."""


ROBOT_LIFE: LifeCycle[Phase, Cause] = LifeCycle(
    "robot",
    {
        Phase.HOLDING: {
            Cause.SETTLED: Phase.ACTIVE,
            Cause.STAYED: Phase.STANDING,
            Cause.HELD: Phase.HOLDING,
            Cause.LOST: Phase.SILENT,
        },
        Phase.ACTIVE: {
            Cause.HELD: Phase.HOLDING,
            Cause.LOST: Phase.SILENT,
        },
        Phase.STANDING: {
            Cause.RESUMED: Phase.ACTIVE,
            Cause.HELD: Phase.HOLDING,
            Cause.LOST: Phase.SILENT,
        },
        Phase.SILENT: {
            Cause.HEARD: Phase.HOLDING,
        },
    },
    error=TransitionError,
)


@dataclass(slots=True)
class RobotRecord:
    """One robot.

    Attributes:
        id: Name of the robot, for example ``Robot1``.
        revision: Number of the last list of cells sent.
        phase: Its phase.
        x, y, yaw: Last pose, metres and radians; not a number before the first.
        posed_at: When the last pose came.
        alive_at: When the robot last gave a sign of life: a pose, or what its move client heard of it. At
            first, when the robot's first message came.
        report: Last report of its move client.
        earlier: Cells that it was granted by an earlier planner, or before it was driven by hand, and may
            still drive to, until its move client tells which or poses show that it does not.
        reported_at: When that came, likewise.
        obeyed_at: When its move client first reported to be at the end of the last list.
        goal: Its goal cell.
        goal_at: When it was sent there.
        rest: The cell it returns to when it has no goal.
        unreachable: Whether no path leads to its goal.
        full_zone: The limited zone in which it waits for room, if only that is why; empty: none.
        no_path: Why the newest plan for all has no path to its goal, for people; empty: it has one.
        centred: Whether it has been at the centre of its cell since it was placed there.
        leaving: Whether it drives out of a cell in which another robot waits; it is granted no more until it
            is at the centre of the next.
        replans: How often it lost its path because a cell on it was blocked.
        held_at: When it was last told to stand still.
        sent_at: When it was last sent a message.
        sent_again: How often it was sent the same cells again since it moved.
        took_list: Whether its move client has taken a list of this planner.
        pose_only: Whether its move client answers nothing, so that its progress is judged by its poses.
        jumped_at: When a pose came that cannot be true.
        doubted: Cells that it overlapped before such poses; it may be there still, until it is placed.
        mode: Its own mode; the fleet's may count instead.
        mode_reason: Why it has this mode, and who set it.
        lost: Why it is lost, for people; empty: it is not.
        reason: Why it is not active, in words.
        recent: The last causes of phase changes.
    """

    id: str
    revision: int
    phase: Phase = Phase.HOLDING
    x: float = float("nan")
    y: float = float("nan")
    yaw: float = float("nan")
    posed_at: float = -inf
    alive_at: float = -inf
    report: ClientReport | None = None
    earlier: frozenset[int] = frozenset()
    reported_at: float = -inf
    obeyed_at: float = inf
    goal: int | None = None
    goal_at: float = inf
    rest: int | None = None
    unreachable: bool = False
    full_zone: str = ""
    no_path: str = ""
    centred: bool = False
    leaving: bool = False
    replans: int = 0
    held_at: float = -inf
    sent_at: float = -inf
    sent_again: int = 0
    took_list: bool = False
    pose_only: bool = False
    jumped_at: float = -inf
    doubted: frozenset[int] = frozenset()
    mode: RobotMode = RobotMode.AUTOMATIC
    mode_reason: str = ""
    lost: str = ""
    reason: str = "new"
    recent: tuple[Cause, ...] = ()
    _anchor: tuple[float, float] = (inf, inf)
    _anchored_at: float = inf
    _rested: float = 0.0
    """How long the robot has lived, in seconds, since it obeyed and its poses have stayed in one place."""

    def change(self, cause: Cause) -> None:
        """Go to the next phase.

        Raises:
            TransitionError: The phase does not allow the cause.
        """
        self.phase = ROBOT_LIFE.advance(self.phase, cause, self.id, self.recent)
        self.recent = remember(self.recent, cause)

    def see(self, x: float, y: float, yaw: float, now: float, settings: FleetSettings) -> None:
        """Update the pose."""
        if self.posed_at > -inf:
            possible = settings.jump_distance + settings.top_speed * (now - self.posed_at)
            if hypot(x - self.x, y - self.y) > possible:
                self.jumped_at = now
        self.hear(now, settings)
        self.x, self.y, self.yaw, self.posed_at = x, y, yaw, now
        if hypot(x - self._anchor[0], y - self._anchor[1]) > settings.still_distance:
            self._anchor, self._anchored_at, self.sent_again = (x, y), now, 0
            self._rested = 0.0

    def hear(self, alive_at: float, settings: FleetSettings) -> None:
        """Note a sign of life, a pose or another one."""
        rested = alive_at - max(self.alive_at, self.obeyed_at, self._anchored_at)
        self._rested += min(max(rested, 0.0), settings.pose_timeout / _SIGNS)
        self.alive_at = max(self.alive_at, alive_at)

    def still_since(self) -> float:
        """Since when the poses have stayed in one place."""
        return self._anchored_at

    def heard(self, now: float, settings: FleetSettings) -> bool:
        """Return whether robot and move client sent messages recently.

        Nothing is expected of a robot that is driven by its poses only: localization may send none at rest.
        """
        return self.pose_only or self.heartbeat_age(now) <= settings.silence_timeout

    def heartbeat_age(self, now: float) -> float:
        """Return how long ago robot or move client last gave a sign of life, the one that was silent longer.

        A robot that is driven by its poses only has no move client that reports.

        Returns:
            Seconds.
        """
        return now - (self.alive_at if self.pose_only else min(self.alive_at, self.reported_at))

    def take(self, report: ClientReport, now: float) -> None:
        """Update the move client's report."""
        self.report, self.reported_at, self.pose_only = report, now, False
        self.earlier = frozenset()
        self.took_list |= report.revision == self.revision
        if report.revision != self.revision or report.state not in (ClientState.IDLE, ClientState.FAILED):
            self.obeyed_at = inf
        elif self.obeyed_at == inf:
            self.obeyed_at = now
            self._rested = 0.0

    def next_revision(self) -> int:
        """Number of the next list of cells."""
        self.revision += 1
        self.obeyed_at = inf
        return self.revision

    def is_steady(self, settings: FleetSettings) -> bool:
        """Whether its poses have agreed with each other for a while."""
        return self.alive_at - self.jumped_at >= settings.jump_settle_time

    def shows_rest(self, settings: FleetSettings) -> bool:
        """Whether a pose shows that it stands: one that came long after it was told to, at the same place.

        Where its move client answers nothing and no such pose came, it may not have heard that it is to stop.
        """
        return self.posed_at - max(self.held_at, self._anchored_at) >= settings.pose_only_settle

    def stands(self, settings: FleetSettings) -> bool:
        """Whether it was told to stand still, acknowledged it, and its poses stay in one place.

        A robot that sends poses shows that by one that is later than its move client's report by more than
        messages are late. Localization may send none while the robot stands; then the robot must have lived
        so long without one that no pose of the drive before is still on its way. A time in which nothing was
        heard of it hardly counts: its poses of that time are lost or late.

        After a pose that cannot be true it takes longer: where the robot is, is known once its poses agree.
        """
        if not self.is_steady(settings):
            return False
        if self.pose_only:
            return self.alive_at - max(self.held_at, self._anchored_at) >= settings.pose_only_settle
        if self.posed_at - max(self.obeyed_at, self._anchored_at) >= settings.settle_time:
            return True
        return self.obeyed_at < inf and self._rested >= settings.pose_timeout - ROUNDING
