"""Reads a log of either format."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_fleet.exceptions import LogError
from rce_fleet.mapping.logs import read_carmen

if TYPE_CHECKING:
    from pathlib import Path

    from rce_fleet.mapping.records import ScanLog

BAG_MAGIC = b"#ROSBAG V"


def read_log(path: Path, *, scan: str = "/scan", odometry: str = "/odom") -> ScanLog:
    """Read a ROS 1 bag or a CARMEN log, whatever its name; the first bytes tell.

    Args:
        path: The log.
        scan: In a bag, the topic of the scans.
        odometry: In a bag, the topic of the odometry.

    Raises:
        LogError: The file cannot be read or has no laser scan.
    """
    try:
        with path.open("rb") as stream:
            begin = stream.read(len(BAG_MAGIC))
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from error
    if begin != BAG_MAGIC:
        return read_carmen(path)
    from rce_fleet.offline.bags import read_bag

    return read_bag(path, scan=scan, odometry=odometry)
