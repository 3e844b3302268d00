"""What ``amcl`` says of itself on ``/diagnostics``."""

from __future__ import annotations

from math import sqrt
from typing import TYPE_CHECKING

from rce_fleet.nodes.diagnostics import Level

if TYPE_CHECKING:
    from rce_fleet.localization.amcl import Estimate
    from rce_fleet.nodes.amcl_parameters import AmclNodeParameters

LATE = 2.0
"""Seconds without a usable scan after which the state is an error."""
POOR_FIT = 0.5
"""Scans that fit the map less than this mean that the robot may be lost."""

State = tuple[Level, str, dict[str, str]]


def describe(
    parameters: AmclNodeParameters,
    *,
    particles: int | None,
    scan_age: float | None,
    fault: str,
    estimate: Estimate | None,
) -> State:
    """Return level, text and values.

    Args:
        parameters: Those of the node.
        particles: Their number; None: there is no map yet.
        scan_age: Seconds since the last scan that was used; None: there was none.
        fault: Why the last map or scan was not used; empty if it was.
        estimate: The filter's last result.
    """
    if particles is None:
        return Level.ERROR, fault or "waits for the map", {}
    values = {"particles": str(particles)}
    if scan_age is None or scan_age > LATE:
        since = "yet" if scan_age is None else f"for {scan_age:.1f} s"
        return Level.ERROR, fault or f"no scan {since}", values
    if estimate is None:
        return Level.WARN, "no pose yet", values
    x, y, yaw = (sqrt(max(float(estimate.covariance[axis, axis]), 0.0)) for axis in range(3))
    values |= {
        "std_x": f"{x:.3f}",
        "std_y": f"{y:.3f}",
        "std_yaw": f"{yaw:.3f}",
        "agreement": f"{estimate.agreement:.2f}",
        "hypotheses": str(len(estimate.hypotheses)),
    }
    if estimate.agreement < POOR_FIT:
        return Level.WARN, f"scans fit the map by {estimate.agreement:.0%} only: lost?", values
    limits = (parameters.std_warn_level_x, parameters.std_warn_level_y, parameters.std_warn_level_yaw)
    if any(spread > limit for spread, limit in zip((x, y, yaw), limits, strict=True)):
        return Level.WARN, "the pose is uncertain", values
    return Level.OK, "localized", values
