"""GMapping's model of odometry's errors."""

from __future__ import annotations

from math import hypot
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.mapping.gmapping.parameters import FilterParameters

SIDEWAYS = 0.3
"""Share of ``srr`` with which a motion errs across its direction."""
LEAST_STD = (0.02, 0.02, 0.02)
"""Least standard deviations of a prior: x, y (metres), yaw (radians)."""


def motion_std(motion: NDArray[np.float64], parameters: FilterParameters) -> NDArray[np.float64]:
    """Return the standard deviations of a motion, shape (3,): x, y, yaw in the frame of its beginning.

    Args:
        motion: shape (3,): x, y, yaw by odometry, seen from the pose before.
        parameters: ``srr``, ``srt``, ``str`` and ``stt``.
    """
    x, y, turn = np.abs(motion)
    p = parameters
    across = SIDEWAYS * p.srr
    return np.array(
        (
            p.srr * x + p.str_ * turn + across * y,
            p.srr * y + p.str_ * turn + across * x,
            p.stt * turn + p.srt * hypot(x, y),
        )
    )


def prior_information(yaws: NDArray[np.float64], std: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse covariances of a motion in the map's frame, shape (N, 3, 3).

    Args:
        yaws: shape (N,): directions of the base before the motion.
        std: shape (3,): standard deviations in the frame of the base.
    """
    turn = np.zeros((len(yaws), 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(yaws)
    turn[:, 1, 0] = np.sin(yaws)
    turn[:, 0, 1] = -turn[:, 1, 0]
    turn[:, 2, 2] = 1
    precise = 1 / np.maximum(std, LEAST_STD) ** 2
    return np.asarray((turn * precise) @ turn.transpose(0, 2, 1))
