"""Trajectories of a log: ``trajectory.csv``, and poses for scans that a mapper skipped."""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.exceptions import LogError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from rce_fleet.mapping.records import LaserRecord

HEADER = ("scan", "time", "x", "y", "theta")


def complete_trajectory(
    odometry: NDArray[np.float64], known: NDArray[np.int64], poses: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return a pose for every scan, from the poses of some scans and the odometry of all.

    Between two known poses the odometry is followed from the first one; what it misses the second one by is
    spread over the way between them. Before the first and after the last known pose the odometry is followed
    as it is.

    Args:
        odometry: shape (N, 3), dead reckoning at each scan: x, y, yaw.
        known: shape (K,), ascending numbers of the scans with a pose, K > 0.
        poses: shape (K, 3), poses of these scans.

    Returns:
        shape (N, 3), in the frame of ``poses``; yaw within -pi .. pi.
    """
    if len(known) == 0 or len(known) != len(poses):
        raise ValueError(
            f"expected as many poses as known scans, at least one, not {len(poses)} and {len(known)}"
        )
    numbers = np.arange(len(odometry))
    before = np.clip(np.searchsorted(known, numbers, side="right") - 1, 0, None)
    after = np.minimum(before + 1, len(known) - 1)
    result = _follow(odometry, known[before], poses[before], numbers)
    between = (numbers > known[before]) & (numbers < known[after])
    if between.any():
        start, end = before[between], after[between]
        missed = _difference(poses[end], _follow(odometry, known[start], poses[start], known[end]))
        way = np.concatenate(([0.0], np.cumsum(_effort(odometry))))
        whole = way[known[end]] - way[known[start]]
        share = np.where(
            whole > 0,
            (way[numbers[between]] - way[known[start]]) / np.where(whole > 0, whole, 1.0),
            (numbers[between] - known[start]) / (known[end] - known[start]),
        )
        result[between] += share[:, None] * missed
    result[:, 2] = _wrap(result[:, 2])
    return result


def odometry_of(records: Sequence[LaserRecord]) -> NDArray[np.float64]:
    """Return the odometry of all scans, shape (N, 3)."""
    return np.array([record.odometry for record in records], np.float64).reshape(-1, 3)


def write_trajectory(path: Path, times: Sequence[float], poses: NDArray[np.float64]) -> None:
    """Write ``trajectory.csv``: the header ``scan,time,x,y,theta``, and one row for each pose.

    Args:
        path: File to write.
        times: Time of each scan, seconds.
        poses: shape (N, 3): x, y (metres), yaw (radians).
    """
    with path.open("w", newline="", encoding="ascii") as stream:
        rows = csv.writer(stream, lineterminator="\n")
        rows.writerow(HEADER)
        for number, (time, pose) in enumerate(zip(times, poses, strict=True)):
            rows.writerow((number, f"{time:.6f}", *(f"{value:.6f}" for value in pose)))


def read_trajectory(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return times, shape (N,), and poses, shape (N, 3), of a ``trajectory.csv``.

    Raises:
        LogError: If the file cannot be read or has another header or faulty rows.
    """
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            header, *rows = list(csv.reader(stream)) or [[]]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise LogError(f"{path}: cannot be read: {error}") from error
    if tuple(header) != HEADER:
        raise LogError(f"{path}:1: expected the header {','.join(HEADER)}, found {','.join(header)[:80]!r}")
    values = np.empty((len(rows), len(HEADER)))
    for number, row in enumerate(rows):
        try:
            values[number] = np.array([float(text) for text in row]).reshape(len(HEADER))
        except ValueError as error:
            raise LogError(f"{path}:{number + 2}: expected {len(HEADER)} numbers: {error}") from error
    return values[:, 1], values[:, 2:]


def _effort(odometry: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far the robot moved from each scan to the next, metres; a radian counts as a metre."""
    moved = np.diff(odometry, axis=0)
    return np.asarray(np.hypot(moved[:, 0], moved[:, 1]) + np.abs(_wrap(moved[:, 2])))


def _follow(
    odometry: NDArray[np.float64],
    start: NDArray[np.int64],
    poses: NDArray[np.float64],
    end: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Return where odometry from scan ``start`` to scan ``end`` leads from ``poses``."""
    turn = poses[:, 2] - odometry[start, 2]
    x, y = (odometry[end, :2] - odometry[start, :2]).T
    return np.column_stack(
        (
            poses[:, 0] + np.cos(turn) * x - np.sin(turn) * y,
            poses[:, 1] + np.sin(turn) * x + np.cos(turn) * y,
            odometry[end, 2] + turn,
        )
    )


def _difference(poses: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    missed = poses - others
    missed[:, 2] = _wrap(missed[:, 2])
    return missed


def _wrap(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((angles + np.pi) % (2 * np.pi) - np.pi)
