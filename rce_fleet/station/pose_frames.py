"""Frames of poses: what a page gets of robots that moved, in binary form. Pure.

A frame is little-endian: the four bytes ``RCEP``, the number of rows (uint32), the station's time (float64,
seconds since 1970), and for each robot a row of 20 bytes: its index (uint32; documents of robots have it as
``index``), x, y (float32, metres) and yaw (float32, radians) in the map frame, and the age of its last sign
of life (float32, seconds; negative if the planner does not tell it). A frame of a layer begins with the
length of its header, which is smaller than these four bytes as a number.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

MAGIC = b"RCEP"
HEADER = np.dtype([("magic", "S4"), ("count", "<u4"), ("time", "<f8")])
ROW = np.dtype([("index", "<u4"), ("x", "<f4"), ("y", "<f4"), ("yaw", "<f4"), ("age", "<f4")])


class PoseRow(NamedTuple):
    """A robot's pose in a frame.

    Attributes:
        robot: The robot's index.
        x: Metres, in the map frame.
        y: Metres.
        yaw: Radians, counter-clockwise from x.
        age: Seconds since the robot's last sign of life; negative: not known.
    """

    robot: int
    x: float
    y: float
    yaw: float
    age: float = -1.0


def encode_poses(now: float, rows: Sequence[PoseRow]) -> bytes:
    """Return a frame.

    Args:
        now: The station's time, seconds since 1970.
        rows: The robots.
    """
    table = np.array([tuple(row) for row in rows], ROW)
    return np.array((MAGIC, len(table), now), HEADER).tobytes() + table.tobytes()


def decode_poses(frame: bytes) -> tuple[float, list[PoseRow]]:
    """Return time and rows of a frame.

    Raises:
        ValueError: It is not a frame of poses, or it has another length than its header says.
    """
    if len(frame) < HEADER.itemsize or frame[: len(MAGIC)] != MAGIC:
        raise ValueError(f"expected a frame of poses, which begins with {MAGIC!r}; found {frame[:4]!r}")
    header = np.frombuffer(frame, HEADER, count=1)[0]
    expected = HEADER.itemsize + int(header["count"]) * ROW.itemsize
    if len(frame) != expected:
        raise ValueError(f"expected {expected} bytes for {int(header['count'])} rows; found {len(frame)}")
    table = np.frombuffer(frame, ROW, offset=HEADER.itemsize)
    return float(header["time"]), [
        PoseRow(int(row["index"]), float(row["x"]), float(row["y"]), float(row["yaw"]), float(row["age"]))
        for row in table
    ]
