"""CARMEN logs, the text format of most published laser logs, plain or compressed with gzip.

The order of the lines rules; times may go backwards. Records other than ``ODOM`` and those of the front
laser, ``FLASER`` and in newer logs ``ROBOTLASER1``, are skipped.
"""

from __future__ import annotations

import gzip
import zlib
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass, field
from math import inf, isfinite, pi, remainder, tau
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.exceptions import LogError
from rce_fleet.geometry.poses import Pose
from rce_fleet.mapping.records import LaserRecord, ScanLog, no_return_range

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

GZIP_MAGIC = b"\x1f\x8b"
ODOM_FIELDS = 7
"""``ODOM x y theta tv rv accel ipc_time``; what follows is not needed."""
FLASER_TAIL = 7
"""``x y theta odom_x odom_y odom_theta ipc_time`` after the ranges of a ``FLASER``."""
ROBOTLASER_HEAD = 8
"""``laser_type start_angle field_of_view angular_resolution maximum_range accuracy remission_mode
num_readings`` before the ranges of a ``ROBOTLASER1``; angles are in radians, ranges in metres."""
ROBOTLASER_TAILS = (10, 11)
"""``laser_x laser_y laser_theta robot_x robot_y robot_theta laser_tv laser_rv forward_safety_dist
side_safety_dist``, then ``turn_axis`` in newer logs: fields between a ``ROBOTLASER1``'s ranges and its
``ipc_time ipc_hostname logger_time``. Most loggers write ``num_remissions`` and remissions before them."""
MOST_BEAMS = 100_000
CLOSE_ODOMETRY_S = 1.0
"""Odometry is interpolated between two records that are at most this far apart, seconds."""

Odometry = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class _Scan:
    time: float
    readings: NDArray[np.float64]
    start: float
    """Direction of the first beam, radians."""
    step: float
    """Angle from one beam to the next, radians."""
    odometry: Odometry
    before: int
    """Number of ODOM records that precede it."""
    farthest: float = inf
    """Greatest range of the laser, metres."""
    laser: Odometry = (0.0, 0.0, 0.0)
    """Pose of the laser on the robot."""


@dataclass(slots=True)
class _Parsed:
    scans: list[_Scan] = field(default_factory=list)
    odometry: list[tuple[float, Odometry]] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    unknown: Counter[str] = field(default_factory=Counter)


def read_carmen(path: Path) -> ScanLog:
    """Read a CARMEN log.

    A scan's odometry is that of the ``ODOM`` record before it, interpolated where the next record is near in
    time; in a log without ``ODOM`` records it is the odometry in the scan's own record.

    Lines that cannot be parsed are left out and listed in ``faults`` of the result.

    Raises:
        LogError: If the file cannot be opened, is empty, or has no usable scan.
    """
    parsed = _Parsed()
    number = 0
    try:
        for number, line in _lines(path):
            _parse(line, f"{path}:{number}", parsed)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        parsed.faults.append(f"{path}:{number + 1}: the compressed file ends early or is damaged: {error}")
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from error
    if not parsed.scans:
        raise LogError(_without_scans(path, number, parsed))
    farthest = no_return_range([scan.readings for scan in parsed.scans])
    return ScanLog(str(path), _records(parsed, farthest), parsed.faults)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    with ExitStack() as opened:
        raw = opened.enter_context(path.open("rb"))
        packed = raw.read(len(GZIP_MAGIC)) == GZIP_MAGIC
        raw.seek(0)
        stream = opened.enter_context(gzip.open(raw)) if packed else raw
        for number, line in enumerate(stream, 1):
            yield number, line.decode("utf-8", "replace")


def _parse(line: str, place: str, into: _Parsed) -> None:
    kind, _, rest = line.partition(" ")
    try:
        match kind.strip():
            case "ODOM":
                into.odometry.append(_odom(rest.split()))
            case "FLASER":
                into.scans.append(_flaser(rest.split(), len(into.odometry)))
            case "ROBOTLASER1":
                into.scans.append(_robotlaser(rest.split(), len(into.odometry)))
            case "" | "PARAM" | "NEFF" | "SYNC":
                pass
            case other if other.startswith("#"):
                pass
            case other:
                into.unknown[other[:30]] += 1
    except ValueError as error:
        into.faults.append(f"{place}: {kind} left out: {error}")


def _odom(fields: list[str]) -> tuple[float, Odometry]:
    if len(fields) < ODOM_FIELDS:
        raise ValueError(f"expected at least {ODOM_FIELDS} fields, found {len(fields)}")
    return _number(fields[6], "ipc_time"), _pose(fields[:3])


def _flaser(fields: list[str], before: int) -> _Scan:
    count = _count(fields[0] if fields else "")
    if len(fields) < 1 + count + FLASER_TAIL:
        raise ValueError(
            f"expected {count} ranges and {FLASER_TAIL} more fields, found {len(fields) - 1} in all"
        )
    readings = np.array(fields[1 : 1 + count], np.float64)
    tail = fields[1 + count :]
    step = pi / (count - 1 if count in {181, 361} else max(count, 1))
    return _Scan(_number(tail[6], "ipc_time"), readings, -pi / 2, step, _pose(tail[3:6]), before)


def _robotlaser(fields: list[str], before: int) -> _Scan:
    if len(fields) < ROBOTLASER_HEAD:
        raise ValueError(f"expected at least {ROBOTLASER_HEAD} fields, found {len(fields)}")
    count = _count(fields[ROBOTLASER_HEAD - 1])
    body, end = fields[ROBOTLASER_HEAD + count : -3], fields[-3:]
    if body and body[0].isdecimal() and len(body) - 1 - int(body[0]) in ROBOTLASER_TAILS:
        body = body[1 + int(body[0]) :]
    if len(body) not in ROBOTLASER_TAILS:
        raise ValueError(
            f"expected {count} ranges, remissions and {ROBOTLASER_TAILS[0]} more fields before ipc_time, "
            f"found {len(fields) - ROBOTLASER_HEAD - len(end)} in all"
        )
    start, step, farthest = (
        _number(fields[place], name)
        for place, name in ((1, "start_angle"), (3, "angular_resolution"), (4, "maximum_range"))
    )
    if step <= 0:
        raise ValueError(f"angular_resolution: expected more than 0, found {fields[3]}")
    laser, robot = Pose(*_pose(body[:3])), Pose(*_pose(body[3:6]))
    place = laser.relative_to(robot)
    return _Scan(
        time=_number(end[0], "ipc_time"),
        readings=np.array(fields[ROBOTLASER_HEAD : ROBOTLASER_HEAD + count], np.float64),
        start=start,
        step=step,
        odometry=(robot.x, robot.y, robot.yaw),
        before=before,
        farthest=farthest if farthest > 0 else inf,
        laser=(place.x, place.y, place.yaw),
    )


def _count(text: str) -> int:
    count = int(text) if text.isdecimal() else -1
    if not 0 <= count <= MOST_BEAMS:
        raise ValueError(f"expected a number of ranges up to {MOST_BEAMS}, found {text or 'nothing'}")
    return count


def _pose(fields: list[str]) -> Odometry:
    x, y, yaw = (_number(text, name) for text, name in zip(fields, ("x", "y", "theta"), strict=True))
    return x, y, remainder(yaw, tau)


def _number(text: str, name: str) -> float:
    value = float(text)
    if not isfinite(value):
        raise ValueError(f"{name}: expected a finite number, found {text}")
    return value


def _without_scans(path: Path, lines: int, parsed: _Parsed) -> str:
    if lines == 0:
        return f"{path}: the log is empty; expected a CARMEN log with FLASER or ROBOTLASER1 records"
    found = ", ".join(f"{count} {kind}" for kind, count in parsed.unknown.most_common(5))
    reason = f"{path}: no laser scan in {lines} lines; expected FLASER or ROBOTLASER1 records"
    if parsed.odometry:
        reason += f", found {len(parsed.odometry)} ODOM"
    if found:
        reason += f", found {found}"
    if parsed.faults:
        reason += f"; first of {len(parsed.faults)} faults: {parsed.faults[0]}"
    return reason


def _records(parsed: _Parsed, farthest: float) -> list[LaserRecord]:
    records = []
    for index, scan in enumerate(parsed.scans):
        limit = min(farthest, scan.farthest)
        with np.errstate(invalid="ignore"):
            usable = (scan.readings > 0) & (scan.readings < limit)
        records.append(
            LaserRecord(
                index=index,
                time=scan.time,
                ranges=np.where(usable, scan.readings, inf),
                angle_min=scan.start,
                angle_increment=scan.step,
                range_max=limit,
                odometry=_odometry_of(scan, parsed.odometry),
                laser=scan.laser,
            )
        )
    return records


def _odometry_of(scan: _Scan, odometry: list[tuple[float, Odometry]]) -> Odometry:
    """Return the odometry at a scan: between the records around it if times fit, else the one before."""
    if not odometry:
        return scan.odometry
    if scan.before == 0:
        return odometry[0][1]
    start, first = odometry[scan.before - 1]
    if scan.before == len(odometry):
        return first
    end, second = odometry[scan.before]
    if not (start < scan.time < end and end - start <= CLOSE_ODOMETRY_S):
        return first
    share = (scan.time - start) / (end - start)
    turn = remainder(second[2] - first[2], tau)
    return (
        first[0] + share * (second[0] - first[0]),
        first[1] + share * (second[1] - first[1]),
        remainder(first[2] + share * turn, tau),
    )
