"""Many simple robots in one world: bodies, controllers, goals, and the judge of their contacts."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rce_fleet.geometry.angles import wrap
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.simulation.goal_list import GoalList
from rce_fleet.simulation.lidar import Floats
from rce_fleet.simulation.light.batteries import LightBatteries
from rce_fleet.simulation.light.bodies import LightBodies, LightModel
from rce_fleet.simulation.light.contacts import ContactJudge
from rce_fleet.simulation.light.steering import Steering, limits_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from rce_fleet.simulation.walls import Block

TIME_STEP = 0.04
"""Seconds of a step."""
HAND_S = 0.5
"""Seconds for which a velocity counts that a person sends, as the safety stage of other robots has it."""
BATTERY_STEPS = 25
"""Steps after which batteries are advanced: a second."""
_EPSILON = 1e-9
_CONTACTS = 20
"""So many contacts are kept with time and place, the first ones."""


class LightContact(NamedTuple):
    """A contact of a light robot with another robot.

    Attributes:
        time: Simulated time, seconds.
        robot: The robot's id.
        other: The other's id; empty: it is not a light one.
        x, y: Where the robot was, metres.
    """

    time: float
    robot: str
    other: str
    x: float
    y: float


class LightRobots:
    """Robots that drive to goals, without a physics engine: nothing stops them but their own wheels.

    Like :class:`rce_fleet.simulation.world.World`, it advances in fixed steps, and its noise is seeded.

    Args:
        starts: Where each robot stands at first, by its id.
        edges: Edges of walls, shape (M, 4): x, y of both ends, metres.
        model: What the robots are like.
        seed: Seed of the noise.

    Attributes:
        names: The ids of all robots, in the order of their rows.
        present: Which robots are in the world, shape (N,); those that were removed keep their rows.
        bodies: Their places and speeds.
        batteries: Their batteries.
        steering: Their controllers.
        goal_lists: The goals of each robot's ``move_base``.
        judge: Counts their contacts.
        contacts: The first contacts between robots.
        time: Simulated time, seconds.
        stopped: Which robots are under an emergency stop, shape (N,). They keep their goals.

    Example:
        ``robots = LightRobots({"Robot1": Pose(1, 1, 0)}, np.empty((0, 4)))``
        ``robots.accept(0, "goal", 0.0, 3.0, 1.0); robots.advance(10.0)``
    """

    def __init__(
        self,
        starts: Mapping[str, Pose],
        edges: Floats,
        model: LightModel | None = None,
        *,
        seed: int = 0,
    ) -> None:
        self.names = tuple(starts)
        self.model = model or LightModel()
        self.present: NDArray[np.bool_] = np.ones(len(self.names), np.bool_)
        self._rows = {name: row for row, name in enumerate(self.names)}
        self._walls, self._boxes = edges, np.empty((0, 4))
        self.bodies = LightBodies(list(starts.values()), self.model, seed)
        self.stopped: NDArray[np.bool_] = np.zeros(len(self.names), np.bool_)
        self.docks: Floats = np.empty((0, 3))
        """Where standing robots are charged, shape (D, 3): x, y and reach, metres."""
        self.others: Floats = np.empty((0, 3))
        """Discs of other robots, shape (K, 3): x, y and radius, metres."""
        self.walkers: Floats = np.empty((0, 3))
        """Discs of walkers, likewise."""
        self.doors: Sequence[Block] = ()
        """The leaves of doors."""
        self.speed_limits: Floats = np.full(len(self.names), np.inf)
        """Highest speeds by row, as programs set them; a reset of the world does not end them."""
        self.reset()

    def __len__(self) -> int:
        return len(self.names)

    def row(self, robot: str) -> int | None:
        """Return the row of a robot; None if it is not one of these, or was removed."""
        row = self._rows.get(robot)
        return None if row is None or not self.present[row] else row

    @property
    def present_names(self) -> dict[int, str]:
        """The ids of the robots that are present, by their rows in growing order."""
        return {row: self.names[row] for row in np.flatnonzero(self.present).tolist()}

    @property
    def discs(self) -> Floats:
        """Where the robots are that are present, shape (P, 3): x, y and radius, metres."""
        places = self.bodies.poses[self.present, :2]
        return np.concatenate((places, np.full((len(places), 1), self.model.radius)), axis=1)

    def pose(self, row: int) -> Pose:
        """Return the true pose of a robot."""
        x, y, yaw = self.bodies.poses[row].tolist()
        return Pose(x, y, wrap(yaw))

    def twist(self, row: int) -> Twist:
        """Return the speeds of a robot's wheels."""
        speed, turn = self.bodies.speeds[row].tolist()
        return Twist(speed, turn)

    def reset(self) -> None:
        """Begin anew: time 0, all robots at their starts, without goals, the same noise to come."""
        self.time, self._steps = 0.0, 0
        self.bodies.reset()
        self.batteries = LightBatteries(len(self), self.model.battery)
        self.steering = Steering(len(self), limits_of(self.model))
        self.steering.speed_limits = self.speed_limits
        self._powered = self.present[:, np.newaxis]
        self.goal_lists = [GoalList() for _ in self.names]
        self._busy: set[int] = set()
        self._by_hand: dict[int, tuple[float, float, float]] = {}
        """Speed, turn rate and end of a velocity that a person sent, by row."""
        self.contacts: list[LightContact] = []
        reach = max(1.0, self.model.radius)
        self.judge = ContactJudge(*self._solid(), reach)

    def set_boxes(self, edges: Floats) -> None:
        """Take the edges of all boxes, shape (M, 4), metres; those from before are gone."""
        self._boxes = edges
        self.judge.set_edges(*self._solid())

    def put(self, row: int, pose: Pose, *, as_start: bool = False) -> None:
        """Put a robot elsewhere, as a hand would; ``as_start``: it also stands there after a reset."""
        self.bodies.put(row, pose, as_start=as_start)

    def remove(self, row: int) -> None:
        """Take a robot out of the world for good: it stands, nothing meets it, and its goals end."""
        self.judge.leave_out(int(np.count_nonzero(self.present[:row])))
        self.present[row] = False
        self.cancel(row, "", 0.0)
        self.bodies.speeds[row] = 0.0
        self._powered = self._powered & self.present[:, np.newaxis]

    # Goals

    def accept(self, row: int, goal_id: str, stamp: float, x: float, y: float) -> None:
        """Accept a goal of a robot; as :meth:`rce_fleet.simulation.goal_list.GoalList.accept`."""
        if self.goal_lists[row].accept(goal_id, stamp, x, y):
            self.steering.follow(row, x, y)
        self._busy.add(row)

    def cancel(self, row: int, goal_id: str, stamp: float) -> None:
        """Cancel goals of a robot; as :meth:`rce_fleet.simulation.goal_list.GoalList.cancel`."""
        if self.goal_lists[row].cancel(goal_id, stamp):
            self.steering.stop(row)

    def limit_speed(self, row: int, speed: float) -> None:
        """Let a robot drive at most at a speed, metres per second; infinity: as fast as it can.

        A reset of the world does not end it: programs send a limit only when it changes.
        """
        self.speed_limits[row] = speed

    def take_ended(self) -> list[int]:
        """Return the robots with goals that ended since the last call, see :attr:`goal_lists`."""
        steering, ended = self.steering, []
        done = ~steering.driving & steering.standing
        for row in sorted(self._busy):
            goals = self.goal_lists[row]
            goals.now = self.time
            if done[row]:
                goals.end()
            if done[row] or goals.has_ended:
                ended.append(row)
            if goals.current is None:
                self._busy.discard(row)
        return ended

    # What comes without a goal

    def stop(self, row: int, *, stopped: bool) -> None:
        """Begin or end the emergency stop of a robot. A reset of the world does not end it."""
        self.stopped[row] = stopped

    def drive(self, row: int, speed: float, turn_rate: float) -> None:
        """Drive by hand for :data:`HAND_S`; goals wait. Metres and radians per second.

        Args:
            row: The robot.
            speed: Forward; what is not finite counts as 0.
            turn_rate: Counter-clockwise.
        """
        speed, turn_rate = (value if isfinite(value) else 0.0 for value in (speed, turn_rate))
        self._by_hand[row] = speed, turn_rate, self.time + HAND_S

    def _commands(self) -> Floats:
        """Return what the wheels do: as steered, driven by hand, or stopped."""
        commands = self.steering.commands
        for row, (speed, turn_rate, until) in list(self._by_hand.items()):
            if self.time > until:
                del self._by_hand[row]
                commands[row] = 0.0
            else:
                commands[row] = speed, turn_rate
        commands[self.stopped] = 0.0
        return commands

    # Time

    def advance(self, seconds: float) -> None:
        """Advance time; only whole steps are made, and the rest is added to the next call."""
        self.time += seconds
        while (self._steps + 1) * TIME_STEP <= self.time + _EPSILON:
            self._steps += 1
            self.steering.update(self.bodies.estimates, TIME_STEP)
            self.bodies.step(self._commands() * self._powered, TIME_STEP)
            if self._steps % BATTERY_STEPS == 0:
                self._drain(BATTERY_STEPS * TIME_STEP)
            own = self.discs
            discs = np.concatenate((own, self.others)) if len(self.others) else own
            self.judge.update(discs[:, :2], discs[:, 2], len(own))
            if len(self.walkers) or self.doors:
                self.judge.update_moving(own[:, :2], own[:, 2], self.walkers, self.doors)
            if self.judge.began and len(self.contacts) < _CONTACTS:
                self._note_contacts()

    def _note_contacts(self) -> None:
        rows = np.flatnonzero(self.present).tolist()
        for disc, other in sorted(self.judge.began):
            row = rows[disc]
            x, y = self.bodies.poses[row, :2].tolist()
            name = self.names[rows[other]] if other < len(rows) else ""
            self.contacts.append(LightContact(self._steps * TIME_STEP, self.names[row], name, x, y))

    def _drain(self, seconds: float) -> None:
        """Advance the batteries; a robot with an empty one stops."""
        docked = np.zeros(len(self), np.bool_)
        for x, y, reach in self.docks.tolist():
            away = np.hypot(self.bodies.poses[:, 0] - x, self.bodies.poses[:, 1] - y)
            docked |= away <= reach
        self.batteries.step(seconds, self.bodies.speeds, docked)
        self._powered = (self.present & ~self.batteries.empty)[:, np.newaxis]

    def _solid(self) -> tuple[Floats, np.ndarray[tuple[int, ...], np.dtype[np.bool_]]]:
        """Return all edges, and which of them are walls."""
        edges = np.concatenate((self._walls, self._boxes))
        return edges, np.arange(len(edges)) < len(self._walls)
