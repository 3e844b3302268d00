"""Graph mapping of one or several robots: the mapper that logs and nodes use."""

from __future__ import annotations

from math import hypot
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.geometry.poses import compose, inverse, relative
from rce_fleet.mapping.graph import pruning
from rce_fleet.mapping.graph.agreement import Agreement
from rce_fleet.mapping.graph.joining import JoinWatch, PlaceList
from rce_fleet.mapping.graph.key_graph import Edge, KeyGraph
from rce_fleet.mapping.graph.loop_closing import Closure, LoopMatcher
from rce_fleet.mapping.graph.occupancy import draw_graph
from rce_fleet.mapping.graph.parameters import GraphParameters
from rce_fleet.mapping.graph.refinement import refine
from rce_fleet.mapping.graph.tracker import Tracker

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.mapping.records import LaserRecord
    from rce_fleet.maps.occupancy_map import OccupancyMap

LOOP_LENGTH = 0.1
"""A loop counts as this much way, metres."""
START_LENGTH = 30.0
"""A given first pose counts as this much way, metres: loops correct it within about a metre."""
START_SIGMAS = (0.5, 0.5, 0.2)
"""Standard deviations of a given first pose, metres and radians."""
NOTABLE = (0.05, 0.01)
"""A loop that the poses contradict by more, metres and radians, has the graph optimized at once."""
BATCH = 15
"""Other loops wait until there are so many."""
CONTRADICTED = (0.5, 0.2)
"""Loops that the optimized poses contradict by more, metres and radians, are taken back."""
ONLINE_ITERATIONS = 5
PRUNE_EVERY = 50
"""The graph is pruned after so many keyscans..."""
RECENT = 100
"""... of which each robot's newest ones stay, so many."""


class GraphMapper:
    """Makes a graph map of the scans of one or several robots.

    Robots are joined where their scans match; until then each has a frame of its own, a part of the graph.
    The map's frame is that of the first robot's first scan, or of the loaded map.

    Args:
        parameters: Parameters.
        graph: A graph to continue, as :func:`~rce_fleet.mapping.graph.storage.load_graph` returns it.
        bounded: For runs without end: keep a bounded number of keyscans of each place, and no trajectory.

    Attributes:
        graph: The keyscans and their poses.
        matcher: Finds loops; counts those it refuses.
        contradicted: Number of loops that were taken back.
        undone: Number of joins that were undone.
        pruned: Number of keyscans that were removed.
    """

    def __init__(
        self,
        parameters: GraphParameters | None = None,
        graph: KeyGraph | None = None,
        *,
        bounded: bool = False,
    ) -> None:
        self.parameters = parameters or GraphParameters()
        self.graph = graph or KeyGraph()
        self.matcher = LoopMatcher(self.graph, self.parameters)
        self.contradicted = 0
        self._agreement = Agreement(self.graph, self.parameters)
        self._places = PlaceList(self.graph, self.parameters)
        self._joins = JoinWatch(self.graph, self.parameters)
        self.undone = 0
        self.pruned = 0
        self._bounded = bounded
        self._unpruned = 0
        self._trackers: dict[str, Tracker] = {}
        self._new_loops = 0

    @property
    def robots(self) -> tuple[str, ...]:
        """Names of the robots that sent scans, in the order of their first ones."""
        return tuple(self._trackers)

    @property
    def loop_closures(self) -> int:
        """Number of loops that are closed, those between robots included."""
        return self.graph.loops

    def add(self, record: LaserRecord, robot: str = "", start: NDArray[np.float64] | None = None) -> None:
        """Take the next scan of a robot.

        Args:
            record: The scan, with the robot's odometry.
            robot: Name of the robot.
            start: Pose of the robot's first scan in the map, about, shape (3,). Without it a robot that is
                not the first one is joined where its scans match.

        Raises:
            ValueError: The odometry is not finite.
        """
        if not np.isfinite(record.odometry).all():
            raise ValueError(
                f"scan {record.index}: the odometry must be three finite numbers, not {record.odometry}"
            )
        tracker = self._trackers.get(robot)
        if tracker is None:
            number = max(self.graph.robots, default=-1) + 1
            number = max(number, len(self._trackers))
            tracker = Tracker(self.graph, self.parameters, number, keeps_way=not self._bounded)
            self._trackers[robot] = tracker
        is_first = tracker.key < 0
        key = tracker.add(record, start)
        if key is None:
            return
        if is_first and start is not None and key > 0:
            self._anchor(key, start)
        self._close_loops(key)
        self._check_joins(key)
        self._unpruned += 1
        if self._bounded and self._unpruned >= PRUNE_EVERY:
            self._prune()

    def _anchor(self, key: int, start: NDArray[np.float64]) -> None:
        """Join a robot's first keyscan to the nearest one of the map, loosely."""
        others = np.flatnonzero(self.graph.parts[:key] == self.graph.parts[0])
        apart = np.hypot(*(self.graph.poses[others, :2] - start[:2]).T)
        nearest = int(others[np.argmin(apart)])
        pose = relative(self.graph.poses[nearest], start)
        information = np.diag(np.array(START_SIGMAS) ** -2.0)
        self.graph.join(Edge(nearest, key, pose, information, START_LENGTH))

    # Loops

    def _close_loops(self, key: int) -> None:
        graph = self.graph
        lengths = graph.lengths_from(key)
        found = [
            self.matcher.match(other, key, float(lengths[other]))
            for other in self.matcher.candidates(key, lengths)
        ]
        found += [self.matcher.match_anywhere(place, key) for place in self._places.of_other_parts(key)]
        for closure in found:
            if closure is not None:
                self._accept(self._agreement.add(closure))

    def _accept(self, closures: list[Closure]) -> None:
        graph = self.graph
        is_notable = False
        for one in closures:
            is_notable |= graph.parts[one.earlier] != graph.parts[one.later]
            graph.join(Edge(one.earlier, one.later, one.pose, one.information, LOOP_LENGTH, is_loop=True))
            error = relative(one.pose, relative(graph.poses[one.earlier], graph.poses[one.later]))
            is_notable |= hypot(error[0], error[1]) > NOTABLE[0] or abs(error[2]) > NOTABLE[1]
            self._new_loops += 1
        if is_notable or self._new_loops >= BATCH:
            self._optimize()

    def _optimize(self) -> None:
        self._new_loops = 0
        self.graph.optimize(ONLINE_ITERATIONS)
        dropped = self.graph.drop_loops(*CONTRADICTED)
        if dropped:
            self.contradicted += len(dropped)
            self.graph.optimize(ONLINE_ITERATIONS)

    def _check_joins(self, key: int) -> None:
        """Undo a join of two robots that a new keyscan contradicts."""
        wrong = self._joins.add(key)
        if wrong:
            self.undone += 1
            self.graph.part_at(wrong)
            self.graph.optimize(ONLINE_ITERATIONS)

    def _prune(self) -> None:
        """Remove keyscans of places that have more than enough."""
        graph = self.graph
        self._unpruned = 0
        protected = {key for robot in {*graph.robots} for key in graph.keys_of(robot)[-RECENT:]}
        protected.update(end for one in self._agreement.pending for end in (one.earlier, one.later))
        needless = pruning.surplus(graph, protected)
        if not needless:
            return
        self.pruned += len(needless)
        numbers = pruning.remove(graph, needless)
        for tracker in self._trackers.values():
            tracker.renumber(numbers)
        self._agreement.renumber(numbers)
        self._places.forget()
        self.matcher.forget()

    def finish(self) -> None:
        """Improve all poses after the last scan."""
        self._optimize()
        refine(self.graph)

    # Results

    def pose(self, robot: str = "") -> NDArray[np.float64]:
        """Return where a robot was at its last scan, in the frame of its part, shape (3,)."""
        return self._trackers[robot].pose

    def jump(self, robot: str = "") -> str:
        """Return how a robot's odometry jumped at its last scan; empty if it did not."""
        return self._trackers[robot].jump

    def is_joined(self, robot: str = "") -> bool:
        """Return whether a robot's poses are in the map's frame."""
        tracker = self._trackers.get(robot)
        return tracker is not None and tracker.key >= 0 and int(self.graph.parts[tracker.key]) == 0

    def map_from_odom(self, odometry: NDArray[np.float64], robot: str = "") -> NDArray[np.float64]:
        """Return the transform from a robot's odometry frame to the frame of its part, shape (3,).

        Args:
            odometry: The robot's odometry at its last scan, shape (3,).
            robot: Its name.
        """
        return compose(self.pose(robot), inverse(odometry))

    def trajectory(self, robot: str = "") -> NDArray[np.float64]:
        """Return the pose of each scan of a robot, in the order in which they came, shape (N, 3).

        Scans that were skipped have the pose by odometry relative to the scan before. A bounded mapper keeps
        the last pose only.
        """
        tracker = self._trackers.get(robot)
        if tracker is None:
            return np.zeros((0, 3))
        keys = [key for key, _ in tracker.entries]
        return compose(self.graph.poses[keys], np.array([offset for _, offset in tracker.entries]))

    def occupancy_map(self, resolution: float = 0.05) -> OccupancyMap:
        """Return the map, in the frame of the first robot's first scan: -1 unknown, 0 free, 100 occupied.

        Args:
            resolution: Cell size, metres.

        Raises:
            MapError: If the map would become larger than any floor.
        """
        return draw_graph(self.graph, resolution=resolution, farthest=self.parameters.usable_range)

    def statistics(self, robot: str = "") -> dict[str, int]:
        """Return counts of a robot's scans and of the graph, by name."""
        tracker = self._trackers[robot]
        return {
            "scans": tracker.scans,
            "matched": tracker.matched,
            "unmatched": tracker.unmatched,
            "keyscans": len(self.graph),
            "loops": self.loop_closures,
            "contradicted": self.contradicted,
            "undone": self.undone,
            "pruned": self.pruned,
            "jumps": tracker.jumps,
            **{f"refused_{reason}": count for reason, count in self.matcher.refused.items()},
        }
