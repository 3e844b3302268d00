"""Reads serialized messages of layers and checks them. Pure."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rce.ros.types import Message, TypeRegistry, TypesError
from rce_fleet.exceptions import MapError
from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.occupancy_map import OccupancyMap
from rce_fleet.station.layers.frames import LayerData, LayerError
from rce_fleet.station.layers.kinds import LayerKind, LayerTopic

MAX_RANGES = 20_000
"""Ranges of a scan; scanners have a few hundred or thousand."""
MAX_POSES = 5_000
"""Poses of a cloud or path that are sent; of larger ones, every second, third ... pose."""
MAX_CELLS = 4_000_000
"""Cells of a grid that are sent; of larger ones, squares of 2 x 2, 3 x 3 ... cells become one."""
UNKNOWN = 255

Payload = bytes | bytearray | memoryview


class LayerDecoder:
    """Reads the messages of one layer; a costmap's changes are applied to its last whole grid.

    Args:
        kind: The layer.
        types: Knows the message types.
    """

    def __init__(self, kind: LayerKind, types: TypeRegistry) -> None:
        self._kind = kind
        self._types = types
        self._grid: _Grid | None = None

    def decode(self, payload: Payload) -> LayerData:
        """Return what a message shows.

        Raises:
            LayerError: It cannot be shown.
        """
        return _DECODERS[self._kind.topic.type_name](self, self._read(self._kind.topic, payload))

    def update(self, payloads: Sequence[Payload]) -> LayerData | None:
        """Apply changes of parts; return what the grid shows, None before the first whole grid.

        Raises:
            LayerError: A part does not fit the grid.
        """
        if self._kind.updates is None or self._grid is None:
            return None
        for payload in payloads:
            self._grid.update(self._read(self._kind.updates, payload))
        return self._grid.data()

    def _read(self, topic: LayerTopic, payload: Payload) -> Message:
        try:
            return self._types.message(topic.type_name).deserialize(memoryview(payload))
        except TypesError as error:
            raise LayerError(f"a message is not a {topic.type_name}: {error}") from error

    def scan(self, message: Message) -> LayerData:
        """Read a ``sensor_msgs/LaserScan``."""
        names = ("angle_min", "angle_increment", "range_min", "range_max")
        fields = {name: float(getattr(message, name)) for name in names}
        # A range_max of infinity is a scanner without a limit.
        for name, value in fields.items():
            if not isfinite(value) and not (name == "range_max" and value > 0):
                raise LayerError(f"{name} of the scan must be a finite number, not {value}")
        ranges = np.asarray(message.ranges, np.float32)
        if ranges.size > MAX_RANGES:
            raise LayerError(f"the scan has {ranges.size} ranges; at most {MAX_RANGES} are shown")
        if ranges.size > 1 and fields["angle_increment"] == 0.0:
            raise LayerError(f"angle_increment of the scan is 0, but it has {ranges.size} ranges")
        notes = []
        invalid = int(np.count_nonzero(np.isnan(ranges)))
        if invalid:
            notes.append(f"{invalid} of {ranges.size} ranges are not a number")
        swept = (float(message.angle_max) - fields["angle_min"]) / (fields["angle_increment"] or 1.0)
        if isfinite(swept) and abs(swept + 1 - ranges.size) > 1.5:  # noqa: PLR2004  # drivers count differently by one
            notes.append(f"{ranges.size} ranges, but the angles are those of {round(swept) + 1}")
        fields["range_max"] = min(fields["range_max"], 1e9)
        return self._data(message, fields, ranges.astype("<f4").tobytes(), notes)

    def poses(self, message: Message) -> LayerData:
        """Read a ``geometry_msgs/PoseArray`` or a ``nav_msgs/Path``."""
        poses = [getattr(pose, "pose", pose) for pose in message.poses]
        step = -(-len(poses) // MAX_POSES) or 1
        notes = [f"every {step}th of {len(poses)} poses is shown"] if step > 1 else []
        rows = [_plane_of(pose) for pose in poses[::step]]
        array = np.array(rows, np.float64).reshape(-1, 3)
        valid = np.isfinite(array).all(axis=1)
        if not valid.all():
            notes.append(f"{int((~valid).sum())} of {len(array)} poses are not finite")
        shown = array[valid].astype("<f4")
        return self._data(message, {"count": len(shown)}, shown.tobytes(), notes)

    def grid(self, message: Message) -> LayerData:
        """Read a ``nav_msgs/OccupancyGrid``."""
        self._grid = None
        info = message.info
        x, y, yaw = _plane_of(info.origin)
        turn = info.origin.orientation
        if not any((turn.x, turn.y, turn.z, turn.w)):
            yaw = 0.0  # octomap_server and others never set it
        try:
            whole = OccupancyMap.from_message(
                info.width, info.height, message.data, info.resolution, Pose(x, y, yaw)
            )
        except MapError as error:
            raise LayerError(str(error)) from error
        self._grid = _Grid(whole, message)
        return self._grid.data()

    def _data(self, message: Message, fields: dict[str, Any], numbers: bytes, notes: list[str]) -> LayerData:
        return LayerData(message.header.frame_id, stamp_of(message), fields, numbers, tuple(notes))


class _Grid:
    """A grid whose parts change.

    Args:
        whole: The grid.
        message: The message that it came with.
    """

    def __init__(self, whole: OccupancyMap, message: Message) -> None:
        self._cells = whole.data.copy()
        self._whole = whole
        self._frame_id = message.header.frame_id
        self._stamp = stamp_of(message)

    def update(self, message: Message) -> None:
        """Apply a ``map_msgs/OccupancyGridUpdate``.

        Raises:
            LayerError: It does not fit.
        """
        rows, columns = self._cells.shape
        x, y, width, height = message.x, message.y, message.width, message.height
        values = np.asarray(message.data, np.int8)
        if values.size != width * height:
            raise LayerError(f"an update of {width} x {height} cells came with {values.size} values")
        if x < 0 or y < 0 or x + width > columns or y + height > rows:
            raise LayerError(
                f"an update of {width} x {height} cells at ({x}, {y}) does not fit the grid of"
                f" {columns} x {rows} cells"
            )
        self._cells[y : y + height, x : x + width] = values.reshape(height, width)
        self._stamp = stamp_of(message)

    def data(self) -> LayerData:
        """Return what the grid shows; a large one with a coarser resolution."""
        cells, resolution, notes = self._cells, self._whole.resolution, []
        if cells.size > MAX_CELLS:
            step = int(np.ceil(np.sqrt(cells.size / MAX_CELLS)))
            notes.append(f"{cells.shape[1]} x {cells.shape[0]} cells are shown {step} x {step} as one")
            cells, resolution = coarser(cells, step), resolution * step
        origin = self._whole.origin
        fields = {
            "rows": cells.shape[0],
            "columns": cells.shape[1],
            "resolution": resolution,
            "origin": [origin.x, origin.y, origin.yaw],
        }
        numbers = zlib.compress(cells.tobytes(), 1)  # -1 (unknown) becomes 255
        return LayerData(self._frame_id, self._stamp, fields, numbers, tuple(notes))


def coarser(cells: NDArray[np.int8], step: int) -> NDArray[np.int8]:
    """Return a grid in which squares of ``step`` x ``step`` cells are one: their highest value.

    Args:
        cells: shape (rows, columns).
        step: Edge of a square, cells.

    Returns:
        shape (ceil(rows / step), ceil(columns / step)); -1 where all cells are unknown.
    """
    rows, columns = cells.shape
    padded = np.pad(cells, ((0, -rows % step), (0, -columns % step)), constant_values=-1)
    blocks = padded.reshape(padded.shape[0] // step, step, padded.shape[1] // step, step)
    highest: NDArray[np.int8] = blocks.max(axis=(1, 3))
    return highest


def stamp_of(message: Message) -> int:
    """Return the time of a message with a header, nanoseconds."""
    nanoseconds: int = message.header.stamp.to_nsec()
    return nanoseconds


def _plane_of(pose: Message) -> tuple[float, float, float]:
    """Return x, y and yaw of a ``geometry_msgs/Pose``; NaN as yaw if the orientation is not a rotation."""
    turn = pose.orientation
    sine = 2.0 * (turn.w * turn.z + turn.x * turn.y)
    cosine = turn.w**2 + turn.x**2 - turn.y**2 - turn.z**2
    yaw = np.arctan2(sine, cosine) if sine or cosine else np.nan
    return pose.position.x, pose.position.y, float(yaw)


_DECODERS: dict[str, Callable[[LayerDecoder, Message], LayerData]] = {
    "sensor_msgs/LaserScan": LayerDecoder.scan,
    "geometry_msgs/PoseArray": LayerDecoder.poses,
    "nav_msgs/Path": LayerDecoder.poses,
    "nav_msgs/OccupancyGrid": LayerDecoder.grid,
}
