"""What the node ``slam_graph`` does with scans, apart from ROS: mapping, or localization in a saved map."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.exceptions import MapError
from rce_fleet.geometry.poses import compose, inverse
from rce_fleet.mapping.graph.localization import GraphLocalizer
from rce_fleet.mapping.graph.mapper import GraphMapper
from rce_fleet.mapping.graph.occupancy import draw_graph
from rce_fleet.mapping.graph.storage import load_graph, save_graph

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.mapping.graph.key_graph import KeyGraph
    from rce_fleet.mapping.records import LaserRecord
    from rce_fleet.maps.occupancy_map import OccupancyMap
    from rce_fleet.nodes.slam_graph_parameters import SlamGraphParameters

POSE_NUMBERS = 3


class SlamGraphSession:
    """One map and the robots in it. Its methods may take long, and are called by one thread at a time.

    The map is empty until :meth:`load`; with ``localize_only`` scans are left out until then.

    Args:
        parameters: The node's parameters.
    """

    def __init__(self, parameters: SlamGraphParameters) -> None:
        self._parameters = parameters
        self._mapper = GraphMapper(parameters.graph_parameters(), bounded=True)
        self._localizers: dict[str, GraphLocalizer] = {}
        self._start: NDArray[np.float64] | None = None
        if len(parameters.initial_pose) == POSE_NUMBERS:
            self._start = np.array(parameters.initial_pose, np.float64)
        self._drawn: tuple[tuple[int, int], OccupancyMap] | None = None
        self._unread = False
        """Whether ``map_file`` is something that could not be loaded; it may still be of use to its owner."""

    @property
    def graph(self) -> KeyGraph:
        """The graph."""
        return self._mapper.graph

    @property
    def loops(self) -> int:
        """Number of closed loops."""
        return self._mapper.loop_closures

    @property
    def undone(self) -> int:
        """Number of joins of robots that later scans contradicted."""
        return self._mapper.undone

    def jump(self, robot: str) -> str:
        """Return how a robot's odometry jumped at its last scan; empty if it did not."""
        if not self._parameters.localize_only:
            return self._mapper.jump(robot)
        localizer = self._localizers.get(robot)
        return "" if localizer is None else localizer.jump

    def add(self, robot: str, record: LaserRecord) -> NDArray[np.float64] | None:
        """Take a scan; return ``map_from_odom``, shape (3,), or None while the robot's place is not known."""
        odometry = np.array(record.odometry)
        if self._parameters.localize_only:
            if not len(self.graph):
                return None
            localizer = self._localizers.get(robot)
            if localizer is None:
                localizer = GraphLocalizer(
                    self.graph, self._parameters.graph_parameters(), self._take_start()
                )
                self._localizers[robot] = localizer
            pose = localizer.add(record)
            return None if pose is None else compose(pose, inverse(odometry))
        start = None if robot in self._mapper.robots else self._take_start()
        self._mapper.add(record, robot, start)
        return self._mapper.map_from_odom(odometry, robot) if self._mapper.is_joined(robot) else None

    def _take_start(self) -> NDArray[np.float64] | None:
        """Return the given first pose, once: it is that of the first robot."""
        start, self._start = self._start, None
        return start

    def map_from_odom(self, robot: str, odometry: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return a robot's transform after the graph has changed; None while its place is not known."""
        if self._parameters.localize_only or not self._mapper.is_joined(robot):
            return None
        return self._mapper.map_from_odom(odometry, robot)

    def occupancy_map(self) -> OccupancyMap | None:
        """Return the map, drawn anew if the graph has changed; None without any scan.

        Raises:
            MapError: It would become too large.
        """
        graph = self.graph
        if not len(graph):
            return None
        state = (len(graph), graph.moves)
        if self._drawn is None or self._drawn[0] != state:
            parameters = self._parameters
            drawn = draw_graph(
                graph,
                resolution=parameters.delta,
                farthest=parameters.max_usable_range,
                occupied_share=parameters.occ_thresh,
            )
            self._drawn = state, drawn
        return self._drawn[1]

    def save(self) -> str:
        """Refine the map and write it to ``map_file``; return what was done.

        A file that could not be loaded is not lost: it is renamed, with ``.unread`` behind its name.

        Raises:
            MapError: There is no file name, no scan yet, or the file cannot be written.
        """
        path = self._path()
        if len(self.graph) and not self._parameters.localize_only:
            self._mapper.finish()
        if not self._unread:
            save_graph(self.graph, path)
            return f"wrote {len(self.graph)} keyscans to {path}"
        unread = _put_aside(path) if len(self.graph) else None
        save_graph(self.graph, path)
        self._unread = False
        text = f"wrote {len(self.graph)} keyscans to {path}"
        return text if unread is None else f"{text}; the file that could not be loaded is {unread} now"

    def load(self) -> str:
        """Continue with the map in ``map_file``: all robots are placed anew; return what was done.

        Raises:
            MapError: There is no file name, or the file cannot be used; the present map stays.
        """
        path = self._path()
        try:
            graph = load_graph(path)
        except MapError:
            self._unread = path.is_file()
            raise
        self._unread = False
        self._mapper = GraphMapper(self._parameters.graph_parameters(), graph, bounded=True)
        self._localizers.clear()
        self._drawn = None
        return f"loaded {len(graph)} keyscans from {path}"

    def _path(self) -> Path:
        if not self._parameters.map_file:
            raise MapError("no file for the map: set the parameter ~map_file, such as /home/robot/floor1.npz")
        return Path(self._parameters.map_file).expanduser()


def _put_aside(path: Path) -> Path | None:
    """Rename a file that could not be loaded; return its new name, None if it is gone by now.

    Raises:
        MapError: It cannot be renamed.
    """
    unread = path.with_name(f"{path.name}.unread")
    try:
        path.replace(unread)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise MapError(f"{path} could not be loaded, and cannot be renamed: {error.strerror}") from error
    return unread
